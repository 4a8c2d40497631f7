"""Mean signals and their derivative from sums over the elements."""

import numpy as np

from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.model.los import los_derivative_terms
from rhs_isac_ros.model.scenario import Scenario


class ElementSums:
    """Weights of the elements for the mean signals and their derivative.

    Each sum over elements of a T_i (p - p_m) is p times the sum of a T_i, minus the sum of
    a T_i p_m: four sums of N_E terms that need no array of N_E by 3.

    Parameters
    ----------
    radiation
        T_i, complex128 [N_B, N_SB F, N_E].
    """

    def __init__(self, scenario: Scenario, radiation: np.ndarray) -> None:
        self._scenario = scenario
        shape = scenario.n_bands, scenario.n_subbands, scenario.n_frames, scenario.n_elements
        # T_i, complex128 [N_B, N_SB, N_E, F].
        self._frames = np.ascontiguousarray(np.swapaxes(radiation.reshape(shape), 2, 3))
        coordinates = np.hstack([np.ones((shape[3], 1)), element_positions(scenario)])
        moments = coordinates[:, :, None] * self._frames[..., None, :]
        # T_i times (1, x, y, z) of the element [m], complex128 [N_B, N_SB, N_E, 4 F].
        self._moments = moments.reshape(*self._frames.shape[:3], -1)

    def mean_and_jacobian(
            self, positions: np.ndarray, band: int) -> tuple[np.ndarray, np.ndarray]:
        """Compute the mean of one band, [N, N_SB F], and its derivative, [3, N, N_SB F] [1/m]."""
        gain, radial, boresight_term = los_derivative_terms(self._scenario, positions, band)
        frames, moments = self._frames[band], self._moments[band]
        n, n_measurements = len(positions), frames.shape[0] * frames.shape[2]

        def combine(elements: np.ndarray) -> np.ndarray:
            products = np.matmul(elements.transpose(1, 0, 2), frames)
            combined: np.ndarray = products.transpose(1, 0, 2).reshape(n, n_measurements)
            return combined

        sums = np.matmul(radial.transpose(1, 0, 2), moments)
        sums = sums.reshape(-1, n, 4, frames.shape[2]).transpose(2, 1, 0, 3)
        sums = sums.reshape(4, n, n_measurements)
        by_position = positions.T[:, :, None] * sums[0] - sums[1:]
        if boresight_term is not None:
            by_position[0] += combine(boresight_term)
        return combine(gain), by_position
