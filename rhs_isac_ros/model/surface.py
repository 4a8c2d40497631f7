"""The surface: propagation from its elements to the feeds, and combining at the base station."""

import functools
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np

from rhs_isac_ros.model.board import Factor, Ports, rounded
from rhs_isac_ros.model.geometry import element_positions, feed_positions, subband_frequencies_hz
from rhs_isac_ros.model.scenario import Scenario, check_shape

# Slope and offset of the elements, as in `board`, and gains of the bands, a number or [N_B].
Response: TypeAlias = tuple[Factor, Factor, Factor]
NOMINAL: Response = 1.0, 0.0, 1.0


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
    """Beamforming with arbitrary tunings; on the paper's board, complex coefficients."""

    analog: np.ndarray
    digital: np.ndarray


def element_signals(
        los: np.ndarray, multipath: np.ndarray, symbol: complex | np.ndarray) -> np.ndarray:
    """Implements Eq. (1). Element signals tau for line-of-sight and multipath gains.

    Returns complex128 [..., N_E] for gains of this shape, or shapes that broadcast to it.
    """
    return (los + multipath) * symbol


def feed_signals(
        scenario: Scenario, band: int, analog: np.ndarray, elements: np.ndarray,
        response: Response = NOMINAL) -> np.ndarray:
    """Implements Eq. (5). Signals that the feeds receive from the elements, [..., N_SB, K].

    Takes the configuration c of each frame, float64 [..., N_E], the element signals tau,
    complex128 [..., N_SB, N_E], and the response of the elements. The configuration is applied
    here; the paper introduces it with Eq. (9).
    """
    n_subbands, n_elements = elements.shape[-2:]
    slope, offset, gain = response
    signals = scenario.board.feeds(
        ports_of(scenario, band), analog.reshape(1, -1, n_elements),
        np.swapaxes(elements.reshape(1, -1, n_subbands, n_elements), 1, 2), slope, offset)
    return gain * np.swapaxes(signals[0], 0, 1).reshape(*elements.shape[:-1], -1)


def combine(digital: np.ndarray, feeds: np.ndarray, noise: np.ndarray | float) -> np.ndarray:
    """Implements Eq. (7). Combined signal of the feeds, complex128 [...].

    Takes combining vectors s and signals at the feeds, complex128 [..., K], and the thermal noise
    e, complex128 [...] or 0.
    """
    return np.einsum('...k,...k->...', digital, feeds) + noise


def radiation_matrix(
        scenario: Scenario, beams: Beamforming, response: Response = NOMINAL) -> np.ndarray:
    """Implements Eq. (9). Weight of every element in every measurement.

    Returns T_i, complex128 [N_B, N_SB F, N_E], rows sub-band-major (row j F + q), for elements
    with a response. Raises ValueError if the beamforming or the response does not have the sizes
    of the scenario, and BoardError if elements of the board cannot have such a response.
    """
    check_shape('analog', beams.analog, 'N_B F N_E', scenario)
    check_shape('digital', beams.digital, 'N_B N_SB F K', scenario)
    slope, offset, band_gains = response
    if np.ndim(slope) == 1 and np.shape(slope) != beams.analog.shape[-1:]:
        raise ValueError(f'surface: {np.size(slope)} elements, expected N_E = '
                         f'{scenario.n_elements} as in the configurations')
    digital = np.reshape(band_gains, (-1, 1, 1, 1)) * beams.digital
    return scenario.board.radiation(
        ports_of(scenario), beams.analog, digital, slope, offset).reshape(
            scenario.n_bands, -1, scenario.n_elements)


@functools.lru_cache(maxsize=64)
def ports_of(scenario: Scenario, *bands: int) -> Ports:
    """Return the ports of the board in some bands, by default in all."""
    bands = bands or tuple(range(scenario.n_bands))
    return Ports(bands, subband_frequencies_hz(scenario)[list(bands)],
                 element_positions(scenario), feed_positions(scenario), scenario.refractive_index)


def onboard_matrix(scenario: Scenario) -> np.ndarray:
    """Return B_{i,j} below Eq. (9), the on-board propagation from all elements to all feeds.

    Returns complex128 [N_B, N_SB, K, N_E], read-only. Raises BoardError if elements are coupled.
    """
    return scenario.board.paths(ports_of(scenario))


def on_levels(scenario: Scenario, analog: np.ndarray) -> np.ndarray:
    """Round configurations to the levels of the elements; keep continuous tunings."""
    return rounded(analog, scenario.amplitude_levels)
