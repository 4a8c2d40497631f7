"""The line-of-sight path: gain of every element and its derivative by the user's position."""

import numpy as np

from rhs_isac_ros.model.geometry import element_positions, subband_frequencies_hz
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario


def los_gain(scenario: Scenario, positions: np.ndarray, band: int) -> np.ndarray:
    """Line-of-sight gain of the paper, defined below Eq. (1).

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Positions of the user, float64 [N, 3] [m].
    band
        Index of the band, from 0.

    Returns
    -------
    numpy.ndarray
        h^LoS_{i,j,m}, complex128 [N, N_SB, N_E].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    _, distances = _separation(scenario, positions)
    return _gain(scenario, distances, band)


def los_derivative(scenario: Scenario, positions: np.ndarray, band: int) -> np.ndarray:
    """Derivative of the line-of-sight gain by the three coordinates of the user.

    The H-dot of Eq. (14): dh/dp_u = h (-i 2 pi f / v_0 - 1 / d) (p - p_m)_u / d.

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Positions of the user, float64 [N, 3] [m].
    band
        Index of the band, from 0.

    Returns
    -------
    numpy.ndarray
        Complex128 [N, 3, N_SB, N_E] [1/m].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    return los_and_derivative(scenario, positions, band)[1]


def los_and_derivative(
        scenario: Scenario, positions: np.ndarray, band: int) -> tuple[np.ndarray, np.ndarray]:
    """`los_gain` and `los_derivative` in one, for the price of the second.

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Positions of the user, float64 [N, 3] [m].
    band
        Index of the band, from 0.

    Returns
    -------
    tuple of numpy.ndarray
        Complex128 [N, N_SB, N_E] and [N, 3, N_SB, N_E] [1/m].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    offsets, distances = _separation(scenario, positions)
    gain = _gain(scenario, distances, band)
    wavenumbers = 2 * np.pi * subband_frequencies_hz(scenario)[band] / SPEED_OF_LIGHT_MPS
    slope = -1j * wavenumbers[:, None] - 1 / distances[:, None, :]
    slope *= gain
    directions = np.moveaxis(offsets / distances[..., None], 2, 1)
    return gain, slope[:, None] * directions[:, :, None, :]


def checked_positions(positions: np.ndarray) -> np.ndarray:
    """Return positions as a float64 array after checking their shape.

    Parameters
    ----------
    positions
        Positions, [N, 3] [m].

    Returns
    -------
    numpy.ndarray
        The same, float64 [N, 3] [m].

    Raises
    ------
    ValueError
        If the shape is another one or a value is not finite.
    """
    positions = np.asarray(positions, dtype=float)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f'positions: shape {positions.shape}, expected [N, 3]')
    if not np.isfinite(positions).all():
        raise ValueError('positions: not finite, expected finite coordinates in metres')
    return positions


def _separation(scenario: Scenario, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vectors from every element to the user [N, N_E, 3] and their lengths [N, N_E], in metres."""
    offsets = checked_positions(positions)[:, None, :] - element_positions(scenario)
    return offsets, np.sqrt(np.einsum('nmu,nmu->nm', offsets, offsets))


def _gain(scenario: Scenario, distances: np.ndarray, band: int) -> np.ndarray:
    frequencies = subband_frequencies_hz(scenario)[band]
    # Sub-bands are equally spaced: two exponentials and a running product replace N_SB of them.
    rate = -2j * np.pi / SPEED_OF_LIGHT_MPS * distances
    phasors = np.empty((len(distances), scenario.n_subbands, distances.shape[1]), complex)
    phasors[:, 0] = np.exp(rate * frequencies[0])
    if scenario.n_subbands > 1:
        phasors[:, 1:] = np.exp(rate * scenario.subband_width_hz)[:, None]
        np.cumprod(phasors, axis=1, out=phasors)
    amplitude = SPEED_OF_LIGHT_MPS * scenario.element_gain * scenario.user_gain / (4 * np.pi)
    phasors *= (amplitude / frequencies)[:, None]
    phasors /= distances[:, None, :]
    return phasors
