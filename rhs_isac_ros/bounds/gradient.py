"""Derivatives with respect to the codebook from those with respect to the radiation matrices."""

import numpy as np

from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix


def gradient_analog(
        scenario: Scenario, codebook: Beamforming, by_radiation: np.ndarray) -> np.ndarray:
    """Implements Proposition 2. Derivative with respect to the configurations C_i.

    The paper writes the chain rule for every pair of coordinates. Here, the pairs have already
    been summed in the derivative with respect to T_i.

    Parameters
    ----------
    by_radiation
        d/dRe(T_i) + i d/dIm(T_i) of the objective, complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        Float64 [N_B, F, N_E].
    """
    weights = np.matmul(codebook.digital, onboard_matrix(scenario))
    by_radiation = by_radiation.reshape(weights.shape)
    gradient: np.ndarray = np.einsum('ijqm,ijqm->iqm', np.conj(by_radiation), weights).real
    return gradient


def gradient_digital(
        scenario: Scenario, codebook: Beamforming, by_radiation: np.ndarray) -> np.ndarray:
    """Implements Proposition 3. Derivative with respect to the combining vectors S_{i,j}.

    Parameters
    ----------
    by_radiation
        d/dRe(T_i) + i d/dIm(T_i) of the objective, complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K].
    """
    onboard = onboard_matrix(scenario)
    n_bands, n_subbands, _, n_elements = onboard.shape
    by_radiation = by_radiation.reshape(n_bands, n_subbands, -1, n_elements)
    weighted = by_radiation * codebook.analog[:, None]
    gradient: np.ndarray = np.matmul(weighted, np.conj(np.swapaxes(onboard, 2, 3)))
    return gradient
