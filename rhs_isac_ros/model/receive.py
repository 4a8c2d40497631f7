"""Received signals of one band, simulated element by element or combined from feed signals."""

import numpy as np

from rhs_isac_ros.model.impairments import ElementErrors, draw_impairments
from rhs_isac_ros.model.los import checked_positions, direct_gain, draw_blocked
from rhs_isac_ros.model.multipath import complex_normal, draw_multipath
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, combine, radiation_matrix
from rhs_isac_ros.support.threads import one_blas_thread

# Phases simulated at a time. The random numbers of a seed depend on it.
_BLOCK = 256


def received_signal(
        los: np.ndarray, multipath: np.ndarray | float, radiation: np.ndarray,
        noise: np.ndarray | float, symbol: complex | np.ndarray = 1.0) -> np.ndarray:
    """Implements Eq. (8). Received signals y_i of one band, complex128 [..., N_SB F].

    Parameters
    ----------
    los
        Line-of-sight gains H^LoS, complex128 [..., N_SB, N_E]; one row serves all F frames.
    multipath
        Multipath gains H^MP, complex128 [..., N_SB F, N_E] (sub-band-major), or 0.
    radiation
        T_i, complex128 [N_SB F, N_E].
    noise
        Thermal noise e, complex128 [..., N_SB F], or 0.
    symbol
        The user's symbol x, or one for each measurement, complex128 [..., N_SB F].
    """
    n_subbands = los.shape[-2]
    frames = radiation.reshape(n_subbands, -1, radiation.shape[-1])
    # Only the diagonal of H T^T is needed: the F rows of T of each sub-band with its gains.
    direct = np.matmul(los[..., None, :], np.swapaxes(frames, -1, -2))
    combined = direct.reshape(*los.shape[:-2], -1)
    if np.ndim(multipath):
        combined = combined + np.einsum('...rm,rm->...r', multipath, radiation)
    return combined * symbol + noise


@one_blas_thread
def simulate_received(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray,
        rng: np.random.Generator, surface: ElementErrors | None = None) -> np.ndarray:
    """Simulate signals of independent positioning phases by Eq. (8), element by element.

    Takes the user's position in each phase, float64 [N, 3] [m], and returns complex128
    [N, N_B, N_SB F], sub-band-major. Impairments that the scenario declares are drawn too: a new
    user and a new cycle for each position, and one surface for all of them. With a channel file,
    the signals are those of its users nearest to the positions.

    Parameters
    ----------
    surface
        Errors of the elements; drawn from the scenario's distribution by default.

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array, or the codebook or the surface does not have
        the sizes of the scenario.
    """
    positions = checked_positions(positions)
    drawn, factors = draw_impairments(scenario, len(positions), rng)
    blocked = draw_blocked(scenario, len(positions), rng)
    surface = surface or drawn
    radiation = radiation_matrix(
        scenario, surface.applied_beams(codebook) if surface else codebook)
    n_bands, n_measurements, _ = radiation.shape
    received = np.empty((len(positions), n_bands, n_measurements), complex)
    amplitude = np.sqrt(scenario.noise_power_w)
    for start in range(0, len(positions), _BLOCK):
        block = positions[start:start + _BLOCK]
        hidden = None if blocked is None else blocked[start:start + _BLOCK]
        for band in range(n_bands):
            los = direct_gain(scenario, block, band, hidden)
            gains = (0.0 if scenario.channel
                     else draw_multipath(scenario, band, len(block), rng))
            noise = amplitude * complex_normal((len(block), n_measurements), rng)
            symbol = 1.0 if factors is None else factors[start:start + _BLOCK, band]
            received[start:start + _BLOCK, band] = received_signal(
                los, gains, radiation[band], noise, symbol)
    return received


def receive_feeds(
        scenario: Scenario, codebook: Beamforming, feeds: np.ndarray,
        rng: np.random.Generator | None) -> np.ndarray:
    """Combine the feed signals of a phase by Eq. (7), complex128 [N_B, N_SB, F].

    Parameters
    ----------
    feeds
        Signals at the feeds, complex128 [N_B, F, N_SB, K].
    rng
        Source of the thermal noise; None if the feed signals already contain noise.
    """
    shape = codebook.digital.shape[:3]
    noise: np.ndarray | float = 0.0
    if rng is not None:
        noise = np.sqrt(scenario.noise_power_w) * complex_normal(shape, rng)
    return combine(codebook.digital, np.swapaxes(feeds, 1, 2), noise)
