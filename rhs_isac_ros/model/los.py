"""Line-of-sight gains of the elements and their derivatives with respect to the user's position.

Positions are those of the user, float64 [N, 3] [m]; `band` is an index from 0. Functions that take
positions raise ValueError if the shape is wrong or a value is not finite.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.geometry import element_positions, subband_frequencies_hz
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario

# Minimum distance of the user from an element's boresight. On boresight, the direction in which
# the angle grows is undefined.
_MIN_BORESIGHT_OFFSET_M = 1e-9


def los_gain(scenario: Scenario, positions: np.ndarray, band: int) -> np.ndarray:
    """Compute the line-of-sight gains h^LoS, complex128 [N, N_SB, N_E], defined below Eq. (1)."""
    offsets, distances = _separation(scenario, positions)
    return _gain(scenario, distances, band, _amplitude(scenario, offsets))


def draw_blocked(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw whether n users lack the direct path, bool [n]."""
    if not scenario.blocked_probability:
        return np.zeros(n, bool)
    return rng.spawn(1)[0].random(n) < scenario.blocked_probability


def direct_gain(scenario: Scenario, positions: np.ndarray, band: int,
                blocked: np.ndarray | None = None) -> np.ndarray:
    """Compute the gains without random multipath, complex128 [N, N_SB, N_E].

    These are the gains of `los_gain`, or with a channel file the sums over the paths of the users
    nearest to the positions. Users that are `blocked`, bool [N], have no direct path.
    """
    channel = scenario.channel
    blocked = np.zeros(len(positions), bool) if blocked is None else blocked
    if not channel:
        gains = los_gain(scenario, positions, band)
        gains[blocked] = 0
        return gains
    total = np.zeros((len(positions), scenario.n_subbands, scenario.n_elements), complex)
    for row, user in enumerate(channel.nearest(checked_positions(positions)).tolist()):
        (present,) = np.nonzero(
            (channel.coefficients[user] != 0) & ~(blocked[row] & (channel.n[user] == 0)))
        weights = channel.coefficients[user, present, None]
        if channel.gains is not None:
            weights = weights * channel.gains[user, present]
        paths = los_gain(scenario, channel.sources[user, present], band)
        total[row] = np.sum(paths * weights[:, None], axis=0)
    return total


def los_sums(scenario: Scenario, positions: np.ndarray, bands: Sequence[int],
             weights: np.ndarray) -> np.ndarray:
    """Sum the gains of `los_gain` over the elements in n bands, complex128 [n, N, N_SB].

    The weights are complex128 [n, N_SB, N_E]. The gains of all elements and sub-bands are not
    stored, and the bands share their exponentials.
    """
    offsets, distances = _separation(scenario, positions)
    amplitudes = _amplitude(scenario, offsets) / distances
    phase_rate = -2j * np.pi / SPEED_OF_LIGHT_MPS * distances
    step = np.exp(phase_rate * scenario.subband_width_hz)
    sums = np.empty((len(bands), len(distances), scenario.n_subbands), complex)
    for index, band in enumerate(bands):
        frequencies = subband_frequencies_hz(scenario)[band]
        gain = np.exp(phase_rate * frequencies[0])
        gain *= amplitudes
        for subband, row in enumerate(weights[index]):
            if subband:
                gain *= step
            np.matmul(gain, row, out=sums[index, :, subband])
        sums[index] /= frequencies
    return sums


def los_and_derivative(
        scenario: Scenario, positions: np.ndarray, band: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute `los_gain` and its derivative, complex128 [N, 3, N_SB, N_E] [1/m].

    The derivative is the H-dot of Eq. (13): dh/dp_u = h (-i 2 pi f / v_0 - 1 / d) (p - p_m)_u / d.
    A gain pattern adds a term for the change of the gain with the angle from the boresight.
    """
    gain, radial, boresight_term = los_derivative_terms(scenario, positions, band)
    offsets = np.moveaxis(_separation(scenario, positions)[0], 2, 1)
    derivative = radial[:, None] * offsets[:, :, None, :]
    if boresight_term is not None:
        derivative[:, 0] += boresight_term
    return gain, derivative


def los_derivative_terms(
        scenario: Scenario, positions: np.ndarray, band: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Compute `los_gain` and the factors of its derivative.

    The derivative with respect to the user's position p is dh/dp = a (p - p_m) + b e_x. The
    boresight term b exists only with a gain pattern, which adds (dh/dtheta) (dtheta/dp) for the
    angle theta from the boresight: dtheta/dp = ((p - p_m) cos theta / d - e_x) / (d sin theta).

    Returns h^LoS, complex128 [N, N_SB, N_E], and of the same shape the radial factor a [1/m^2]
    and the boresight term b [1/m], which is None without a gain pattern.
    """
    offsets, distances = _separation(scenario, positions)
    gain = _gain(scenario, distances, band, _amplitude(scenario, offsets))
    wavenumbers = 2 * np.pi * subband_frequencies_hz(scenario)[band] / SPEED_OF_LIGHT_MPS
    inverse = (1 / distances)[:, None, :]
    radial = np.empty_like(gain)
    radial.real = -inverse**2
    radial.imag = -wavenumbers[:, None] * inverse
    radial *= gain
    if constant_gain(scenario) is not None:
        return gain, radial, None
    by_angle = _gain(scenario, distances, band, _amplitude(scenario, offsets, slope=True))
    # On boresight, where dtheta/dp has no direction, a smooth pattern has zero slope.
    boresight_offsets = np.hypot(offsets[..., 1], offsets[..., 2])
    sine = np.maximum(boresight_offsets, _MIN_BORESIGHT_OFFSET_M) / distances
    boresight_term = by_angle / -(distances * sine)[:, None]
    radial -= boresight_term * (offsets[..., 0] / distances**2)[:, None]
    return gain, radial, boresight_term


def checked_positions(positions: ArrayLike) -> np.ndarray:
    """Convert positions to float64 [N, 3] [m]; raise ValueError if they are not finite [N, 3]."""
    array = np.asarray(positions, dtype=float)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f'positions: shape {array.shape}, expected [N, 3]')
    if not np.isfinite(array).all():
        raise ValueError('positions: not finite, expected finite coordinates in metres')
    return array


def _separation(scenario: Scenario, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vectors from every element to the user [N, N_E, 3] [m] and their lengths [N, N_E] [m]."""
    offsets = checked_positions(positions)[:, None, :] - element_positions(scenario)
    return offsets, np.sqrt(np.einsum('nmu,nmu->nm', offsets, offsets))


def constant_gain(scenario: Scenario) -> float | None:
    """Return the product of the gains of elements and users; None if one is a pattern."""
    element, user = scenario.element_gain, scenario.user_gain
    if isinstance(element, GainPattern) or isinstance(user, GainPattern):
        return None
    return element * user


def _amplitude(
        scenario: Scenario, offsets: np.ndarray, *, slope: bool = False) -> float | np.ndarray:
    """Gain times distance and frequency [m Hz], or its derivative by the angle [m Hz/rad].

    Returns a number, or float64 [N, N_E] if there is a gain pattern.
    """
    gains = scenario.element_gain, scenario.user_gain
    angles = np.zeros(())
    if constant_gain(scenario) is None:
        angles = np.arctan2(np.hypot(offsets[..., 1], offsets[..., 2]), offsets[..., 0])
    element, user = (
        gain.amplitude(angles) if isinstance(gain, GainPattern) else gain for gain in gains)
    if slope:
        by_element, by_user = (
            gain.slope(angles) if isinstance(gain, GainPattern) else 0.0 for gain in gains)
        return SPEED_OF_LIGHT_MPS * (by_element * user + element * by_user) / (4 * np.pi)
    return SPEED_OF_LIGHT_MPS * element * user / (4 * np.pi)


def _gain(scenario: Scenario, distances: np.ndarray, band: int,
          amplitude: float | np.ndarray) -> np.ndarray:
    frequencies = subband_frequencies_hz(scenario)[band]
    # Sub-bands are equally spaced: two exponentials and a running product replace N_SB
    # exponentials.
    phase_rate = -2j * np.pi / SPEED_OF_LIGHT_MPS * distances
    gain = np.empty((len(distances), scenario.n_subbands, distances.shape[1]), complex)
    gain[:, 0] = np.exp(phase_rate * frequencies[0])
    gain[:, 0] *= amplitude / distances
    step = np.exp(phase_rate * scenario.subband_width_hz)
    for subband in range(1, scenario.n_subbands):
        np.multiply(gain[:, subband - 1], step, out=gain[:, subband])
    gain /= frequencies[:, None]
    return gain
