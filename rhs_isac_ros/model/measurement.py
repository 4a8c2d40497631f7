"""Mean, derivative and covariance of the received signals of a positioning phase."""

import numpy as np

from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.scenario import Scenario


def mean_derivative(slopes: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Implements Eq. (13). Derivative of one band's mean signal by the position.

    Parameters
    ----------
    slopes
        Derivative of the line-of-sight gains, complex128 [N, G, N_SB, N_E] [1/m]; G is 3. Other
        functions of the gains are possible, in any number.
    pattern
        T_i, complex128 [N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        Complex128 [N, G, N_SB F] [1/m], sub-band-major.
    """
    n, n_rows, n_subbands, n_elements = slopes.shape
    frames = pattern.reshape(n_subbands, -1, n_elements)
    # One matrix product a sub-band: [G N, N_E] with [N_E, F].
    stacked = np.moveaxis(slopes, 2, 0).reshape(n_subbands, n_rows * n, n_elements)
    products = np.matmul(stacked, np.swapaxes(frames, 1, 2))
    return np.moveaxis(products, 0, 1).reshape(n, n_rows, -1)


def covariance(scenario: Scenario, patterns: np.ndarray) -> np.ndarray:
    """Implements Eq. (14). Covariance of the received signals; independent of the position.

    Parameters
    ----------
    scenario
        The scenario.
    patterns
        T_i of every band, complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        Lambda_i, complex128 [N_B, N_SB F, N_SB F] [W].
    """
    spatial = multipath_covariance(scenario)
    scattered = np.matmul(np.matmul(patterns, spatial), np.conj(np.swapaxes(patterns, 1, 2)))
    noise = scenario.noise_power_w * np.eye(patterns.shape[1])
    return measurement_correlation(scenario) * scattered + noise


def whitening_matrices(scenario: Scenario, patterns: np.ndarray) -> np.ndarray:
    """Matrices that make the received signals' covariance the identity.

    Parameters
    ----------
    scenario
        The scenario.
    patterns
        T_i of every band, complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        L_i^-1 with L_i L_i^H = Lambda_i, lower triangular, complex128 [N_B, N_SB F, N_SB F].
    """
    return np.linalg.inv(np.linalg.cholesky(covariance(scenario, patterns)))
