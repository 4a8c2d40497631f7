"""The line-of-sight path: gain of every element and its derivative by the user's position."""

import numpy as np

from rhs_isac_ros.model.gain_pattern import GainPattern, amplitude_of
from rhs_isac_ros.model.geometry import element_positions, subband_frequencies_hz
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario

# Nearer to the boresight than this, the angle has no direction.
_LEAST_OFFSET_M = 1e-9


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
    offsets, distances = _separation(scenario, positions)
    return _gain(scenario, distances, band, _amplitude(scenario, offsets))


def los_derivative(scenario: Scenario, positions: np.ndarray, band: int) -> np.ndarray:
    """Derivative of the line-of-sight gain by the three coordinates of the user.

    The H-dot of Eq. (13): dh/dp_u = h (-i 2 pi f / v_0 - 1 / d) (p - p_m)_u / d, and with a gain
    pattern what the angle from the boresight adds.

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
    gain, rate, lift = los_and_rate(scenario, positions, band)
    offsets = np.moveaxis(_separation(scenario, positions)[0], 2, 1)
    derivative = rate[:, None] * offsets[:, :, None, :]
    if lift is not None:
        derivative[:, 0] += lift
    return gain, derivative


def los_and_rate(
        scenario: Scenario, positions: np.ndarray, band: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """`los_gain` and what its derivative is besides the way from the element to the user.

    The derivative by the user's position p is dh/dp = a (p - p_m) + b e_x: who only needs its
    products with weights of the elements can draw p - p_m out of them. Only a gain pattern has a
    b: with the angle theta from the boresight, it adds (dh/dtheta) (dtheta/dp) with
    dtheta/dp = ((p - p_m) cos theta / d - e_x) / (d sin theta).

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
        h^LoS, complex128 [N, N_SB, N_E], a of the same shape [1/m^2], and b [1/m] or None.

    Raises
    ------
    ValueError
        If `positions` is not a finite [N, 3] array.
    """
    offsets, distances = _separation(scenario, positions)
    gain = _gain(scenario, distances, band, _amplitude(scenario, offsets))
    wavenumbers = 2 * np.pi * subband_frequencies_hz(scenario)[band] / SPEED_OF_LIGHT_MPS
    inverse = (1 / distances)[:, None, :]
    rate = np.empty_like(gain)
    rate.real = -inverse**2
    rate.imag = -wavenumbers[:, None] * inverse
    rate *= gain
    if not _has_pattern(scenario):
        return gain, rate, None
    by_angle = _gain(scenario, distances, band, _amplitude_slope(scenario, offsets))
    # Straight ahead, where the direction of dtheta/dp is open, a smooth pattern has no slope.
    sine = np.maximum(np.hypot(offsets[..., 1], offsets[..., 2]), _LEAST_OFFSET_M) / distances
    lift = by_angle / -(distances * sine)[:, None]
    rate -= lift * (offsets[..., 0] / distances**2)[:, None]
    return gain, rate, lift


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


def _has_pattern(scenario: Scenario) -> bool:
    return any(isinstance(gain, GainPattern)
               for gain in (scenario.element_gain, scenario.user_gain))


def _angles(offsets: np.ndarray) -> np.ndarray:
    """Angles [rad] between the boresight and vectors from elements to the user."""
    return np.arctan2(np.hypot(offsets[..., 1], offsets[..., 2]), offsets[..., 0])


def _amplitude(scenario: Scenario, offsets: np.ndarray) -> float | np.ndarray:
    """Gain times distance and frequency: a number, or float64 [N, N_E] [m Hz]."""
    element, user = scenario.element_gain, scenario.user_gain
    if _has_pattern(scenario):
        angles = _angles(offsets)
        element, user = amplitude_of(element, angles), amplitude_of(user, angles)
    return SPEED_OF_LIGHT_MPS * element * user / (4 * np.pi)


def _amplitude_slope(scenario: Scenario, offsets: np.ndarray) -> np.ndarray:
    """Derivative of `_amplitude` by the angle, float64 [N, N_E] [m Hz/rad]."""
    angles = _angles(offsets)
    gains = scenario.element_gain, scenario.user_gain
    slopes = [gain.slope(angles) if isinstance(gain, GainPattern) else 0.0 for gain in gains]
    element, user = (amplitude_of(gain, angles) for gain in gains)
    return SPEED_OF_LIGHT_MPS * (slopes[0] * user + element * slopes[1]) / (4 * np.pi)


def _gain(scenario: Scenario, distances: np.ndarray, band: int,
          amplitude: float | np.ndarray) -> np.ndarray:
    frequencies = subband_frequencies_hz(scenario)[band]
    # Sub-bands are equally spaced: two exponentials and a running product replace N_SB of them.
    rate = -2j * np.pi / SPEED_OF_LIGHT_MPS * distances
    phasors = np.empty((len(distances), scenario.n_subbands, distances.shape[1]), complex)
    phasors[:, 0] = np.exp(rate * frequencies[0])
    phasors[:, 0] *= amplitude / distances
    step = np.exp(rate * scenario.subband_width_hz)
    for subband in range(1, scenario.n_subbands):
        np.multiply(phasors[:, subband - 1], step, out=phasors[:, subband])
    phasors /= frequencies[:, None]
    return phasors
