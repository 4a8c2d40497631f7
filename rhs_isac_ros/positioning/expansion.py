"""Mean signals of neighbouring points from one evaluation of the model."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.positioning.coordinates import jacobian, to_positions
from rhs_isac_ros.positioning.lattice import Resolution, subband_wavenumbers

# Phase at the edge of the aperture over which points share an expansion [rad].
_SHARED_RAD = 0.05


class Expansion(NamedTuple):
    """Mean signals around n points, to first order apart from distance and carriers.

    The factor exp(-i k_n r) / r of a sub-band's mean is exact. The rest changes with the
    direction, as the aperture resolves it, and with the curvature of the wavefront, 1 / r.

    Attributes
    ----------
    points
        (r [m], u, v), float64 [n, 3].
    wavenumbers
        Of the carrier of each measurement, float64 [N_B, N_SB F] [1/m].
    mean
        Mean signals over the factor, complex128 [n, N_B, N_SB F].
    slopes
        Derivatives of these with respect to the points, complex128 [n, 3, N_B, N_SB F].
    """

    points: np.ndarray
    wavenumbers: np.ndarray
    mean: np.ndarray
    slopes: np.ndarray

    @classmethod
    def of(cls, model: MeasurementModel, points: np.ndarray) -> 'Expansion':
        """Evaluate a model at points."""
        wavenumbers = subband_wavenumbers(model.scenario)
        wavenumbers = np.repeat(wavenumbers, model.shape[1] // wavenumbers.shape[1], axis=1)
        mean, slopes = model.mean_and_jacobian(to_positions(points), jacobian(points))
        range_m = points[:, :1, None]
        factor = range_m * np.exp(1j * wavenumbers * range_m)
        mean, slopes = mean * factor, slopes * factor[:, None]
        slopes[:, 0] += (1j * wavenumbers + 1 / range_m) * mean
        return cls(points, wavenumbers, mean, slopes)

    def at(self, index: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate points [M, 3], each near the point of the expansion with an index, int [M].

        Returns means, complex128 [M, N_B, N_SB F], and derivatives, [M, 3, N_B, N_SB F].
        """
        offset, range_m = points - self.points[index], points[:, :1, None]
        ratio = self.points[index, 0] / points[:, 0]
        offset[:, 0] *= ratio
        slopes = self.slopes[index]
        mean = self.mean[index] + np.matmul(
            offset[:, None], slopes.reshape(len(index), 3, -1)).reshape(-1, *self.mean.shape[1:])
        factor = np.exp(-1j * self.wavenumbers * range_m) / range_m
        mean *= factor
        slopes *= factor[:, None]
        slopes[:, 0] *= ratio[:, None, None]**2
        slopes[:, 0] -= (1j * self.wavenumbers + 1 / range_m) * mean
        return mean, slopes


class Means:
    """Mean signals and their derivatives, of which neighbouring points share one expansion.

    Modes of the posterior stand in rows along the range, in nearly the same direction.
    """

    def __init__(self, model: MeasurementModel) -> None:
        self._model, resolution = model, Resolution.of(model.scenario)
        self._per_cell = np.array(
            [resolution.curvature_m, *1 / resolution.direction]) / _SHARED_RAD

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate points (r [m], u, v), [M, 3], as `Expansion.at` does."""
        cells = points * self._per_cell
        cells[:, 0] = self._per_cell[0] / points[:, 0]
        keys = np.rint(cells).astype(np.int64) @ np.array([1 << 42, 1 << 21, 1])
        _, first, index = np.unique(keys, return_index=True, return_inverse=True)
        if len(first) == len(points):
            return self._model.mean_and_jacobian(to_positions(points), jacobian(points))
        return Expansion.of(self._model, points[first]).at(index, points)
