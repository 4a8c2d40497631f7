"""The maximum-likelihood position."""

import numpy as np

from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.samples import WeightedSamples
from rhs_isac_ros.positioning.search import SearchEstimator


class MlEstimator(SearchEstimator):
    """The most likely position in the region of interest.

    The covariance is the inverse curvature of the log-likelihood there and does not account for
    other modes. Parameters and errors are those of `SearchEstimator`.
    """

    name = 'ml'

    def _moments(
            self, modes: Modes, samples: WeightedSamples) -> tuple[np.ndarray, np.ndarray]:
        ends = [*samples.starts[1:].tolist(), len(modes.points)]
        value = modes.roi_log_likelihood
        best = np.array([start + np.argmax(value[start:end])
                         for start, end in zip(samples.starts.tolist(), ends, strict=True)])
        points = modes.roi_points[best]
        by_point = jacobian(points)
        covariance = np.matmul(
            by_point, np.linalg.solve(modes.curvature[best], np.swapaxes(by_point, 1, 2)))
        positions = np.clip(to_positions(points), *self._bounds)
        return positions, (covariance + np.swapaxes(covariance, 1, 2)) / 2
