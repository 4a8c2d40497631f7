"""Covariance of the received signals due to multipath and noise."""

import numpy as np

from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.scenario import Scenario


def signal_covariance(scenario: Scenario, radiation: np.ndarray) -> np.ndarray:
    """Implements Eq. (14). Covariance of the received signals, independent of the position.

    Returns Lambda_i, complex128 [N_B, N_SB F, N_SB F] [W], for the radiation matrices T_i of all
    bands, complex128 [N_B, N_SB F, N_E].
    """
    noise = scenario.noise_power_w * np.eye(radiation.shape[1])
    covariance: np.ndarray = scattered_covariance(scenario, radiation) + noise
    return covariance


def scattered_covariance(scenario: Scenario, radiation: np.ndarray) -> np.ndarray:
    """Compute the covariance of the multipath in the received signals, as `signal_covariance`."""
    spatial = multipath_covariance(scenario)
    scattered = np.matmul(np.matmul(radiation, spatial), np.conj(np.swapaxes(radiation, 1, 2)))
    correlated: np.ndarray = measurement_correlation(scenario) * scattered
    return correlated
