"""Priors of the position for which a codebook is optimised: the region, or a cell of it."""

import dataclasses

import numpy as np

from rhs_isac_ros.model import Scenario

# Pairs of positions are drawn from a box of this many standard deviations around a cell.
_REACH = 3.0
# Smallest probability beside a position, so that its quantile is finite.
_TINY = 1e-9


class Prior:
    """Where the user may be: a uniform density in the region of interest, unless overridden."""

    def positions(self, scenario: Scenario, uniform: np.ndarray) -> np.ndarray:
        """Map positions that are uniform in the region, float64 [N, 3] [m], to the prior."""
        return uniform

    def box(self, scenario: Scenario) -> Scenario:
        """Return a scenario whose region contains the prior; only the region is changed."""
        return scenario

    def ratios(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return by how much more probable second positions are than first ones, at most 1."""
        return np.ones(len(first))


REGION = Prior()


@dataclasses.dataclass(frozen=True)
class Cell(Prior):
    """A Gaussian with the same variance in all directions, cut off at the border of the region."""

    centre_m: tuple[float, float, float]  #: In the frame of the surface [m].
    std_m: float  #: Standard deviation of each coordinate [m].

    def __post_init__(self) -> None:
        """Convert the centre, which may be an array or a list, to a tuple."""
        object.__setattr__(self, 'centre_m', tuple(map(float, self.centre_m)))

    def positions(self, scenario: Scenario, uniform: np.ndarray) -> np.ndarray:
        """Map positions that are uniform in the region, float64 [N, 3] [m], to the cell."""
        # A slow import, which loading a codebook does not need.
        from scipy.special import ndtr, ndtri

        bounds = scenario.roi_bounds_m
        low, high = ndtr((bounds - np.array(self.centre_m)) / self.std_m)
        extent = np.ptp(bounds, axis=0)
        share = (uniform - bounds[0]) / np.where(extent > 0, extent, 1.0)
        quantiles = ndtri(np.clip(low + (high - low) * share, _TINY, 1 - _TINY))
        return np.clip(np.array(self.centre_m) + self.std_m * quantiles, *bounds)

    def box(self, scenario: Scenario) -> Scenario:
        """Return the scenario with the part of its region that is near the cell."""
        centre, bounds = np.array(self.centre_m), scenario.roi_bounds_m
        low, high = np.clip([centre - _REACH * self.std_m, centre + _REACH * self.std_m], *bounds)
        return dataclasses.replace(
            scenario, roi_center_m=tuple((low + high) / 2), roi_size_m=tuple(high - low))

    def ratios(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return ratios of the roots of the densities, at most 1, float64 [N]."""
        # The probability of confusing two positions with different priors is, in either direction,
        # bounded by the root of the product of these priors.
        squares = [np.sum((points - np.array(self.centre_m))**2, axis=1)
                   for points in (first, second)]
        return np.exp(np.minimum(squares[0] - squares[1], 0.0) / (4 * self.std_m**2))
