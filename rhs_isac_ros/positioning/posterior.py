"""The posterior of a position: weighted samples of its modes, in the region of interest.

A mode is usually Gaussian. If it is inside the region, its samples there have equal weights. If
every band has an unknown phase of its own, only delays, amplitudes and the curvature of the
wavefront determine the range. A mode then extends over metres, across which the log-likelihood is
not quadratic and the volume element changes. Samples are then drawn from wider Gaussians, and each
is weighted by the posterior relative to the sum of their densities, so modes may overlap.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.impairments import UNIFORM_STD_RAD
from rhs_isac_ros.positioning.coordinates import (
    carrier_wavenumbers,
    is_inside,
    jacobian,
    likelihood_loss,
    select,
    to_polar,
    to_positions,
)
from rhs_isac_ros.positioning.estimate import Estimate
from rhs_isac_ros.positioning.grid import first_of_each
from rhs_isac_ros.positioning.likelihood import Conditional, Likelihood, Signals
from rhs_isac_ros.positioning.search import Modes, marginal_at

# Factor by which a proposal is wider than its Gaussian, because the tails of the posterior may be
# heavier.
_SPREAD = 1.3
# Samples with a log-weight below the best by more than this have no effect, whatever their phases.
_LIKELY_MARGIN = 20.0
# Averages over the phases of the bands: spacing of the ranges, in standard deviations of the
# product of the bands' factors; and number of values of a phase that all bands share, few because
# the average over the range nearly removes the effect of this phase.
_SPACING = 1.5
_N_COMMON = 8
# Largest standard deviation of a wrapped phase: it is nearly uniform, and one wrap suffices.
_MAX_STD_RAD = 3.0


class Posterior(NamedTuple):
    """The posterior of one positioning phase, for a uniform prior on the region of interest."""

    estimate: Estimate
    modes: Modes | None  # None without a position.
    signals: Signals  # Signals of the phase, N = 1.


class Samples(NamedTuple):
    """Samples of the Gaussians of M modes, S samples per mode."""

    positions: np.ndarray  # Float64 [M, S, 3] [m].
    log_weights: np.ndarray  # Not normalised, float64 [M, S]; -inf outside of the region.
    spread: np.ndarray  # Factor of the covariance of each mode's position, float64 [M, 3, 3] [m].


def draw_samples(modes: Modes, normal: np.ndarray, bounds: np.ndarray) -> Samples:
    """Represent the modes by samples, for a uniform prior between the bounds [2, 3] of the region.

    `normal`, float64 [S, 3], contains points that represent a standard Gaussian. If no sample of a
    phase is inside the region, all of them are moved onto its border.
    """
    points, curvature, roi_offset = modes.points, modes.curvature, modes.roi_offset
    starts = first_of_each(modes.phases)
    jacobians = jacobian(points)
    log_mass = (modes.log_likelihood + np.log(np.linalg.det(jacobians))
                - np.log(np.linalg.det(curvature)) / 2)
    factors = np.linalg.inv(np.swapaxes(np.linalg.cholesky(curvature), 1, 2))
    # The Gaussian of a mode outside the region is sampled around its most likely point inside;
    # the weights of the samples correct for the shift.
    shift = np.linalg.solve(factors, roi_offset[..., None])[..., 0]
    log_weights = (log_mass[:, None] - shift @ normal.T
                   - likelihood_loss(roi_offset, curvature)[:, None])
    # Contiguous coordinates make the following operations several times as fast.
    spread = np.matmul(factors, normal.T)
    positions = to_positions(np.swapaxes((points + roi_offset)[..., None] + spread, 1, 2))
    inside = is_inside(positions, bounds)
    possible = np.logical_or.reduceat(inside.any(axis=1), starts)
    if not possible.all():
        lost = np.repeat(~possible, np.diff(starts, append=len(points)))
        positions[lost] = np.clip(positions[lost], *bounds)
        inside[lost] = True
    log_weights[~inside] = -np.inf
    return Samples(positions, log_weights, np.matmul(jacobians, factors))


class WeightedSamples(NamedTuple):
    """The samples of the posteriors of N phases, with weights whose sum is one for each phase."""

    positions: np.ndarray  # Float64 [M, S, 3] [m].
    weights: np.ndarray  # Float64 [M, S].
    spread: np.ndarray  # As in `Samples`.
    starts: np.ndarray  # Index of each phase's first mode, int [N].
    log_totals: np.ndarray  # Logarithms of the weights' sums before normalisation, float64 [N].

    @classmethod
    def of(cls, samples: Samples, modes: Modes) -> 'WeightedSamples':
        """Normalise the weights of each phase."""
        starts = first_of_each(modes.phases)
        counts = np.diff(starts, append=len(modes.phases))
        highest = np.maximum.reduceat(samples.log_weights.max(axis=1), starts)
        weights = np.exp(samples.log_weights - np.repeat(highest, counts)[:, None])
        totals = np.add.reduceat(weights.sum(axis=1), starts)
        weights /= np.repeat(totals, counts)[:, None]
        return cls(samples.positions, weights, samples.spread, starts, highest + np.log(totals))

    def log_evidence(self, volume_m3: float) -> np.ndarray:
        """Return the logarithm of the likelihood averaged over a region of this volume, [N]."""
        return (self.log_totals - np.log(self.weights.shape[1])
                + 1.5 * np.log(2 * np.pi) - np.log(volume_m3))

    def average(self, values: np.ndarray) -> np.ndarray:
        """Average values of the modes, float64 [M, ...], over each posterior, [N, ...]."""
        shares = self.weights.sum(axis=1).reshape(-1, *[1] * (values.ndim - 1))
        return self.sums(shares * values)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Add up values of the modes, float64 [M, ...], for each phase, [N, ...]."""
        return np.add.reduceat(values, self.starts)

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute the mean, float64 [N, 3] [m], and the covariance, [N, 3, 3], of the samples."""
        mean = self.sums(np.matmul(self.weights[:, None], self.positions)[:, 0])
        counts = np.diff(self.starts, append=len(self.weights))
        offsets = self.positions - np.repeat(mean, counts, axis=0)[:, None]
        weighted = np.swapaxes(offsets * self.weights[..., None], 1, 2)
        return mean, self.sums(np.matmul(weighted, offsets))


def draw_broad_samples(
        likelihood: Likelihood, conditionals: Sequence[Conditional], phases: 'BandPhases',
        signals: Signals, modes: Modes, normal: np.ndarray) -> Samples:
    """Represent the posterior of one phase by weighted samples of its widened modes.

    `conditionals` contains the likelihood for each state of the surface.
    """
    bounds = likelihood.resolution.bounds_m
    samples = draw_samples(modes, _SPREAD * normal, bounds)
    inside = np.isfinite(samples.log_weights)
    log_weights, positions = np.full(inside.shape, -np.inf), samples.positions.copy()
    for state in np.unique(modes.state):
        rows = modes.state == state
        chosen = inside & rows[:, None]
        points = to_polar(positions[chosen])
        values = np.repeat(modes.values, inside.sum(axis=1) * rows, axis=0)
        evidence, values = marginal_at(
            conditionals[state], likelihood, points, values, signals)
        evidence += (np.log(np.linalg.det(jacobian(points))) - 1.5 * np.log(2 * np.pi)
                     - _log_proposal(points, select(modes, rows)))
        if phases.is_informative:
            likely = evidence >= evidence.max() - _LIKELY_MARGIN
            outputs = likelihood.outputs(points[likely], values[likely], signals)
            turns = np.exp(1j * (likelihood.nuisance.phases @ values[likely].T))
            log_factors, offsets_m = phases.factors(outputs.T * turns)
            evidence[likely] += log_factors
            points[likely, 0] += offsets_m
            positions[chosen] = to_positions(points)
        log_weights[chosen] = evidence
    return samples._replace(positions=positions, log_weights=log_weights)


def _log_proposal(points: np.ndarray, modes: Modes) -> np.ndarray:
    """Return the logarithm of the summed densities from which samples are drawn, [P]."""
    # Expanded about a common centre, squared distances are matrix products, which are faster.
    centre = modes.roi_points.mean(axis=0)
    points, means = points - centre, modes.roi_points - centre
    spread = np.einsum('mab,mb->ma', modes.curvature, means)
    squares = (np.einsum('pa,pb->pab', points, points).reshape(-1, 9)
               @ modes.curvature.reshape(-1, 9).T)
    squares += np.einsum('ma,ma->m', means, spread) - 2 * points @ spread.T
    exponent = -squares / (2 * _SPREAD**2)
    exponent += np.linalg.slogdet(modes.curvature)[1] / 2
    return (np.logaddexp.reduce(exponent, axis=1) - 3 * np.log(_SPREAD) - 1.5 * np.log(2 * np.pi))


class BandPhases:
    """The information in band phases that the search treats as uniform although they are not.

    Compared with uniform phases, the likelihood of a position has one more factor per band: the
    density of the phase of its matched filter's output, a wrapped normal density that noise
    broadens. Along the range, the product of these factors oscillates with the carriers, far
    faster than the rest of the posterior. The product is therefore averaged over one wavelength
    around each sample.
    """

    def __init__(self, likelihood: Likelihood) -> None:
        prior = likelihood.nuisance
        self._std = prior.relative_phase_std_rad
        # Whether there is information that the search ignores; if not, there are no factors.
        self.is_informative = prior.is_coarse and self._std <= UNIFORM_STD_RAD
        if not self.is_informative:
            return
        wavenumbers = carrier_wavenumbers(likelihood.scenario)
        shared = max(prior.phase_covariance.min(), 0.0) if len(wavenumbers) > 1 else 0.0
        spacing = _SPACING * self._std / np.sqrt(len(wavenumbers))
        n_ranges = int(np.ceil(2 * np.pi / spacing))
        self._ranges_m = (((np.arange(n_ranges) + 0.5) / n_ranges - 0.5)
                          * 2 * np.pi / wavenumbers.mean())
        self._wavenumbers = wavenumbers
        self._common, self._log_weights = _common_phase(np.sqrt(shared))

    def factors(self, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Multiply the bands' factors at P positions, and average over one wavelength of range.

        `outputs`, [N_B, P], are the outputs of the matched filters. Returns the logarithm of the
        average, and the mean offset in range [m], [P] each.
        """
        all_turns = self._wavenumbers[:, None, None] * self._ranges_m[:, None] + self._common
        log_factor = np.zeros((outputs.shape[1], *all_turns.shape[1:]))
        for output, turns in zip(outputs, all_turns, strict=True):
            std = self._broadened(np.abs(output))[:, None, None]
            log_factor += _log_density(np.angle(output)[:, None, None] + turns, std)
        log_factor += self._log_weights - np.log(len(self._ranges_m))
        weights, log_total = mixture_weights(log_factor, axis=(1, 2))
        return log_total, weights.sum(axis=2) @ self._ranges_m

    def _broadened(self, magnitude: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the phase of noisy outputs, at most `_MAX_STD_RAD`."""
        # Noise gives the phase a von Mises density, which is approximated by the wrapped normal
        # density with the same first harmonic.
        from scipy.special import i0e, i1e

        concentration = 2 * np.maximum(magnitude, 1e-9)
        variance = self._std**2 - 2 * np.log(i1e(concentration) / i0e(concentration))
        return np.minimum(np.sqrt(variance), _MAX_STD_RAD)


def _common_phase(std: float) -> tuple[np.ndarray, np.ndarray]:
    """Return values of the phase that all bands share, and the logarithms of their weights."""
    if std == 0:
        return np.zeros(1), np.zeros(1)
    if std > UNIFORM_STD_RAD:
        turns = 2 * np.pi * np.arange(_N_COMMON) / _N_COMMON
        return turns, np.full(_N_COMMON, -np.log(_N_COMMON))
    values, weights = np.polynomial.hermite_e.hermegauss(_N_COMMON)
    return std * values, np.log(weights / weights.sum())


def _log_density(angle: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Return the log-density of the wrapped normal distribution relative to the uniform one."""
    angle = angle - 2 * np.pi * np.round(angle / (2 * np.pi))
    # The wraps by one turn, relative to the term without a wrap.
    ratio = np.exp(-2 * np.pi**2 / std**2)
    slope = 2 * np.pi / std**2 * angle
    wraps = ratio * (np.exp(slope) + np.exp(-slope))
    return (np.log(np.sqrt(2 * np.pi) / std) - angle**2 / (2 * std**2) + np.log1p(wraps))
