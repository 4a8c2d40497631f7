"""The signals that a whole positioning phase delivers."""

import numpy as np

from rhs_isac_ros.model.los import checked_positions, los_gain
from rhs_isac_ros.model.multipath import complex_normal, draw_multipath
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, combine, radiation_matrix

_BLOCK = 256


def received_signal(
        los: np.ndarray, multipath: np.ndarray | float, pattern: np.ndarray,
        noise: np.ndarray | float, symbol: complex = 1.0) -> np.ndarray:
    """Implements Eq. (8). Received signals of one band over its sub-bands and frames.

    Parameters
    ----------
    los
        Line-of-sight gains H^LoS, complex128 [..., N_SB, N_E]; one row serves all F frames.
    multipath
        Multipath gains H^MP, complex128 [..., N_SB F, N_E] (sub-band-major), or 0.
    pattern
        T_i, complex128 [N_SB F, N_E].
    noise
        Thermal noise e, complex128 [..., N_SB F], or 0.
    symbol
        The user's symbol x.

    Returns
    -------
    numpy.ndarray
        y_i, complex128 [..., N_SB F].
    """
    n_subbands = los.shape[-2]
    frames = pattern.reshape(n_subbands, -1, pattern.shape[-1])
    # The diagonal of H T^T, without the rest: every sub-band meets its own F rows of T.
    direct = np.matmul(los[..., None, :], np.swapaxes(frames, -1, -2))
    combined = direct.reshape(*los.shape[:-2], -1)
    if np.ndim(multipath):
        combined = combined + np.einsum('...rm,rm->...r', multipath, pattern)
    return combined * symbol + noise


def mean_received(scenario: Scenario, beams: Beamforming, positions: np.ndarray) -> np.ndarray:
    """Mean of the received signals: Eq. (8) without multipath and noise.

    Parameters
    ----------
    scenario
        The scenario.
    beams
        Analog and digital beamforming.
    positions
        Positions of the user, float64 [N, 3] [m].

    Returns
    -------
    numpy.ndarray
        Complex128 [N, N_B, N_SB F], sub-band-major.

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    positions = checked_positions(positions)
    rows = scenario.n_subbands * scenario.n_frames
    mean = np.empty((len(positions), scenario.n_bands, rows), complex)
    for band, pattern in enumerate(radiation_matrix(scenario, beams)):
        for start in range(0, len(positions), _BLOCK):
            block = slice(start, start + _BLOCK)
            los = los_gain(scenario, positions[block], band)
            mean[block, band] = received_signal(los, 0.0, pattern, 0.0)
    return mean


def simulate_received(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray,
        rng: np.random.Generator) -> np.ndarray:
    """Simulate the received signals of independent positioning phases by Eq. (8).

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming.
    positions
        Position of the user in each phase, float64 [N, 3] [m].
    rng
        Source of randomness.

    Returns
    -------
    numpy.ndarray
        Complex128 [N, N_B, N_SB F], sub-band-major.

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    positions = checked_positions(positions)
    patterns = radiation_matrix(scenario, codebook)
    received = np.empty((len(positions), *patterns.shape[:2]), complex)
    amplitude = np.sqrt(scenario.noise_power_w)
    for start in range(0, len(positions), _BLOCK):
        block = positions[start:start + _BLOCK]
        for band, pattern in enumerate(patterns):
            los = los_gain(scenario, block, band)
            gains = draw_multipath(scenario, band, len(block), rng)
            noise = amplitude * complex_normal((len(block), pattern.shape[0]), rng)
            received[start:start + _BLOCK, band] = received_signal(los, gains, pattern, noise)
    return received


def receive_feeds(
        scenario: Scenario, codebook: Beamforming, feeds: np.ndarray,
        rng: np.random.Generator | None) -> np.ndarray:
    """Combine the feed signals of a positioning phase as the base station does, by Eq. (7).

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        Analog and digital beamforming; the digital part combines.
    feeds
        Signals at the feeds, complex128 [N_B, F, N_SB, K].
    rng
        Source of the thermal noise; None where the feeds have their own.

    Returns
    -------
    numpy.ndarray
        Complex128 [N_B, N_SB, F].
    """
    shape = codebook.digital.shape[:3]
    noise = 0.0
    if rng is not None:
        noise = np.sqrt(scenario.noise_power_w) * complex_normal(shape, rng)
    return combine(codebook.digital, np.swapaxes(feeds, 1, 2), noise)
