"""Estimation of the surface from pilots of a reference user at known positions.

The mean signals are linear in the gains and offsets of the elements, and in the gain of each band.
Multipath and thermal noise are the noise of this linear model. Their covariance also contains the
multipath that leaks through the errors of the elements. As the estimates improve, less multipath
leaks, and the nulls of the beams, where errors are visible, gain weight. The estimation therefore
alternates between the posterior for a given covariance and the covariance for a given posterior.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from rhs_isac_ros.calibration.mixture import (
    SurfacePosterior,
    SurfacePrior,
    surface_posterior,
    without_data,
)
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Beamforming, Scenario, SurfaceEstimate
from rhs_isac_ros.model.arrays import blocks, checked_positions, numbers
from rhs_isac_ros.model.elements import direct_design, element_radiation, scattered_errors
from rhs_isac_ros.model.gaussian import covariance_root, quadratic_form, step_to_maximum
from rhs_isac_ros.model.impairments import UNIFORM_STD_RAD, Nuisance, nuisance_of
from rhs_isac_ros.model.measurement import MeasurementModel, signal_covariance
from rhs_isac_ros.support.threads import one_blas_thread

# Prior for scenarios that declare no errors or failures.
DEFAULT_ERROR_RMS = 0.05
DEFAULT_FAILED_SHARE = 0.01
_MAX_ROUNDS = 30
# The estimation has converged if no parameter moves by more than this, in standard deviations.
TOLERANCE = 0.02
# Share of the largest variance below which a direction of the covariance is dropped.
_MIN_VARIANCE = 1e-12
# Number of pilots evaluated at a time.
_BLOCK = 64
# Number of steps in the alignment of signals with unknown impairments.
_ALIGNMENT_STEPS = 6
# Share of the pilots that should have a direct path above which misfits cause a warning.
MAX_UNEXPLAINED = 1 / 3
# Least power of signals and residuals, relative to thermal noise.
_MIN_POWER = 1e-6
# Distance of positions that count as one place [wavelengths of the lowest band]. Places then
# extend over half a wavelength, beyond which the phases of paths differ.
_WAVELENGTHS = 0.25


@dataclasses.dataclass(frozen=True, eq=False)
class Pilots:
    """Signals of a reference user at known positions, received with one codebook.

    `positions` are float64 [N, 3] [m]; `received` are complex128 [N, N_B, N_SB F], sub-band-major.
    Raises ValueError if a shape is wrong or a number is not finite.

    Examples
    --------
    >>> system = System(Scenario(), Codebook.default())
    >>> pilots = Pilots(system.codebook, *system.pairs(20, seed=1))
    >>> calibrate(system.scenario, [pilots]).surface.gains.shape
    (100,)
    """

    beams: Beamforming
    positions: np.ndarray
    received: np.ndarray

    def __post_init__(self) -> None:
        """Check the arrays."""
        object.__setattr__(self, 'positions', checked_positions(self.positions))
        n_bands, n_subbands, n_frames, _ = self.beams.digital.shape
        object.__setattr__(self, 'received', numbers('received', self.received, complex, shapes=[
            (len(self.positions), n_bands, n_subbands * n_frames)]))


def prior_of(scenario: Scenario) -> SurfacePrior:
    """Return the prior that a scenario declares, with defaults for fields that are zero."""
    # Failed elements are described by amplitudes.
    failed_share = DEFAULT_FAILED_SHARE * scenario.board.is_amplitude
    return SurfacePrior(scenario.element_error_rms or DEFAULT_ERROR_RMS,
                        scenario.failed_element_share or failed_share)


def places_of(scenario: Scenario, positions: np.ndarray, wavelengths: float) -> list[np.ndarray]:
    """Group positions, float64 [N, 3] [m], by place; return the indices of each place.

    The first position that belongs to no place begins one, which contains all further positions
    within a distance of so many wavelengths of the lowest band. A route is therefore divided into
    places of about this length.
    """
    distance_m = wavelengths * SPEED_OF_LIGHT_MPS / min(scenario.center_frequencies_hz)
    left, places = np.arange(len(positions)), []
    while len(left):
        is_close = np.linalg.norm(positions[left] - positions[left[0]], axis=1) <= distance_m
        places.append(left[is_close])
        left = left[~is_close]
    return places


def weights_of(places: Sequence[np.ndarray], counts: np.ndarray) -> np.ndarray:
    """Return weights [N] of positions; those of a place share a weight of 1.

    Positions that are False in `counts`, bool [N], have no weight.
    """
    weights = np.zeros(len(counts))
    for rows in places:
        weights[rows] = counts[rows] / max(counts[rows].sum(), 1)
    return weights


def check_pilots(scenario: Scenario, pilots: Sequence[Pilots]) -> None:
    """Raise ValueError if positions are far from the region, or signals are weaker than noise."""
    (low, high), limit_m = scenario.roi_bounds_m, max(scenario.roi_size_m)
    for group in pilots:
        outside_m = np.max([low - group.positions, group.positions - high], axis=(0, 2))
        if outside_m.max(initial=0.0) > limit_m:
            row = int(np.argmax(outside_m))
            raise ValueError(
                f'positions: {outside_m[row]:.3g} m outside of the region of interest in row '
                f'{row}, expected at most its longest side, {limit_m:g} m, in metres and in the '
                'frame of the surface')
        check_power(scenario, group.received, 'signals')


def check_power(scenario: Scenario, signals: np.ndarray, kind: str) -> None:
    """Raise ValueError if signals or residuals, [N, N_B, R], are far weaker than the noise."""
    power_w = np.mean(np.abs(signals)**2, axis=2)
    if (power_w < _MIN_POWER * scenario.noise_power_w).any():
        row, band = np.argwhere(power_w == power_w.min())[0].tolist()
        raise ValueError(
            f'received: {kind} of {power_w[row, band]:.3g} W in row {row}, band {band}, expected '
            f'signals with noise, whose power is {scenario.noise_power_w:.3g} W')


def residuals_of(model: MeasurementModel, pilots: Pilots) -> np.ndarray:
    """Remove the likeliest impairments and the mean from the pilots; return [N, N_B, R]."""
    _, aligned, mean = _aligned(model, pilots)
    return aligned - mean


def log_evidence(model: MeasurementModel, pilots: Pilots) -> np.ndarray:
    """Return the logarithm of the density of each pilot, without a constant, float64 [N].

    Impairments are integrated out by the method of Laplace.
    """
    nuisance, (values, aligned, mean) = nuisance_of(model.scenario), _aligned(model, pilots)
    share = nuisance.share_of_multipath(model.root, model.whitener)
    gains = nuisance.scaled_patterns.real.reshape(len(nuisance), mean[0].size)
    for _ in range(_ALIGNMENT_STEPS if gains.any() else 0):
        # The energy of the multipath tells gains as well as the direct path does.
        residual = model.whiten(aligned - mean)
        gradient = 2 * np.einsum('nqir,nir->nq', np.conj(model.whiten(
            nuisance.scaled_patterns * aligned[:, None])), residual).real
        excess = np.maximum(np.mean(np.abs(residual)**2, axis=(1, 2)), 1)
        values = values + step_to_maximum(
            _curvature(nuisance, model.whiten(nuisance.derivatives(aligned, mean, share)))
            + 4 * excess[:, None, None] * (gains @ gains.T),
            gradient - 2 * gains.sum(axis=1) - nuisance.precision * values)
        aligned = nuisance.divide(pilots.received, values)
    energy = np.sum(np.abs(model.whiten(aligned - mean))**2, axis=(1, 2))
    log_root = np.sum(np.linalg.slogdet(model.combined_root)[1])
    log_gain = np.sum(np.log(np.abs(nuisance.divide(np.ones_like(mean), values))), axis=(1, 2))
    curvature = 4 * gains @ gains.T + _curvature(
        nuisance, model.whiten(nuisance.derivatives(aligned, mean, share)))
    return 2 * (log_gain - log_root) - energy - (
        values**2 @ nuisance.precision + np.linalg.slogdet(curvature)[1]) / 2


def _aligned(model: MeasurementModel, pilots: Pilots
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the likeliest impairments [N, Q], the pilots without them, and the mean."""
    nuisance, mean = nuisance_of(model.scenario), model.mean(pilots.positions)
    share = nuisance.share_of_multipath(model.root, model.whitener)
    values = initial_values(nuisance, model.whiten(pilots.received), model.whiten(mean))
    for _ in range(_ALIGNMENT_STEPS if len(nuisance) else 0):
        values = refined_values(nuisance, values, pilots.received, mean, model.whiten, share)
    return values, nuisance.divide(pilots.received, values), mean


@one_blas_thread
def estimate_surface(
        scenario: Scenario, pilots: Sequence[Pilots], prior: SurfacePrior
) -> tuple[SurfaceEstimate, list[float]]:
    """Estimate a surface from pilots of one or several codebooks.

    Also returns the largest change of a parameter in each round, in standard deviations. Without
    pilots, there is no round, and the estimate is the prior.
    """
    statistics = PilotStatistics(scenario, pilots)
    n_bands, n = scenario.n_bands, 2 * scenario.n_elements
    band_rms = _band_rms(scenario, prior)
    gains, posterior = np.ones(n_bands, complex), without_data(prior, band_rms, n // 2)
    changes: list[float] = []
    for _ in range(_MAX_ROUNDS if any(len(group.positions) for group in pilots) else 0):
        information, shift = statistics.evaluate(
            gains, posterior.mean[:n], posterior.covariance[:n, :n])
        before, posterior = posterior, surface_posterior(
            information, shift, prior, band_rms, posterior.failed)
        gains = gains * (1 + posterior.mean[n:])
        changes.append(_change(before, posterior, n_bands))
        if changes[-1] < TOLERANCE:
            break
    mean, n = posterior.mean, scenario.n_elements
    values, vectors = np.linalg.eigh(posterior.covariance)
    kept = values > _MIN_VARIANCE * max(values[-1], 0.0)
    return SurfaceEstimate(
        mean[:n], mean[n:2 * n], gains, vectors[:, kept] * np.sqrt(values[kept]),
        posterior.failed_probability), changes


def initial_values(nuisance: Nuisance, white: np.ndarray, white_mean: np.ndarray) -> np.ndarray:
    """Estimate, one by one, nuisance values [N, Q] that only rotate whole bands; others are 0."""
    values = np.zeros((len(white), len(nuisance)))
    outputs = np.sum(np.conj(white_mean) * white, axis=2)
    for q in np.flatnonzero(nuisance.phases.any(axis=0)):
        turns = nuisance.phases[:, q]
        output = outputs[:, turns != 0].sum(axis=1)
        turn, magnitude = turns[turns != 0].mean(), 2 * np.abs(output)
        values[:, q] = turn * magnitude * np.angle(output) / (
            turn**2 * magnitude + nuisance.precision[q])
        outputs = outputs * np.exp(-1j * values[:, q, None] * turns)
    return values


def refined_values(nuisance: Nuisance, values: np.ndarray, signals: np.ndarray, mean: np.ndarray,
                   whiten: Callable[[np.ndarray], np.ndarray], share: np.ndarray) -> np.ndarray:
    """Improve nuisance values [N, Q] by a scoring step, for signals [N, N_B, N_SB F].

    `share` is that of `Nuisance.share_of_multipath`.
    """
    aligned = nuisance.divide(signals, values)
    gradient = _gradient(nuisance, aligned, mean, whiten) - nuisance.precision * values
    slopes = whiten(nuisance.derivatives(aligned, mean, share))
    return values + step_to_maximum(_curvature(nuisance, slopes), gradient)


def _gradient(nuisance: Nuisance, aligned: np.ndarray, mean: np.ndarray,
              whiten: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the gradient of the likelihood with respect to nuisance values, [N, Q]."""
    slopes, residual = whiten(nuisance.derivatives(aligned, mean)), whiten(aligned - mean)
    return 2 * np.einsum('nqir,nir->nq', np.conj(slopes), residual).real


def _curvature(nuisance: Nuisance, slopes: np.ndarray) -> np.ndarray:
    """Return the curvature [N, Q, Q] that results from whitened slopes and the prior."""
    return quadratic_form(slopes) + np.diag(nuisance.precision)


def _band_rms(scenario: Scenario, prior: SurfacePrior) -> np.ndarray:
    """Return the prior RMS of real and imaginary parts of the bands' gain errors, [2, N_B]."""
    # Pilots cannot distinguish random gains and uniform phases of the signals from gains and
    # phases of the bands. For each of them, the gain or phase of one band is therefore fixed.
    rms = np.full((2, scenario.n_bands), prior.band_gain_rms / np.sqrt(2))
    nuisance = nuisance_of(scenario)
    phases = nuisance.phases
    uniform = phases[:, np.abs(phases).max(axis=0, initial=0) > UNIFORM_STD_RAD]
    for part, directions in zip(rms, (nuisance.scaled_patterns.real.mean(axis=2).T, uniform),
                                strict=True):
        # NumPy 1.26 has no rank of an empty matrix.
        part[:np.linalg.matrix_rank(directions) if directions.size else 0] = 0.0
    return rms


def _change(before: SurfacePosterior, after: SurfacePosterior, n_bands: int) -> float:
    """Return the largest change, in standard deviations; band parameters are already changes."""
    moved = np.abs(after.mean - before.mean)
    moved[-n_bands:] = np.abs(after.mean[-n_bands:])
    std = np.sqrt(np.maximum(np.diagonal(after.covariance).real, 1e-300))
    return float(np.max(moved / np.maximum(std, 1e-9)))


class PilotStatistics:
    """Information in pilots about a surface, given the covariance of the noise.

    The P = 2 N_E + N_B parameters are gains and offsets of the elements, and relative errors of
    the bands' gains. Declared nuisance parameters have different values for each pilot. Each round
    improves these values by a scoring step and integrates over the remaining uncertainty.
    """

    def __init__(self, scenario: Scenario, pilots: Sequence[Pilots]) -> None:
        self._scenario, self._pilots = scenario, pilots
        self._radiation = [element_radiation(scenario, group.beams) for group in pilots]
        self._size = 2 * scenario.n_elements + scenario.n_bands
        self._nuisance = nuisance_of(scenario)
        self._weights = [weights_of(places_of(scenario, group.positions, _WAVELENGTHS),
                                    np.ones(len(group.positions), bool)) for group in pilots]
        # Nuisance values by number of the group and first pilot of the block.
        self._values: dict[tuple[int, int], np.ndarray] = {}

    def evaluate(self, gains: np.ndarray, mean: np.ndarray, covariance: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the `information` [2 P, 2 P] and `shift` [2 P] for `surface_posterior`.

        The model is linearised about the band gains `gains`, complex128 [N_B]. `mean` and
        `covariance` describe the gains and offsets of elements, [2 N_E] and [2 N_E, 2 N_E].
        """
        size = self._size
        normal, product = np.zeros((size, size), complex), np.zeros(size, complex)
        lost, moved = np.zeros((2 * size, 2 * size)), np.zeros(2 * size)
        for number, (group, radiation) in enumerate(
                zip(self._pilots, self._radiation, strict=True)):
            whiteners = self._whiteners(radiation, gains, mean, covariance)
            share = self._nuisance.share_of_multipath(np.linalg.inv(whiteners), whiteners)
            for block in blocks(len(group.positions), _BLOCK):
                part = _Block(self._scenario, radiation, whiteners, group.positions[block], mean,
                              self._weights[number][block])
                signals = group.received[block] / gains[:, None]
                if len(self._nuisance):
                    signals, *known = self._linearised(
                        part, signals, share, (number, block.start))
                    of_values = self._integrated(part, *known)
                    lost, moved = lost + of_values[0], moved + of_values[1]
                whitened = np.swapaxes(part.whiten(signals), 0, 1)
                for columns, white in zip(part.columns, whitened, strict=True):
                    flat = columns.reshape(-1, size)
                    normal += np.conj(flat.T) @ flat
                    product += np.conj(flat.T) @ white.reshape(-1)
        information = 2 * np.block([[normal.real, -normal.imag], [normal.imag, normal.real]])
        return information - lost, 2 * np.concatenate([product.real, product.imag]) - moved

    def _whiteners(self, radiation: np.ndarray, gains: np.ndarray, mean: np.ndarray,
                   covariance: np.ndarray) -> np.ndarray:
        """Return whiteners of the signals divided by the gains of the bands."""
        scenario, n = self._scenario, self._scenario.n_elements
        expected = radiation[..., :n] * mean[:n] + radiation[..., n:] * mean[n:]
        total = signal_covariance(scenario, expected)
        total += scattered_errors(scenario, radiation, covariance)
        # The gain does not act on thermal noise.
        excess = scenario.noise_power_w * (1 / np.abs(gains)**2 - 1)
        total += excess[:, None, None] * np.eye(total.shape[1])
        return np.linalg.inv(covariance_root(scenario, total))

    def _linearised(self, part: '_Block', signals: np.ndarray, share: np.ndarray,
                    key: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Improve a block's nuisance values, and linearise its signals about them.

        Returns linearised signals, whitened slopes, and their inner product with the signals.
        """
        nuisance, values = self._nuisance, self._values.get(key)
        if values is None:
            values = initial_values(nuisance, part.whiten(signals), part.whiten(part.mean))
        self._values[key] = values = refined_values(
            nuisance, values, signals, part.mean, part.whiten, share)
        aligned = nuisance.divide(signals, values)
        slopes = nuisance.derivatives(aligned, part.mean, share)
        change, white = np.einsum('nq,nqir->nir', values, slopes), part.whiten(slopes)
        # The gradient contains all of the received multipath.
        of_signals = _gradient(nuisance, aligned, part.mean, part.whiten) + 2 * np.einsum(
            'nqir,nir->nq', np.conj(white), part.whiten(part.mean + change)).real
        return aligned + change, white, of_signals

    def _integrated(self, part: '_Block', slopes: np.ndarray, of_signals: np.ndarray
                    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the information [2 P, 2 P] and shift [2 P] lost to unknown nuisance values."""
        coupling = sum(np.einsum('nqr,nrp->nqp', np.conj(slopes[:, :, band]), columns)
                       for band, columns in enumerate(part.columns))
        coupling = 2 * np.concatenate([coupling.real, -coupling.imag], axis=2)
        regression = np.linalg.solve(_curvature(self._nuisance, slopes), coupling)
        flat = regression.reshape(-1, regression.shape[2])
        return coupling.reshape(flat.shape).T @ flat, of_signals.reshape(-1) @ flat


class _Block:
    """Linear model of several pilots, with weights, [N], of their information.

    `columns` are the whitened derivatives of the signals, complex128 [N_B, N, N_SB F, P], and
    `mean` the expected signals, complex128 [N, N_B, N_SB F].
    """

    def __init__(self, scenario: Scenario, radiation: np.ndarray, whiteners: np.ndarray,
                 positions: np.ndarray, mean: np.ndarray, weights: np.ndarray) -> None:
        self._whiteners, self._scales = whiteners, np.sqrt(weights)
        (n_bands, n_rows, n), n_pilots = radiation.shape, len(positions)
        self.mean = np.empty((n_pilots, n_bands, n_rows), complex)
        self.columns = np.zeros((n_bands, n_pilots, n_rows, n + n_bands), complex)
        for band, whitener in enumerate(whiteners):
            design = direct_design(scenario, radiation, band, positions)
            self.mean[:, band] = design @ mean
            self.columns[band, ..., :n] = np.matmul(whitener, design)
            self.columns[band, ..., n + band] = self.mean[:, band] @ whitener.T
        self.columns *= self._scales[:, None, None]

    def whiten(self, signals: np.ndarray) -> np.ndarray:
        """Whiten and weight signals [N, ..., N_B, N_SB F]."""
        return np.einsum('irs,n...is,n->n...ir', self._whiteners, signals, self._scales)
