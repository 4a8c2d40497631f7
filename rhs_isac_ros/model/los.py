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
    gain, rate = los_and_rate(scenario, positions, band)
    offsets = np.moveaxis(_separation(scenario, positions)[0], 2, 1)
    return gain, rate[:, None] * offsets[:, :, None, :]


def los_and_rate(
        scenario: Scenario, positions: np.ndarray, band: int) -> tuple[np.ndarray, np.ndarray]:
    """`los_gain` and what its derivative is besides the way from the element to the user.

    The derivative by the user's position p is dh/dp = a (p - p_m): who only needs its products
    with weights of the elements can draw p - p_m out of them.

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
        h^LoS, complex128 [N, N_SB, N_E], and a of the same shape [1/m^2].

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    _, distances = _separation(scenario, positions)
    gain = _gain(scenario, distances, band)
    wavenumbers = 2 * np.pi * subband_frequencies_hz(scenario)[band] / SPEED_OF_LIGHT_MPS
    inverse = (1 / distances)[:, None, :]
    rate = np.empty_like(gain)
    rate.real = -inverse**2
    rate.imag = -wavenumbers[:, None] * inverse
    rate *= gain
    return gain, rate


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
    amplitude = SPEED_OF_LIGHT_MPS * scenario.element_gain * scenario.user_gain / (4 * np.pi)
    phasors[:, 0] = np.exp(rate * frequencies[0])
    phasors[:, 0] *= amplitude / distances
    step = np.exp(rate * scenario.subband_width_hz)
    for subband in range(1, scenario.n_subbands):
        np.multiply(phasors[:, subband - 1], step, out=phasors[:, subband])
    phasors /= frequencies[:, None]
    return phasors
