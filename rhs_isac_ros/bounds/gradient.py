"""Derivatives with respect to the codebook from those with respect to the radiation matrices.

`by_radiation` is d/dRe(T_i) + i d/dIm(T_i) of an objective, complex128 [N_B, N_SB F, N_E].
"""

import numpy as np

from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix


def gradient_analog(
        scenario: Scenario, codebook: Beamforming, by_radiation: np.ndarray) -> np.ndarray:
    """Implements Proposition 2. Derivative with respect to C_i, float64 [N_B, F, N_E].

    The paper writes the chain rule for every pair of coordinates. Here, the pairs have already
    been summed in the derivative with respect to T_i.
    """
    weights = np.matmul(codebook.digital, onboard_matrix(scenario))
    by_radiation = by_radiation.reshape(weights.shape)
    gradient: np.ndarray = np.einsum('ijqm,ijqm->iqm', np.conj(by_radiation), weights).real
    return gradient


def gradient_digital(
        scenario: Scenario, codebook: Beamforming, by_radiation: np.ndarray) -> np.ndarray:
    """Implements Proposition 3. Derivative d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K]."""
    onboard = onboard_matrix(scenario)
    n_bands, n_subbands, _, n_elements = onboard.shape
    by_radiation = by_radiation.reshape(n_bands, n_subbands, -1, n_elements)
    weighted = by_radiation * codebook.analog[:, None]
    gradient: np.ndarray = np.matmul(weighted, np.conj(np.swapaxes(onboard, 2, 3)))
    return gradient
