"""The most likely position."""

import numpy as np

from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.search import SearchEstimator


class MlEstimator(SearchEstimator):
    """The most likely position of the region of interest, and its covariance as if it were alone.

    The covariance comes from the curvature of the likelihood there: it knows nothing of other
    modes. Parameters and errors are those of `SearchEstimator`.
    """

    name = 'ml'

    def _moments(self, modes: Modes) -> tuple[np.ndarray, np.ndarray]:
        best = np.argmax(modes.height)
        inside = modes.inside[best]
        bend = jacobian(inside[None])[0]
        covariance = bend @ np.linalg.solve(modes.curvature[best], bend.T)
        position = np.clip(to_positions(inside), *self._bounds)
        return position, (covariance + covariance.T) / 2
