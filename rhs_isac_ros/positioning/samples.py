"""Weighted samples of the posterior in the region of interest, drawn from its modes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import likelihood_loss


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

    def log_evidence(self, volume_m3: float) -> float:
        """Likelihood averaged over a region of this volume, as its logarithm."""
        highest = self.log_weights.max()
        mass = np.log(np.sum(np.exp(self.log_weights - highest)) / self.log_weights.shape[1])
        return float(highest + mass + 1.5 * np.log(2 * np.pi) - np.log(volume_m3))


def draw_samples(modes: Modes, normal: np.ndarray, bounds: np.ndarray) -> Samples:
    """Represent the modes by samples, for a uniform prior on the region of interest.

    Parameters
    ----------
    normal
        Points that represent a standard Gaussian, float64 [S, 3].
    bounds
        Lower and upper corner of the region, float64 [2, 3] [m].
    """
    return draw_samples_of_each([modes], normal, bounds)[0]


def draw_samples_of_each(
        modes: Sequence[Modes], normal: np.ndarray, bounds: np.ndarray) -> list[Samples]:
    """Apply `draw_samples` to the modes of each of many phases at once."""
    points, curvature, log_likelihood, roi_offset = (
        np.concatenate(field) for field in zip(*modes, strict=True))
    jacobians = jacobian(points)
    log_mass = (log_likelihood + np.log(np.linalg.det(jacobians))
                - np.log(np.linalg.det(curvature)) / 2)
    factors = np.linalg.inv(np.swapaxes(np.linalg.cholesky(curvature), 1, 2))
    # The Gaussian of a mode outside the region is sampled around the point where it enters
    # the region; the weights of the samples correct for the shift.
    shift = np.linalg.solve(factors, roi_offset[..., None])[..., 0]
    log_weights = (log_mass[:, None] - shift @ normal.T
                   - likelihood_loss(roi_offset, curvature)[:, None])
    spread = np.matmul(normal, np.swapaxes(factors, 1, 2))
    positions = to_positions((points + roi_offset)[:, None] + spread)
    low, high = bounds
    inside = ((positions >= low) & (positions <= high)).all(axis=-1)
    all_spread = np.matmul(jacobians, factors)
    samples, end = [], 0
    for one in modes:
        part = slice(end, end + len(one.points))
        end = part.stop
        if not inside[part].any():
            positions[part] = np.clip(positions[part], low, high)
            inside[part] = True
        samples.append(Samples(positions[part], log_weights[part], all_spread[part]))
    log_weights[~inside] = -np.inf
    return samples
