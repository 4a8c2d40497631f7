"""Covariance of the multipath in one hall from signals at known positions.

Positions within a few wavelengths are one place: their paths have nearly the same directions and
delays. The N places of a survey have equal weights, and so have the positions of each place. The
weighted residuals have the sample covariance S. With an inverse Wishart prior of weight
nu, whose mean L_0 is the covariance declared by three fields of the scenario, the posterior mean,
inflated by t, is

    L = t (nu L_0 + N S) / (nu + N).

The fields and nu maximise the evidence. L is close to the declared covariance for few places, and
to the sample covariance for many. If the multipath consists of a few strong paths, it is not
Gaussian, and positioning errors would exceed the bound with t = 1. Each place is therefore left
out in turn, and t is chosen so that about 95 % of the errors are in the 95 % region of the local
bound, and 99 % of the residuals pass their test. In small surveys, t is close to a usual value.

Positions are excluded if their signals are more probable as multipath of an unknown level, without
a direct path.
"""

import dataclasses
import itertools
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.calibration.estimate import (
    MAX_UNEXPLAINED,
    Pilots,
    check_pilots,
    check_power,
    places_of,
    residuals_of,
    weights_of,
)
from rhs_isac_ros.model import Beamforming, MeasurementModel, Scenario, gaussian
from rhs_isac_ros.model.arrays import adjoint
from rhs_isac_ros.model.constants import POWER_NEPERS_PER_DB
from rhs_isac_ros.model.geometry import region_information
from rhs_isac_ros.model.hall import CONDITIONS, FIELDS, MultipathEstimate
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.measurement import KnownSurface
from rhs_isac_ros.support.threads import one_blas_thread

# Share of errors that should be in the region of the local bound, and share of residuals that
# should pass their test.
COVERAGE = 0.95
_PASSING = 0.99
# Distance of positions that count as one place [wavelengths of the lowest band]. Over a few
# wavelengths, only the phases of paths change. With a smaller distance, a walk would count each
# cycle as a place, and covariances from it would be too small.
PLACE_WAVELENGTHS = 4.0
# Inflation t without places, and the weight of this value, in places. It is a margin for
# small surveys, in which the quantiles above are uncertain.
_INFLATION, _INFLATION_WEIGHT = 1.8, 40
# Usual standard deviation of the level of users in sight [dB], with the same weight.
_LEVEL_STD_DB = 1.2
# Surveys with fewer places, or that span a smaller share of a side, cause a warning.
MIN_PLACES = 20
_MIN_SPAN = 0.5
# Limits of delay spreads in units of the inverse bandwidth, angular spreads [deg], levels [dB] and
# prior weights.
_DELAYS, _ANGLES, _LEVELS, _WEIGHTS = (1e-3, 10.0), (0.5, 300.0), (-80.0, 60.0), (0.5, 1e4)
# Initial steps of the search: level [dB], and logarithms of the other parameters.
_STEPS = (3.0, 1.0, 0.7, 1.0)
# Prior probability of a blocked position if the scenario declares none, and its upper limit.
_BLOCKED_PROBABILITY, _MAX_BLOCKED = 0.1, 0.9
# Maximum number of rounds of alignment, estimation and search for blocked positions.
_ROUNDS = 4
# Maximum number of samples with one position of each place.
_MAX_DRAWS = 8


class SurveyWarning(UserWarning):
    """A survey is too small, covers only part of the region, or does not fit its positions."""


@one_blas_thread
def survey(scenario: Scenario, codebook: Beamforming, positions: np.ndarray,
           received: np.ndarray, surface: KnownSurface | None = None) -> MultipathEstimate:
    """Estimate the covariance of the multipath from signals at known positions.

    `positions`, float64 [N, 3] [m], should be spread over the region of interest; `received` are
    complex128 [N, N_B, N_SB F], sub-band-major. The declared level and spreads of the multipath
    affect only the start of the search. Declared impairments are estimated for each position.
    Positions within `PLACE_WAVELENGTHS` count as one place, such as those of a user at rest. The
    result is a value of `Scenario.multipath`; its `about` contains the expected coverage.

    Raises ValueError if a shape is wrong, a number is not finite, there is no position, a position
    is far from the region, no position has a direct path, or signals contain no noise. Warns with
    SurveyWarning if fewer than `MIN_PLACES` places have a direct path, if these span less than
    half of a side of the region, if more than a third of the positions unexpectedly has no direct
    path, or if significantly less than 95 % of the places left out are in the 95 % region.
    """
    from scipy.stats import binomtest

    pilots = Pilots(codebook, positions, received)
    check_pilots(scenario, [pilots])
    n = len(pilots.positions)
    if not n:
        raise ValueError('positions: none given, expected at least one')
    fit = _fitted(dataclasses.replace(scenario, multipath=None), pilots, surface)
    model, seen, n_places = fit.model, fit.in_sight, fit.n_places
    energies, distances, weights = fit.energies[seen], fit.distances[seen], fit.weights[seen]
    n_measurements = int(np.prod(model.shape))
    level_std_db = _level_std_db(energies, weights, n_measurements)
    # Estimators scale the covariance of a position by the level that the residual indicates.
    relative = energies / n_measurements
    distances = distances / relative**gaussian.share_of_level(n_measurements, level_std_db)
    inflation = _inflation(distances, energies, weights, n_measurements)
    measured, declared = inflation * fit.covariance, model.covariance()
    inverse = np.linalg.inv(declared)
    excess = inverse @ (measured - declared) @ inverse
    inside = float(weights @ (distances <= inflation * _radius()))
    interval = binomtest(round(inside), n_places).proportion_ci(method='wilson')
    coverage = [inside / n_places, *map(float, interval)]
    texts = _warnings(scenario, pilots.positions, seen, n_places, coverage)
    if texts:
        warnings.warn('; '.join(texts), SurveyWarning, stacklevel=3)
    about: dict[str, Any] = {
        'positions': int(seen.sum()), 'blocked': n - int(seen.sum()), 'places': n_places,
        'prior_weight': fit.prior_weight, 'inflation': inflation, 'level_std_db': level_std_db,
        'coverage': coverage, 'warnings': texts, 'codebook': str(getattr(codebook, 'id', '')),
        'version': __version__}
    plain = scenario.fields()
    return MultipathEstimate(
        **{name: getattr(model.scenario, name) for name in FIELDS},
        radiation=np.array(model.radiation),
        excess=(excess + adjoint(excess)) / 2,
        conditions={name: plain[name] for name in CONDITIONS}, about=about)


def survey_report(estimate: MultipathEstimate) -> str:
    """Describe an estimate: positions, fields, prior weight, inflation, coverage and warnings."""
    about = estimate.about
    coverage, low, high = (100 * share for share in about['coverage'])
    return '\n'.join([
        f'{about["positions"]} positions, {about["blocked"]} more without a direct path, codebook '
        f'{about["codebook"]}',
        # Files of earlier versions do not contain the number of places.
        f'places: {about.get("places", about["positions"])}; positions within '
        f'{PLACE_WAVELENGTHS:g} wavelengths are one',
        f'fields: multipath / direct path {estimate.multipath_to_los_db:.1f} dB, delay spread '
        f'{1e9 * estimate.delay_spread_s:.0f} ns, angular spread '
        f'{estimate.angular_spread_deg:.1f} deg; they weigh as much as '
        f'{about["prior_weight"]:.1f} places',
        f'inflation of the covariance: {about["inflation"]:.2f}; {coverage:.1f} % '
        f'[{low:.1f}, {high:.1f}] of the places left out are in the 95 % region',
        *(f'warning: {text}' for text in about['warnings'])])


class _Fit(NamedTuple):
    """The most likely fields of the scenario, and what follows for the positions."""

    # Model with these fields, weight of the prior in places, and number of places in sight.
    model: MeasurementModel
    prior_weight: float
    n_places: int
    # Posterior mean of the covariance, complex128 [N_B, R, R].
    covariance: np.ndarray
    # Whether there is a direct path [N], and weight of each position, [N], of sum `n_places`.
    in_sight: np.ndarray
    weights: np.ndarray
    # Results of `_left_out`: energies, and squared Mahalanobis distances, [N].
    energies: np.ndarray
    distances: np.ndarray


def _fitted(fields: Scenario, pilots: Pilots, surface: KnownSurface | None) -> _Fit:
    """Fit fields, impairments and blocked positions in turn."""
    has_nuisance, in_sight = len(nuisance_of(fields)) > 0, np.ones(len(pilots.positions), bool)
    places = places_of(fields, pilots.positions, PLACE_WAVELENGTHS)
    for _ in range(_ROUNDS):
        model, weights = MeasurementModel(fields, pilots.beams, surface), weights_of(
            places, in_sight)
        residuals, n = residuals_of(model, pilots), round(weights.sum())
        check_power(fields, residuals, 'residuals')
        samples = _samples(residuals, places, in_sight)
        fields, prior_weight = _most_likely(fields, model, samples, n)
        model = MeasurementModel(fields, pilots.beams, surface)
        total = _scatter(residuals, weights) + prior_weight * model.covariance()
        energies, without, distances = _left_out(
            model, pilots.positions, residuals, weights, places, total, prior_weight + n)
        fit = _Fit(model, prior_weight, n, total / (prior_weight + n), in_sight, weights,
                   energies, distances)
        in_sight = _in_sight(fit, without)
        if not in_sight.any():
            raise ValueError(
                f'positions: no direct path at any of {len(in_sight)}, expected positions in '
                'metres, in the frame of the surface and in the order of the signals')
        if (in_sight == fit.in_sight).all() and not has_nuisance:
            break
    return fit


def _samples(residuals: np.ndarray, places: Sequence[np.ndarray], in_sight: np.ndarray
             ) -> np.ndarray:
    """Return sample covariances [K, N_B, R, R], each from one position of every place in sight.

    Residuals of a place share their multipath. The evidence of an average over them would differ,
    because the average has less noise.
    """
    seen = [rows[in_sight[rows]] for rows in places if in_sight[rows].any()]
    n_draws = min(max(map(len, seen)), _MAX_DRAWS)
    draws = [residuals[[rows[len(rows) * k // n_draws] for rows in seen]] for k in range(n_draws)]
    return np.array([_scatter(one, np.full(len(seen), 1 / len(seen))) for one in draws])


def _scatter(residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum e e^H over residuals e, complex128 [N, N_B, R], with weights [N]; [N_B, R, R]."""
    return np.einsum('nir,nis->irs', residuals * weights[:, None, None], residuals.conj())


def _most_likely(scenario: Scenario, model: MeasurementModel, samples: np.ndarray, n: int
                 ) -> tuple[Scenario, float]:
    """Return the scenario fields and the prior weight with the highest evidence."""
    from scipy.optimize import minimize

    bandwidth_hz = scenario.bandwidth_hz
    low, high = np.array([
        _LEVELS, np.log(_DELAYS) - np.log(bandwidth_hz), np.log(_ANGLES), np.log(_WEIGHTS)]).T

    def declaring(point: np.ndarray) -> Scenario:
        level, delay, angle = np.clip(point, low, high)[:3].tolist()
        return dataclasses.replace(
            scenario, **dict(zip(FIELDS, (level, np.exp(delay), np.exp(angle)), strict=True)))

    # The fields change no errors of the direct path, which take most of the time.
    direct = model.covariance() - model.covariance_in_shadow()

    def cost(point: np.ndarray) -> float:
        covariance = direct + model.covariance_in_shadow(declaring(point))
        return -_log_evidence(covariance, samples, n, float(np.exp(np.clip(point, low, high)[3])))

    # The level follows from the power, at least if the noise is weak.
    power = np.trace(samples, axis1=2, axis2=3).real.sum() / len(samples)
    power /= np.trace(model.covariance(), axis1=1, axis2=2).real.sum()
    level = scenario.multipath_to_los_db + 10 * np.log10(max(power, 1e-12))
    starts = [np.clip([level, np.log(delay), np.log(angle), np.log(samples.shape[-1])], low, high)
              for delay, angle in itertools.product(
                  (max(scenario.delay_spread_s, 1e-12), 0.05 / bandwidth_hz),
                  (scenario.angular_spread_deg, 30.0))]
    start = min(starts, key=cost)
    steps = np.where(start + _STEPS < high, _STEPS, -np.array(_STEPS))
    found = minimize(cost, start, method='Nelder-Mead', options={
        'initial_simplex': np.vstack([start, start + np.diag(steps)]),
        'xatol': 0.02, 'fatol': 0.05, 'maxiter': 400})
    return declaring(found.x), float(np.exp(np.clip(found.x, low, high)[3]))


def _log_evidence(declared: np.ndarray, samples: np.ndarray, n: int, weight: float) -> float:
    """Return the log evidence of n residuals, up to a constant, averaged over `samples`.

    The covariances of the bands are inverse Wishart variables with the mean `declared`, complex128
    [N_B, R, R], and ``weight + R`` degrees of freedom.
    """
    from scipy.special import gammaln

    n_bands, size = declared.shape[:2]
    degrees = weight + size
    volume = np.sum(gammaln(degrees + n - np.arange(size)) - gammaln(degrees - np.arange(size)))
    before = np.linalg.slogdet(weight * declared)[1].sum()
    after = np.linalg.slogdet(weight * declared + n * samples)[1].sum() / len(samples)
    return float(n_bands * volume + degrees * before - (degrees + n) * after)


def _left_out(model: MeasurementModel, positions: np.ndarray, residuals: np.ndarray,
              weights: np.ndarray, places: Sequence[np.ndarray], total: np.ndarray, degrees: float
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evaluate the positions of each place under the covariance of all others.

    The covariance of all places is ``total / degrees``, with `total` complex128 [N_B, R, R]. An
    error is a scoring step from the true position, with unknown nuisance parameters. Returns the
    energies of the residuals with and without a direct path, and the squared Mahalanobis distances
    of the errors, [N] each.
    """
    mean, by_position = model.mean_and_jacobian(positions)
    nuisance = nuisance_of(model.scenario)
    slopes = np.concatenate([by_position, nuisance.scaled_patterns * mean[:, None]], axis=1)
    prior = np.diag(np.concatenate([np.zeros(3), nuisance.precision]))
    prior[:3, :3] = region_information(model.scenario)
    energies, without, distances = np.empty((3, len(positions)))
    for rows in places:
        # A place must not explain itself.
        others = total - _scatter(residuals[rows], weights[rows])
        whitener = np.linalg.inv(np.linalg.cholesky(others / (degrees - weights[rows].sum())))
        white, white_mean, columns = (np.matmul(whitener, array[rows][..., None])[..., 0]
                                      for array in (residuals, mean, slopes))
        energies[rows] = np.sum(np.abs(white)**2, axis=(1, 2))
        without[rows] = np.sum(np.abs(white + white_mean)**2, axis=(1, 2))
        flat = columns.reshape(*columns.shape[:2], -1)
        covariance = np.linalg.inv(gaussian.quadratic_form(flat) + prior)[:, :3, :3]
        gradient = 2 * np.einsum(
            'nar,nr->na', flat[:, :3].conj(), white.reshape(len(rows), -1)).real
        distances[rows] = np.einsum('na,nab,nb->n', gradient, covariance, gradient)
    return energies, without, distances


def _in_sight(fit: _Fit, without: np.ndarray) -> np.ndarray:
    """Mark positions that probably have a direct path, bool [N].

    Without a direct path, signals have the energies `without` [N] and are multipath of an unknown
    level. With one, the level varies as much as it does among the positions in sight.
    """
    n_measurements, seen = int(np.prod(fit.model.shape)), fit.in_sight
    level_std_db = _level_std_db(fit.energies[seen], fit.weights[seen], n_measurements)
    prior = min(fit.model.scenario.blocked_probability or _BLOCKED_PROBABILITY, _MAX_BLOCKED)
    log_odds = (np.log(1 / prior - 1)
                + gaussian.log_evidence_of_level(
                    fit.energies[:, None], n_measurements, level_std_db)
                - gaussian.log_evidence_of_level(
                    without[:, None], n_measurements, gaussian.BLOCKED_STD_DB))
    return np.asarray(log_odds > 0)


def _inflation(distances: np.ndarray, energies: np.ndarray, weights: np.ndarray,
               n_measurements: int) -> float:
    """Return the inflation t, which is close to `_INFLATION` in small surveys."""
    most = max(1.0, float(np.average(energies, weights=weights)) / n_measurements,
               _quantile(distances, weights, COVERAGE) / _radius(),
               _quantile(energies, weights, _PASSING) / gaussian.energy_limit(n_measurements))
    shares = np.array([weights.sum(), _INFLATION_WEIGHT])
    return float(np.exp(shares @ np.log([most, _INFLATION]) / shares.sum()))


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Return the smallest value that at least a share of the weight does not exceed."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][np.searchsorted(reached, share - 1e-9)])


def _level_std_db(energies: np.ndarray, weights: np.ndarray, n_measurements: int) -> float:
    """Return the standard deviation of the level among users [dB], from residual energies."""
    levels, n = np.log(energies), weights.sum()
    variance = np.average((levels - np.average(levels, weights=weights))**2, weights=weights)
    # Energies of Gaussian residuals vary even if the residuals have equal power.
    excess = max(float(variance) - 1 / n_measurements, 0.0)
    usual = (POWER_NEPERS_PER_DB * _LEVEL_STD_DB)**2
    variance = (n * excess + _INFLATION_WEIGHT * usual) / (n + _INFLATION_WEIGHT)
    return float(np.sqrt(variance) / POWER_NEPERS_PER_DB)


def _radius() -> float:
    """Return the squared Mahalanobis radius of the region of probability `COVERAGE`."""
    from scipy.special import chdtri

    return float(chdtri(3, 1 - COVERAGE))


def _warnings(scenario: Scenario, positions: np.ndarray, in_sight: np.ndarray, n_places: int,
              coverage: list[float]) -> list[str]:
    """Return reasons why the estimate may not hold in the whole region."""
    texts = []
    if n_places < MIN_PLACES:
        texts.append(f'positions: {n_places}, expected at least {MIN_PLACES} different places for '
                     'a covariance of this hall rather than of its most similar declaration')
    declared = scenario.blocked_probability
    limit = declared + (1 - declared) * MAX_UNEXPLAINED
    if np.mean(~in_sight) > limit:
        texts.append(f'positions: {np.sum(~in_sight)} of {len(positions)} do not fit a direct '
                     f'path, as if they were shifted, expected at most {100 * limit:.0f} %')
    if coverage[2] < COVERAGE:
        texts.append(f'positions: {100 * coverage[0]:.0f} % of the places left out in the '
                     f'{100 * COVERAGE:g} % region, expected {100 * COVERAGE:g} %')
    spans = np.ptp(positions[in_sight], axis=0)
    for axis, span, side in zip('xyz', spans.tolist(), scenario.roi_size_m, strict=True):
        if span < _MIN_SPAN * side:
            texts.append(f'positions: a span of {span:.2g} m along {axis}, expected at least half '
                         f'of the {side:g} m of the region of interest')
    return texts
