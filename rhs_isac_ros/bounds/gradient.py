"""From the derivative by the beam patterns to those by the variables of a codebook."""

import numpy as np

from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix


def gradient_analog(
        scenario: Scenario, codebook: Beamforming, by_pattern: np.ndarray) -> np.ndarray:
    """Implements Proposition 2. Derivative by the configurations C_i.

    The paper writes the chain rule out for every pair of coordinates; here the pairs are summed
    first, in the derivative by T_i.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.
    by_pattern
        Derivative of the objective by T_i (d/dRe + i d/dIm), complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        Float64 [N_B, F, N_E].
    """
    weights = np.matmul(codebook.digital, onboard_matrix(scenario))
    by_pattern = by_pattern.reshape(weights.shape)
    return np.einsum('ijqm,ijqm->iqm', np.conj(by_pattern), weights).real


def gradient_digital(
        scenario: Scenario, codebook: Beamforming, by_pattern: np.ndarray) -> np.ndarray:
    """Implements Proposition 3. Derivative by the combining vectors S_{i,j}.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.
    by_pattern
        Derivative of the objective by T_i (d/dRe + i d/dIm), complex128 [N_B, N_SB F, N_E].

    Returns
    -------
    numpy.ndarray
        d/dRe + i d/dIm, complex128 [N_B, N_SB, F, K].
    """
    onboard = onboard_matrix(scenario)
    n_bands, n_subbands, _, n_elements = onboard.shape
    by_pattern = by_pattern.reshape(n_bands, n_subbands, -1, n_elements)
    weighted = by_pattern * codebook.analog[:, None]
    return np.matmul(weighted, np.conj(np.swapaxes(onboard, 2, 3)))
