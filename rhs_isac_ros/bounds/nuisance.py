"""Information about the position when nuisance parameters are unknown, and the region as a prior.

Nuisance parameters have Gaussian priors. They are scaled to unit standard deviation throughout, so
that the information of the prior is the identity matrix and units do not matter.
"""

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.nuisance import nuisance_directions, nuisance_parameters


def scaled_directions(scenario: Scenario, mean: np.ndarray) -> np.ndarray:
    """Compute the derivative of mean signals with respect to scaled nuisance parameters.

    Takes complex128 [N, N_B, N_SB F] and returns complex128 [N, Q, N_B, N_SB F].
    """
    directions: np.ndarray = (
        nuisance_directions(scenario, mean) * deviations(scenario)[:, None, None])
    return directions


def deviations(scenario: Scenario) -> np.ndarray:
    """Return the standard deviations of the nuisance parameters, float64 [Q]."""
    return np.array([parameter.std for parameter in nuisance_parameters(scenario)])


def marginal_information(joint: np.ndarray) -> np.ndarray:
    """Compute the information about the position that remains without the nuisance parameters.

    This is the Schur complement A - B (D + I)^-1 B^T of the joint information [[A, B], [B^T, D]]
    of position and scaled nuisance parameters, float64 [N, 3 + Q, 3 + Q]. Returns float64
    [N, 3, 3].
    """
    between, among = joint[:, :3, 3:], joint[:, 3:, 3:] + np.eye(joint.shape[1] - 3)
    explained = np.matmul(between, np.linalg.solve(among, np.swapaxes(between, 1, 2)))
    information: np.ndarray = joint[:, :3, :3] - (explained + np.swapaxes(explained, 1, 2)) / 2
    return information


def region_information(scenario: Scenario) -> np.ndarray:
    """Return the information of the region of interest as a prior, float64 [3, 3] [1/m^2].

    The uniform distribution is replaced by a Gaussian of the same covariance, size^2 / 12.
    """
    return np.diag(12 / np.array(scenario.roi_size_m)**2)
