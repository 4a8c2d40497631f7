"""Covariance of the multipath in one hall from signals at known positions.

The residuals of N positions have the sample covariance S. With an inverse Wishart prior of weight
nu, whose mean L_0 is the covariance declared by three fields of the scenario, the posterior mean,
inflated by t, is

    L = t (nu L_0 + N S) / (nu + N).

The fields and nu maximise the evidence. L is close to the declared covariance for few positions,
and to the sample covariance for many. If the multipath consists of a few strong paths, it is not
Gaussian, and positioning errors would exceed the bound with t = 1. Each position is therefore left
out in turn, and t is chosen so that about 95 % of the errors are in the 95 % region of the local
bound, and 99 % of the residuals pass their test. In small surveys, t is close to a usual value.

Positions are excluded if their signals are more probable as multipath of an unknown level, without
a direct path.
"""

import dataclasses
import itertools
import warnings
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.calibration.estimate import Pilots, initial_values, refined_values
from rhs_isac_ros.model import Beamforming, MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import adjoint
from rhs_isac_ros.model.gaussian import (
    BLOCKED_STD_DB,
    energy_limit,
    log_evidence_of_level,
    share_of_level,
)
from rhs_isac_ros.model.geometry import region_information
from rhs_isac_ros.model.hall import CONDITIONS, FIELDS, MultipathEstimate
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.measurement import Surface
from rhs_isac_ros.support.threads import one_blas_thread

# Share of errors that should be in the region of the local bound, and share of residuals that
# should pass their test.
COVERAGE = 0.95
_PASSING = 0.99
# Inflation t without positions, and the weight of this value, in positions. It is a margin for
# small surveys, in which the quantiles above are uncertain.
_INFLATION, _INFLATION_WEIGHT = 1.8, 40
# Usual standard deviation of the level of users in sight [dB], with the same weight.
_LEVEL_STD_DB = 1.2
# Surveys with fewer positions, or that span a smaller share of a side, cause a warning.
MIN_POSITIONS = 20
_MIN_SPAN = 0.5
# Limits of delay spreads in units of the inverse bandwidth, angular spreads [deg], levels [dB] and
# prior weights.
_DELAYS, _ANGLES, _LEVELS, _WEIGHTS = (1e-3, 10.0), (0.5, 300.0), (-80.0, 60.0), (0.5, 1e4)
# Initial steps of the search: level [dB], and logarithms of the other parameters.
_STEPS = (3.0, 1.0, 0.7, 1.0)
# Prior probability of a blocked position if the scenario declares none, and its upper limit.
_BLOCKED_PROBABILITY, _MAX_BLOCKED = 0.1, 0.9
# Maximum number of rounds of alignment, estimation and search for blocked positions, and number of
# steps of each alignment.
_ROUNDS, _ALIGNMENT_STEPS = 4, 6


class SurveyWarning(UserWarning):
    """A survey is too small, or covers only part of the region."""


@one_blas_thread
def survey(scenario: Scenario, codebook: Beamforming, positions: np.ndarray,
           received: np.ndarray, surface: Surface | None = None) -> MultipathEstimate:
    """Estimate the covariance of the multipath from signals at known positions.

    `positions`, float64 [N, 3] [m], should be spread over the region of interest; `received` are
    complex128 [N, N_B, N_SB F], sub-band-major. The declared level and spreads of the multipath
    affect only the start of the search. Declared impairments are estimated for each position. The
    result is a value of `Scenario.multipath`; its `about` contains the expected coverage.

    Raises ValueError if a shape is wrong, a number is not finite, or there is no position. Warns
    with SurveyWarning if fewer than `MIN_POSITIONS` positions have a direct path, or if these span
    less than half of a side of the region.
    """
    from scipy.stats import binomtest

    pilots = Pilots(codebook, np.asarray(positions, float), np.asarray(received, complex))
    n = len(pilots.positions)
    if not n:
        raise ValueError('positions: none given, expected at least one')
    fit = _fitted(dataclasses.replace(scenario, multipath=None), pilots, surface)
    model, n_sight = MeasurementModel(fit.fields, codebook, surface), int(fit.in_sight.sum())
    distances, energies = _left_out(
        model, pilots.positions[fit.in_sight], fit.residuals[fit.in_sight], fit.total,
        fit.weight + n_sight - 1)
    n_measurements = int(np.prod(model.shape))
    level_std_db = _level_std_db(energies, n_measurements)
    # Estimators scale the covariance of a position by the level that the residual indicates.
    relative = energies / n_measurements
    distances = distances / relative**share_of_level(n_measurements, level_std_db)
    inflation = _inflation(distances, energies, n_measurements)
    measured, declared = inflation * fit.total / (fit.weight + n_sight), model.covariance()
    inverse = np.linalg.inv(declared)
    excess = inverse @ (measured - declared) @ inverse
    texts = _warnings(scenario, pilots.positions[fit.in_sight])
    if texts:
        warnings.warn('; '.join(texts), SurveyWarning, stacklevel=3)
    inside = int(np.sum(distances <= inflation * _radius()))
    interval = binomtest(inside, n_sight).proportion_ci(method='wilson')
    about: dict[str, Any] = {
        'positions': n_sight, 'blocked': n - n_sight, 'prior_weight': fit.weight,
        'inflation': inflation, 'level_std_db': level_std_db,
        'coverage': [inside / n_sight, *map(float, interval)],
        'warnings': texts, 'codebook': str(getattr(codebook, 'id', '')), 'version': __version__}
    plain = scenario.fields()
    return MultipathEstimate(
        **{name: getattr(fit.fields, name) for name in FIELDS},
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
        f'fields: multipath / direct path {estimate.multipath_to_los_db:.1f} dB, delay spread '
        f'{1e9 * estimate.delay_spread_s:.0f} ns, angular spread '
        f'{estimate.angular_spread_deg:.1f} deg; they weigh as much as '
        f'{about["prior_weight"]:.1f} positions',
        f'inflation of the covariance: {about["inflation"]:.2f}; {coverage:.1f} % '
        f'[{low:.1f}, {high:.1f}] of the positions left out are in the 95 % region',
        *(f'warning: {text}' for text in about['warnings'])])


class _Fit(NamedTuple):
    """The most likely fields of the scenario, and the residuals that led to them."""

    # Scenario with the fields, and weight of the prior in positions.
    fields: Scenario
    weight: float
    # Residuals of all positions, complex128 [N, N_B, R]; and whether there is a direct path [N].
    residuals: np.ndarray
    in_sight: np.ndarray
    # `weight` times the declared covariance, plus e e^H of all residuals e in sight, [N_B, R, R].
    total: np.ndarray


def _fitted(fields: Scenario, pilots: Pilots, surface: Surface | None) -> _Fit:
    """Fit fields, impairments and blocked positions in turn."""
    has_nuisance, in_sight = len(nuisance_of(fields)) > 0, np.ones(len(pilots.positions), bool)
    for _ in range(_ROUNDS):
        model = MeasurementModel(fields, pilots.beams, surface)
        residuals, n = _residuals(model, pilots), int(in_sight.sum())
        sample = np.einsum('nir,nis->irs', residuals[in_sight], residuals[in_sight].conj())
        fields, weight = _most_likely(fields, model, sample / n, n)
        model = MeasurementModel(fields, pilots.beams, surface)
        fit = _Fit(fields, weight, residuals, in_sight, weight * model.covariance() + sample)
        in_sight = _in_sight(
            model, pilots.positions, residuals, in_sight, fit.total, weight + n)
        if (in_sight == fit.in_sight).all() and not has_nuisance:
            break
    return fit


def _residuals(model: MeasurementModel, pilots: Pilots) -> np.ndarray:
    """Remove the likeliest impairments and the mean from the pilots; return [N, N_B, R]."""
    nuisance, mean = nuisance_of(model.scenario), model.mean(pilots.positions)
    values = initial_values(nuisance, model.whiten(pilots.received), model.whiten(mean))
    for _ in range(_ALIGNMENT_STEPS if len(nuisance) else 0):
        values = refined_values(nuisance, values, pilots.received, mean, model.whiten)
    return nuisance.divide(pilots.received, values) - mean


def _most_likely(scenario: Scenario, model: MeasurementModel, sample: np.ndarray, n: int
                 ) -> tuple[Scenario, float]:
    """Return the scenario fields and the prior weight with the highest evidence."""
    from scipy.optimize import minimize

    bandwidth_hz = scenario.n_subbands * scenario.subband_width_hz
    low, high = np.array([
        _LEVELS, np.log(_DELAYS) - np.log(bandwidth_hz), np.log(_ANGLES), np.log(_WEIGHTS)]).T

    def declaring(point: np.ndarray) -> Scenario:
        level, delay, angle = np.clip(point, low, high)[:3].tolist()
        return dataclasses.replace(
            scenario, **dict(zip(FIELDS, (level, np.exp(delay), np.exp(angle)), strict=True)))

    def cost(point: np.ndarray) -> float:
        covariance = MeasurementModel(
            declaring(point), model.beams, model.surface).covariance()
        return -_log_evidence(covariance, sample, n, float(np.exp(np.clip(point, low, high)[3])))

    # The level follows from the power, at least if the noise is weak.
    power = np.trace(sample, axis1=1, axis2=2).real.sum()
    power /= np.trace(model.covariance(), axis1=1, axis2=2).real.sum()
    level = scenario.multipath_to_los_db + 10 * np.log10(max(power, 1e-12))
    starts = [np.clip([level, np.log(delay), np.log(angle), np.log(len(sample[0]))], low, high)
              for delay, angle in itertools.product(
                  (max(scenario.delay_spread_s, 1e-12), 0.05 / bandwidth_hz),
                  (scenario.angular_spread_deg, 30.0))]
    start = min(starts, key=cost)
    steps = np.where(start + _STEPS < high, _STEPS, -np.array(_STEPS))
    found = minimize(cost, start, method='Nelder-Mead', options={
        'initial_simplex': np.vstack([start, start + np.diag(steps)]),
        'xatol': 0.02, 'fatol': 0.05, 'maxiter': 400})
    return declaring(found.x), float(np.exp(np.clip(found.x, low, high)[3]))


def _log_evidence(declared: np.ndarray, sample: np.ndarray, n: int, weight: float) -> float:
    """Return the log evidence of n residuals, up to a constant.

    The covariances of the bands are inverse Wishart variables with the mean `declared`, complex128
    [N_B, R, R], and ``weight + R`` degrees of freedom.
    """
    from scipy.special import gammaln

    n_bands, size = declared.shape[:2]
    degrees = weight + size
    volume = np.sum(gammaln(degrees + n - np.arange(size)) - gammaln(degrees - np.arange(size)))
    before = np.linalg.slogdet(weight * declared)[1].sum()
    after = np.linalg.slogdet(weight * declared + n * sample)[1].sum()
    return float(n_bands * volume + degrees * before - (degrees + n) * after)


def _left_out(model: MeasurementModel, positions: np.ndarray, residuals: np.ndarray,
              total: np.ndarray, n_others: float) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate each position under the covariance of all others, ``(total - e e^H) / n_others``.

    `total` is complex128 [N_B, R, R]; the residuals e are complex128 [N, N_B, R]. An error is a
    scoring step from the true position, with unknown nuisance parameters. Returns the squared
    Mahalanobis distances of the errors, and the energies of the residuals [N].
    """
    whitener = np.linalg.inv(np.linalg.cholesky(total))
    nuisance = nuisance_of(model.scenario).scaled_patterns
    mean, by_position = model.mean_and_jacobian(positions)
    slopes = np.concatenate([by_position, nuisance * mean[:, None]], axis=1)
    white = np.einsum('irs,nis->nir', whitener, residuals)
    columns = np.einsum('irs,nais->nair', whitener, slopes)
    # total - e e^H is a rank-one update, so its inverse is known; e^H total^-1 e is below 1.
    own = 1 / (1 - np.sum(np.abs(white)**2, axis=2))
    products = np.einsum('nair,nir->nai', columns.conj(), white)
    information = np.einsum('nair,nbir->nab', columns.conj(), columns) + np.einsum(
        'nai,nbi,ni->nab', products, products.conj(), own)
    prior = np.eye(information.shape[1])
    prior[:3, :3] = region_information(model.scenario)
    information = 2 * n_others * information.real + prior
    gradient = 2 * n_others * np.einsum('nai,ni->na', products[:, :3], own).real
    covariance = np.linalg.inv(information)[:, :3, :3]
    return (np.einsum('na,nab,nb->n', gradient, covariance, gradient),
            n_others * np.sum(own - 1, axis=1))


def _in_sight(model: MeasurementModel, positions: np.ndarray, residuals: np.ndarray,
              in_sight: np.ndarray, total: np.ndarray, weight: float) -> np.ndarray:
    """Mark positions that probably have a direct path, bool [N]; if there are none, mark all.

    Without a direct path, signals are multipath of an unknown level. With one, the level varies as
    much as it does among the positions marked in `in_sight`. `total`, complex128 [N_B, R, R], is
    the sum of e e^H over their residuals e, plus the prior covariance times its weight; `weight`
    is that weight plus their number.
    """
    whitener = np.linalg.inv(np.linalg.cholesky(total))
    with_path = np.einsum('irs,nis->nir', whitener, residuals)
    without = with_path + np.einsum('irs,nis->nir', whitener, model.mean(positions))
    # A position must not explain itself: its own rank-one term is removed from the total.
    share, counts = np.sum(np.abs(with_path)**2, axis=2), in_sight[:, None]
    cross = np.abs(np.sum(with_path.conj() * without, axis=2))**2
    others = weight - in_sight
    energy = others * np.sum(share / (1 - share * counts), axis=1)
    energy_without = others * np.sum(
        np.sum(np.abs(without)**2, axis=2) + counts * cross / (1 - share * counts), axis=1)
    n_measurements = int(np.prod(model.shape))
    blocked = log_evidence_of_level(energy_without, n_measurements, BLOCKED_STD_DB)
    sight = log_evidence_of_level(
        energy, n_measurements, _level_std_db(energy[in_sight], n_measurements))
    prior = min(model.scenario.blocked_probability or _BLOCKED_PROBABILITY, _MAX_BLOCKED)
    log_odds = np.log(1 / prior - 1) + sight - blocked
    result = log_odds > 0
    return result if result.any() else np.ones(len(result), bool)


def _inflation(distances: np.ndarray, energies: np.ndarray, n_measurements: int) -> float:
    """Return the inflation t, which is close to `_INFLATION` in small surveys."""
    most = max(1.0, float(energies.mean()) / n_measurements,
               float(np.quantile(distances, COVERAGE)) / _radius(),
               float(np.quantile(energies, _PASSING)) / energy_limit(n_measurements))
    weights = np.array([len(energies), _INFLATION_WEIGHT])
    return float(np.exp(weights @ np.log([most, _INFLATION]) / weights.sum()))


def _level_std_db(energies: np.ndarray, n_measurements: int) -> float:
    """Return the standard deviation of the level among users [dB], from residual energies."""
    n = len(energies)
    # Energies of Gaussian residuals vary even if the residuals have equal power.
    excess = max(float(np.var(np.log(energies))) - 1 / n_measurements, 0.0)
    usual = (np.log(10) / 10 * _LEVEL_STD_DB)**2
    variance = (n * excess + _INFLATION_WEIGHT * usual) / (n + _INFLATION_WEIGHT)
    return float(10 / np.log(10) * np.sqrt(variance))


def _radius() -> float:
    """Return the squared Mahalanobis radius of the region of probability `COVERAGE`."""
    from scipy.special import chdtri

    return float(chdtri(3, 1 - COVERAGE))


def _warnings(scenario: Scenario, positions: np.ndarray) -> list[str]:
    """Return reasons why the estimate may not hold in the whole region."""
    texts = []
    if len(positions) < MIN_POSITIONS:
        texts.append(f'positions: {len(positions)}, expected at least {MIN_POSITIONS} for a '
                     'covariance of this hall rather than of its most similar declaration')
    spans = np.ptp(positions, axis=0)
    for axis, span, side in zip('xyz', spans.tolist(), scenario.roi_size_m, strict=True):
        if span < _MIN_SPAN * side:
            texts.append(f'positions: a span of {span:.2g} m along {axis}, expected at least half '
                         f'of the {side:g} m of the region of interest')
    return texts
