"""Weighted samples of the posterior in the region of interest, drawn from its modes."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import is_inside, likelihood_loss


class Samples(NamedTuple):
    """Samples of the Gaussians of M modes, S of each.

    Attributes
    ----------
    positions
        Float64 [M, S, 3] [m].
    log_weights
        Logarithm of the weights, not normalised, float64 [M, S]; -inf outside of the region.
    spread
        Factor of the covariance of each mode's position, float64 [M, 3, 3] [m].
    """

    positions: np.ndarray
    log_weights: np.ndarray
    spread: np.ndarray


def draw_samples(modes: Modes, normal: np.ndarray, bounds: np.ndarray) -> Samples:
    """Represent the modes by samples, for a uniform prior on the region of interest.

    Parameters
    ----------
    normal
        Points that represent a standard Gaussian, float64 [S, 3].
    bounds
        Lower and upper corner of the region, float64 [2, 3] [m].
    """
    return draw_samples_of_each(modes, np.zeros(1, int), normal, bounds)


def draw_samples_of_each(
        modes: Modes, starts: np.ndarray, normal: np.ndarray, bounds: np.ndarray) -> Samples:
    """Apply `draw_samples` to the modes of each of many phases at once.

    `starts` holds the index of each phase's first mode, int [N].
    """
    points, curvature, log_likelihood, roi_offset = modes
    jacobians = jacobian(points)
    log_mass = (log_likelihood + np.log(np.linalg.det(jacobians))
                - np.log(np.linalg.det(curvature)) / 2)
    factors = np.linalg.inv(np.swapaxes(np.linalg.cholesky(curvature), 1, 2))
    # The Gaussian of a mode outside the region is sampled around the point where it enters
    # the region; the weights of the samples correct for the shift.
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
    """The samples of the posteriors of N phases, with weights whose sum is one for each phase.

    Attributes
    ----------
    positions
        Float64 [M, S, 3] [m].
    weights
        Float64 [M, S].
    spread
        As in `Samples`.
    starts
        Index of each phase's first mode, int [N].
    log_totals
        Logarithms of the sums of the weights before they were normalised, float64 [N].
    """

    positions: np.ndarray
    weights: np.ndarray
    spread: np.ndarray
    starts: np.ndarray
    log_totals: np.ndarray

    @classmethod
    def of(cls, samples: Samples, starts: np.ndarray) -> 'WeightedSamples':
        """Normalise the weights of each phase."""
        counts = np.diff(starts, append=len(samples.log_weights))
        highest = np.maximum.reduceat(samples.log_weights.max(axis=1), starts)
        weights = np.exp(samples.log_weights - np.repeat(highest, counts)[:, None])
        totals = np.add.reduceat(weights.sum(axis=1), starts)
        weights /= np.repeat(totals, counts)[:, None]
        return cls(samples.positions, weights, samples.spread, starts, highest + np.log(totals))

    def log_evidence(self, volume_m3: float) -> np.ndarray:
        """Likelihood averaged over a region of this volume, as its logarithm, float64 [N]."""
        evidence: np.ndarray = (self.log_totals - np.log(self.weights.shape[1])
                                + 1.5 * np.log(2 * np.pi) - np.log(volume_m3))
        return evidence

    def average(self, values: np.ndarray) -> np.ndarray:
        """Average values of the modes, float64 [M, ...], over each posterior, [N, ...]."""
        shares = self.weights.sum(axis=1).reshape(-1, *[1] * (values.ndim - 1))
        return self.sums(shares * values)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Add values of the modes, float64 [M, ...], for each phase, [N, ...]."""
        sums: np.ndarray = np.add.reduceat(values, self.starts)
        return sums

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute the mean, float64 [N, 3] [m], and the covariance, [N, 3, 3], of the samples."""
        mean = self.sums(np.matmul(self.weights[:, None], self.positions)[:, 0])
        counts = np.diff(self.starts, append=len(self.weights))
        offsets = self.positions - np.repeat(mean, counts, axis=0)[:, None]
        weighted = np.swapaxes(offsets * self.weights[..., None], 1, 2)
        return mean, self.sums(np.matmul(weighted, offsets))
