"""The surface: propagation from its elements to the feeds, and combining at the base station."""

import functools
from typing import NamedTuple, Protocol

import numpy as np

from rhs_isac_ros.model.arrays import read_only
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.geometry import element_positions, feed_positions, subband_frequencies_hz
from rhs_isac_ros.model.scenario import Scenario, check_shape


class Beamforming(Protocol):
    """Analog and digital beamforming of a positioning phase, such as a codebook."""

    @property
    def analog(self) -> np.ndarray:
        """Configurations C, float64 [N_B, F, N_E], each entry in [0, 1]."""
        ...

    @property
    def digital(self) -> np.ndarray:
        """Combining vectors S, complex128 [N_B, N_SB, F, K] [sqrt(W)]."""
        ...


class AppliedBeams(NamedTuple):
    """Beamforming with arbitrary complex coefficients, such as those of faulty elements."""

    analog: np.ndarray
    digital: np.ndarray


def element_signals(
        los: np.ndarray, multipath: np.ndarray, symbol: complex | np.ndarray) -> np.ndarray:
    """Implements Eq. (1). Element signals tau for line-of-sight and multipath gains.

    Returns complex128 [..., N_E] for gains of this shape, or shapes that broadcast to it.
    """
    return (los + multipath) * symbol


def feed_signals(
        scenario: Scenario, band: int, analog: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Implements Eq. (5). Signals that the feeds receive from the elements, [..., N_SB, K].

    Takes the configuration c of each frame, float64 [..., N_E], and the element signals tau,
    complex128 [..., N_SB, N_E]. The configuration is applied here; the paper introduces it with
    Eq. (9).
    """
    return np.einsum('...jm,jkm->...jk', analog[..., None, :] * elements,
                     onboard_matrix(scenario)[band])


def onboard_gain(
        scenario: Scenario, frequency_hz: float | np.ndarray, source: np.ndarray,
        sink: np.ndarray) -> np.ndarray:
    """Implements Eq. (6). Propagation kappa on the board between two points, complex128.

    Frequencies [Hz] and positions, float64 [..., 3] [m], may have any shapes that broadcast.
    """
    distance = np.linalg.norm(sink - source, axis=-1)
    wavenumber = 2 * np.pi * scenario.refractive_index * frequency_hz / SPEED_OF_LIGHT_MPS
    return np.exp(-1j * wavenumber * distance)


def combine(digital: np.ndarray, feeds: np.ndarray, noise: np.ndarray | float) -> np.ndarray:
    """Implements Eq. (7). Combined signal of the feeds, complex128 [...].

    Takes combining vectors s and signals at the feeds, complex128 [..., K], and the thermal noise
    e, complex128 [...] or 0.
    """
    return np.einsum('...k,...k->...', digital, feeds) + noise


def radiation_matrix(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Implements Eq. (9). Weight of every element in every measurement.

    Returns T_i, complex128 [N_B, N_SB F, N_E], rows sub-band-major (row j F + q). Raises
    ValueError if the beamforming does not have the sizes of the scenario.
    """
    check_shape('analog', beams.analog, 'N_B F N_E', scenario)
    check_shape('digital', beams.digital, 'N_B N_SB F K', scenario)
    return (beams.analog[:, None] * feed_weights(scenario, beams)).reshape(
        scenario.n_bands, -1, scenario.n_elements)


def feed_weights(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Compute S B, the weights of elements whose coefficient is 1, [N_B, N_SB, F, N_E]."""
    return np.matmul(beams.digital, onboard_matrix(scenario))


@functools.lru_cache(maxsize=16)
def onboard_matrix(scenario: Scenario) -> np.ndarray:
    """Compute B_{i,j} below Eq. (9), the on-board propagation from all elements to all feeds.

    Returns complex128 [N_B, N_SB, K, N_E], read-only.
    """
    frequencies = subband_frequencies_hz(scenario)[:, :, None, None]
    elements, feeds = element_positions(scenario), feed_positions(scenario)
    return read_only(onboard_gain(scenario, frequencies, elements, feeds[:, None, :]))


def on_levels(scenario: Scenario, analog: np.ndarray) -> np.ndarray:
    """Round configurations to the amplitude levels of the elements; keep continuous amplitudes."""
    steps = scenario.amplitude_levels - 1
    return np.rint(analog * steps) / steps if steps > 0 else analog


def matched_configuration(los: np.ndarray, onboard: np.ndarray) -> np.ndarray:
    """Compute a configuration by the holographic principle, float64 [N_E], entries in [0, 1].

    Takes line-of-sight gains, complex128 [N_SB, N_E], and B_j, complex128 [N_SB, K, N_E]. The
    amplitude of an element is high if the phases of its line-of-sight gain and of its propagation
    on the board cancel. If all gains are 0, all entries are 0.5.
    """
    interference = np.einsum('jm,jkm->m', los, onboard).real
    return (interference / (np.abs(interference).max() or 1.0) + 1) / 2
