"""The maximum-likelihood position."""

import numpy as np

from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.samples import Samples
from rhs_isac_ros.positioning.search import SearchEstimator


class MlEstimator(SearchEstimator):
    """The most likely position in the region of interest.

    The covariance is the inverse curvature of the log-likelihood there and does not account for
    other modes. Parameters and errors are those of `SearchEstimator`.
    """

    name = 'ml'

    def _moments(self, modes: Modes, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        best = np.argmax(modes.roi_log_likelihood)
        point = modes.roi_points[best]
        by_point = jacobian(point[None])[0]
        covariance = by_point @ np.linalg.solve(modes.curvature[best], by_point.T)
        position = np.clip(to_positions(point), *self._bounds)
        return position, (covariance + covariance.T) / 2
