"""The surface: from the signals at its elements to those at its feeds and at the base station."""

import functools
from typing import Protocol

import numpy as np

from rhs_isac_ros.model.geometry import (
    element_positions,
    feed_positions,
    subband_frequencies_hz,
)
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.model.shapes import check_shape


class Beamforming(Protocol):
    """What the model needs of a codebook.

    Attributes
    ----------
    analog
        Configurations C, float64 [N_B, F, N_E], each entry in [0, 1].
    digital
        Combining vectors S, complex128 [N_B, N_SB, F, K].
    """

    analog: np.ndarray
    digital: np.ndarray


def element_signals(los: np.ndarray, multipath: np.ndarray, symbol: complex) -> np.ndarray:
    """Implements Eq. (1). Signals that the elements receive.

    Parameters
    ----------
    los
        Line-of-sight gains, complex128 [..., N_E].
    multipath
        Multipath gains, complex128 [..., N_E].
    symbol
        The user's symbol x.

    Returns
    -------
    numpy.ndarray
        tau, complex128 [..., N_E].
    """
    return (los + multipath) * symbol


def feed_signals(
        scenario: Scenario, band: int, analog: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Implements Eq. (5). Signals that the feeds receive from the configured elements.

    The radiation coefficients, which the paper brings in with Eq. (9), act here, at the elements.

    Parameters
    ----------
    scenario
        The scenario.
    band
        Index of the band, from 0.
    analog
        Configuration c of the frame, float64 [N_E].
    elements
        Element signals tau, complex128 [N_SB, N_E].

    Returns
    -------
    numpy.ndarray
        Complex128 [N_SB, K].
    """
    return np.einsum('jm,jkm->jk', analog * elements, onboard_matrix(scenario)[band])


def onboard_gain(
        scenario: Scenario, frequency_hz: float, source: np.ndarray, sink: np.ndarray
) -> np.ndarray:
    """Implements Eq. (6). Propagation on the board between two points.

    Parameters
    ----------
    scenario
        The scenario.
    frequency_hz
        Frequency [Hz], of a shape that broadcasts with the points'.
    source, sink
        Positions, float64 [..., 3] [m], of shapes that broadcast.

    Returns
    -------
    numpy.ndarray
        kappa, complex128 of the broadcast shape.
    """
    distance = np.linalg.norm(sink - source, axis=-1)
    wavenumber = 2 * np.pi * scenario.refractive_index * frequency_hz / SPEED_OF_LIGHT_MPS
    return np.exp(-1j * wavenumber * distance)


def combine(digital: np.ndarray, feeds: np.ndarray, noise: np.ndarray | float) -> np.ndarray:
    """Implements Eq. (7). Combined signal of the feeds, with thermal noise.

    Parameters
    ----------
    digital
        Combining vectors s, complex128 [..., K].
    feeds
        Signals at the feeds, complex128 [..., K].
    noise
        Noise e, complex128 [...], or 0.

    Returns
    -------
    numpy.ndarray
        Complex128 [...].
    """
    return np.einsum('...k,...k->...', digital, feeds) + noise


def radiation_matrix(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Implements Eq. (9). Weight of every element in every measurement.

    Parameters
    ----------
    scenario
        The scenario.
    beams
        Analog and digital beamforming.

    Returns
    -------
    numpy.ndarray
        T_i, complex128 [N_B, N_SB F, N_E], rows sub-band-major (row j F + q).

    Raises
    ------
    ValueError
        If the beamforming does not have the sizes of the scenario.
    """
    check_shape('analog', beams.analog, 'N_B F N_E', scenario)
    check_shape('digital', beams.digital, 'N_B N_SB F K', scenario)
    weights = np.matmul(beams.digital, onboard_matrix(scenario))
    patterns = beams.analog[:, None] * weights
    return patterns.reshape(scenario.n_bands, -1, scenario.n_elements)


@functools.lru_cache(maxsize=16)
def onboard_matrix(scenario: Scenario) -> np.ndarray:
    """On-board propagation between every element and feed, the matrix B below Eq. (9).

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    numpy.ndarray
        B_{i,j}, complex128 [N_B, N_SB, K, N_E], read-only.
    """
    frequencies = subband_frequencies_hz(scenario)[:, :, None, None]
    elements, feeds = element_positions(scenario), feed_positions(scenario)
    matrix = onboard_gain(scenario, frequencies, elements, feeds[:, None, :])
    matrix.flags.writeable = False
    return matrix


def matched_configuration(los: np.ndarray, onboard: np.ndarray) -> np.ndarray:
    """Configuration by the holographic principle: strong where feed and path waves agree.

    Parameters
    ----------
    los
        Line-of-sight gains, complex128 [N_SB, N_E].
    onboard
        B_j, complex128 [N_SB, K, N_E].

    Returns
    -------
    numpy.ndarray
        Float64 [N_E], from 0 to 1; the middle where there is no line of sight.
    """
    interference = np.einsum('jm,jkm->m', los, onboard).real
    return (interference / (np.abs(interference).max() or 1.0) + 1) / 2
