"""Capacity of the transmission phase."""

import dataclasses

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.model.shapes import check_shape
from rhs_isac_ros.model.surface import onboard_matrix


@dataclasses.dataclass(frozen=True, eq=False)
class Beam:
    """Beamforming of one band in the transmission phase.

    Attributes
    ----------
    analog
        Configuration c-hat, float64 [N_E], each entry in [0, 1].
    digital
        Combining vectors s-hat, complex128 [N_SB, K] [sqrt(W)].
    band
        Index of the band, from 0.
    """

    analog: np.ndarray
    digital: np.ndarray
    band: int = 0


def capacity(scenario: Scenario, beam: Beam, positions: np.ndarray) -> np.ndarray:
    """Implements Eq. (10). Capacity of a beam for users at some positions.

    Parameters
    ----------
    scenario
        The scenario.
    beam
        The beam; its band is the one that counts.
    positions
        Positions of the user, float64 [N, 3] [m].

    Returns
    -------
    numpy.ndarray
        R_i, float64 [N] [bit/s].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array, or the beam does not fit the scenario.
    """
    patterns = _patterns(scenario, beam)
    direct = _direct(scenario, beam.band, patterns, positions)
    spatial = multipath_covariance(scenario)[beam.band]
    scattered = np.sum((patterns @ spatial) * np.conj(patterns), axis=1).real
    ratio = (direct + scattered) / scenario.noise_power_w
    return scenario.subband_width_hz * np.log2(1 + ratio).sum(axis=1)


def direct_power_w(scenario: Scenario, beam: Beam, positions: np.ndarray) -> np.ndarray:
    """Power that a beam brings to some positions over the line of sight, as Eq. (10) counts it.

    Parameters
    ----------
    scenario
        The scenario.
    beam
        The beam.
    positions
        Positions, float64 [N, 3] [m].

    Returns
    -------
    numpy.ndarray
        Sum over the sub-bands, float64 [N] [W].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array, or the beam does not fit the scenario.
    """
    return _direct(scenario, beam.band, _patterns(scenario, beam), positions).sum(axis=1)


def _patterns(scenario: Scenario, beam: Beam) -> np.ndarray:
    """Weights of the elements, t_j = c . (s_j B_j), complex128 [N_SB, N_E]."""
    check_shape('analog', beam.analog, 'N_E', scenario)
    check_shape('digital', beam.digital, 'N_SB K', scenario)
    if not 0 <= beam.band < scenario.n_bands:
        raise ValueError(f'band: {beam.band}, expected 0 to {scenario.n_bands - 1}')
    patterns = np.einsum('jk,jkm->jm', beam.digital, onboard_matrix(scenario)[beam.band])
    return patterns * beam.analog


def _direct(
        scenario: Scenario, band: int, patterns: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Power over the line of sight, float64 [N, N_SB] [W]."""
    return np.abs(np.einsum('jm,njm->nj', patterns, los_gain(scenario, positions, band)))**2
