"""Line-of-sight gains of the elements and their derivatives with respect to the user's position.

`positions`, float64 [N, 3] [m], are positions of users, and `band` is an index from 0. Public
functions except `los_waves` raise ValueError unless `checked_positions` accepts the positions.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from rhs_isac_ros.model import geometry
from rhs_isac_ros.model.arrays import checked_positions
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.scenario import Scenario

# Minimum distance of the user from a boresight. On the boresight itself, the direction
# in which the angle grows is undefined.
_MIN_BORESIGHT_OFFSET_M = 1e-9
# Gain, radial factor [1/m^2], and a boresight term [1/m] for each of `boresight_axes`, all times
# the frequency [Hz], complex128 [B, N_SB, N, N_E] for B bands.
Waves: TypeAlias = tuple[np.ndarray, np.ndarray, list[np.ndarray]]
# Number of unit phasors in the table of `_phasors`.
_N_PHASORS = 512
_TABLE = np.exp(2j * np.pi * np.arange(_N_PHASORS) / _N_PHASORS)
# Elements of the surface, as an index; by default, all.
_Elements: TypeAlias = slice | list[int]
_ALL = slice(None)


def los_gain(scenario: Scenario, positions: np.ndarray, band: int, elements: _Elements = _ALL
             ) -> np.ndarray:
    """Compute the line-of-sight gains h^LoS, complex128 [N, N_SB, N_E], defined below Eq. (1)."""
    gain, _, _ = los_waves(
        scenario, checked_positions(positions), [band], elements, slopes=False)
    return _positions_first(scenario, band, gain[0])


def draw_blocked(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw which of n users are blocked, that is, have no direct path, bool [n]."""
    if not scenario.blocked_probability:
        return np.zeros(n, bool)
    return rng.spawn(1)[0].random(n) < scenario.blocked_probability


def direct_gain(scenario: Scenario, positions: np.ndarray, band: int,
                blocked: np.ndarray | None = None, shifts: np.ndarray | None = None) -> np.ndarray:
    """Compute the gains without random multipath, complex128 [N, N_SB, N_E].

    Without a channel file, these are the gains of `los_gain`. With one, the gain at a position is
    the sum over the paths of the nearest user in the file. `blocked`, bool [N], marks users whose
    direct path is left out. `shifts`, float64 [N, 3] [m], are how far users have moved from the
    positions; with a channel file, their paths move with them (see `PathChannel.moved`).
    """
    channel = scenario.channel
    blocked = np.zeros(len(positions), bool) if blocked is None else blocked
    if not channel:
        gains = los_gain(
            scenario, positions if shifts is None else positions + shifts, band)
        gains[blocked] = 0
        return gains
    total = np.zeros((len(positions), scenario.n_subbands, scenario.n_elements), complex)
    for row, user in enumerate(channel.nearest(checked_positions(positions)).tolist()):
        (present,) = np.nonzero(
            (channel.coefficients[user] != 0) & ~(blocked[row] & (channel.n[user] == 0)))
        weights = channel.coefficients[user, present, None]
        if channel.gains is not None:
            weights = weights * channel.gains[user, present]
        sources = channel.sources[user, present] if shifts is None else channel.moved(
            user, shifts[row])[present]
        paths = los_gain(scenario, sources, band)
        total[row] = np.sum(paths * weights[:, None], axis=0)
    return total


def los_sums(scenario: Scenario, positions: np.ndarray, bands: Sequence[int],
             weights: np.ndarray) -> np.ndarray:
    """Sum `los_gain` of n bands over elements, weighted [n, N_SB, N_E]; return [n, N, N_SB]."""
    gain, _, _ = los_waves(scenario, checked_positions(positions), bands, slopes=False)
    scaled = weights / geometry.subband_frequencies_hz(scenario)[list(bands), :, None]
    return np.swapaxes((gain @ scaled[..., None])[..., 0], 1, 2)


def los_and_derivative(
        scenario: Scenario, positions: np.ndarray, band: int, elements: _Elements = _ALL
        ) -> tuple[np.ndarray, np.ndarray]:
    """Compute `los_gain` and its derivative, complex128 [N, 3, N_SB, N_E] [1/m].

    The derivative is the H-dot of Eq. (13): dh/dp_u = h (-i 2 pi f / v_0 - 1 / d) (p - p_m)_u / d.
    A gain pattern adds a term for the change of the gain with the angle from the boresight.
    """
    positions = checked_positions(positions)
    *parts, boresight_terms = los_waves(scenario, positions, [band], elements)
    gain, radial = (_positions_first(scenario, band, part[0]) for part in parts)
    derivative = radial[:, None] * np.moveaxis(
        _offsets(scenario, positions, elements), 2, 1)[:, :, None]
    for axis, term in zip(boresight_axes(scenario), boresight_terms, strict=True):
        derivative[:, axis] += _positions_first(scenario, band, term[0])
    return gain, derivative


def frame_gains(scenario: Scenario, states: np.ndarray, by_unknown: np.ndarray,
                elements: _Elements = _ALL) -> np.ndarray:
    """Compute the gains of elements in the frames of a cycle, and their derivatives.

    Takes states of users, float64 [N, 3] [m] or [N, 6] [m, m/s], and their derivatives with
    respect to U unknowns, [N, 3 or 6, U]. Returns complex128 [N, 1 + U, N_B, N_SB, F, n] for n
    elements. Without velocities, the gains of all frames are equal, and F is 1.
    """
    times_s = (np.zeros((scenario.n_bands, 1)) if states.shape[1] == 3
               else geometry.frame_times_s(scenario))
    n_elements, n_unknowns = len(np.arange(scenario.n_elements)[elements]), by_unknown.shape[2]
    found = np.empty((len(states), 1 + n_unknowns, len(times_s), scenario.n_subbands,
                      times_s.shape[1], n_elements), complex)
    for (band, frame), time_s in np.ndenumerate(times_s):
        # The position at the time of the frame, from the state.
        moved = np.vstack([np.eye(3), time_s * np.eye(3)])[:states.shape[1]]
        places, of_frame = states @ moved, found[:, :, band, :, frame]
        if not n_unknowns:
            of_frame[:, 0] = los_gain(scenario, places, band, elements)
            continue
        of_frame[:, 0], slope = los_and_derivative(scenario, places, band, elements)
        of_frame[:, 1:] = np.einsum('nxu,nxjm->nujm', np.matmul(moved.T, by_unknown), slope)
    return found


def los_waves(scenario: Scenario, positions: np.ndarray, bands: Sequence[int],
              elements: _Elements = _ALL, *, slopes: bool = True) -> Waves:
    """Compute h^LoS times the frequency, and factors of its derivative.

    The derivative with respect to the user's position p is dh/dp = a (p - p_m) + b. The vector b
    exists only with a gain pattern, which adds (dh/dtheta) (dtheta/dp) for the angle theta from a
    boresight n: dtheta/dp = ((p - p_m) cos theta / d - n) / (d sin theta). The terms are the
    components of b along `boresight_axes`.
    Without `slopes`, the gain is repeated in place of a, and there are no terms.
    """
    places = geometry.element_positions(scenario)[elements]
    distances = np.sqrt(sum(
        (positions[:, axis, None] - places[:, axis])**2 for axis in range(3)))
    inverse, turn = 1 / distances, -2 * np.pi / SPEED_OF_LIGHT_MPS * distances
    # Sub-bands are equally spaced: two phasors and a running product replace N_SB phasors.
    step = _phasors(turn * scenario.spacing_hz) if scenario.n_subbands > 1 else turn
    boresights = _boresights(scenario, positions, elements)
    amplitude = inverse * _amplitude(scenario, boresights)

    def over_subbands(first: np.ndarray) -> np.ndarray:
        waves = np.empty((len(first), scenario.n_subbands, *first.shape[1:]), complex)
        waves[:, 0] = first
        for subband in range(1, scenario.n_subbands):
            np.multiply(waves[:, subband - 1], step, out=waves[:, subband])
        return waves

    frequencies = geometry.subband_frequencies_hz(scenario)[list(bands)]
    phasors = _phasors(turn * frequencies[:, :1, None])
    gain = over_subbands(phasors * amplitude)
    if not slopes:
        return gain, gain, []
    radial = np.empty(gain.shape, complex)
    radial.real = -inverse**2
    wavenumbers = 2 * np.pi / SPEED_OF_LIGHT_MPS * frequencies
    np.multiply(-wavenumbers[:, :, None, None], inverse, out=radial.imag)
    radial *= gain
    terms: dict[int, np.ndarray] = {}
    for one in boresights:
        # On boresight, where dtheta/dp has no direction, a smooth pattern has zero slope.
        across_m = np.maximum(one.across_m, _MIN_BORESIGHT_OFFSET_M)
        by_angle = _amplitude(scenario, boresights, one)
        along = over_subbands(phasors * (-by_angle * inverse / across_m))
        radial -= along * (inverse**2 * one.along_m)
        for axis, part in enumerate([along] if one.normals is None else (
                along * component for component in one.normals.T)):
            terms[axis] = terms[axis] + part if axis in terms else part
    return gain, radial, [*terms.values()]


def boresight_axes(scenario: Scenario) -> Sequence[int]:
    """Return the axes along which a boresight with a gain pattern has components."""
    gains = scenario.element_gain, scenario.user_gain
    if scenario.element_normals is not None and isinstance(gains[0], GainPattern):
        return range(3)
    return range(any(isinstance(gain, GainPattern) for gain in gains))


def _positions_first(scenario: Scenario, band: int, waves: np.ndarray) -> np.ndarray:
    """Divide an array of `Waves` by the frequency, and return it as [N, N_SB, N_E]."""
    frequencies_hz = geometry.subband_frequencies_hz(scenario)[band]
    return np.divide(np.moveaxis(waves, 0, 1), frequencies_hz[:, None], order='C')


def _offsets(scenario: Scenario, positions: np.ndarray, elements: _Elements) -> np.ndarray:
    """Return the vectors from elements to the user, float64 [N, N_E, 3] [m]."""
    return positions[:, None, :] - geometry.element_positions(scenario)[elements]


class _Boresight(NamedTuple):
    """A boresight, the components of `_offsets` along and across it, and the gains about it."""

    normals: np.ndarray | None  # Unit vectors, float64 [N_E, 3]; None for x.
    along_m: np.ndarray  # Float64 [N, N_E].
    across_m: np.ndarray  # Float64 [N, N_E].
    gains: tuple[str, ...]  # Names of fields of the scenario.


def _boresights(scenario: Scenario, positions: np.ndarray, elements: _Elements
                ) -> list[_Boresight]:
    """Return the boresights that have gain patterns; the user's one is parallel to x."""
    gains = 'element_gain', 'user_gain'
    normals = None if scenario.element_normals is None else geometry.element_normals(
        scenario)[elements]
    found: list[_Boresight] = []
    for facing, names in [(None, gains)] if normals is None else [
            (normals, gains[:1]), (None, gains[1:])]:
        if not any(isinstance(getattr(scenario, name), GainPattern) for name in names):
            continue
        offsets = _offsets(scenario, positions, elements)
        along_m, across_m = offsets[..., 0], np.hypot(offsets[..., 1], offsets[..., 2])
        if facing is not None:
            along_m = np.sum(offsets * facing, axis=-1)
            across_m = np.linalg.norm(np.cross(offsets, facing), axis=-1)
        found.append(_Boresight(facing, along_m, across_m, names))
    return found


def _amplitude(scenario: Scenario, boresights: Sequence[_Boresight],
               turned: _Boresight | None = None) -> float | np.ndarray:
    """Return abs(h) d f [m Hz] of gains h, a number or [N, N_E].

    With `turned`, return the derivative with respect to the angle from this boresight.
    """
    factors: dict[str, Any] = {
        name: getattr(scenario, name) for name in ('element_gain', 'user_gain')}
    slopes: dict[str, Any] = dict.fromkeys(factors, 0.0)
    for one in boresights:
        angles = np.arctan2(one.across_m, one.along_m)
        for name in one.gains:
            if isinstance(gain := factors[name], GainPattern):
                factors[name] = gain.amplitude(angles)
                slopes[name] = gain.slope(angles) if one is turned else 0.0
    element, user = factors.values()
    if turned is not None:
        by_element, by_user = slopes.values()
        return SPEED_OF_LIGHT_MPS * (by_element * user + element * by_user) / (4 * np.pi)
    return SPEED_OF_LIGHT_MPS * element * user / (4 * np.pi)


def _phasors(phases: np.ndarray) -> np.ndarray:
    """Compute exp(i phase) from a table and a Taylor series, three times as fast as `np.exp`.

    The error is below 1e-15, or below the rounding of a large phase.
    """
    turns = phases * (_N_PHASORS / (2 * np.pi))
    nearest = np.rint(turns)
    rest = (turns - nearest) * (2 * np.pi / _N_PHASORS)
    square = rest * rest
    phasors = _TABLE.take(nearest.astype(np.intp) & (_N_PHASORS - 1))
    rotation = np.empty(phases.shape, complex)
    rotation.real = 1 - square * (0.5 - square * (1 / 24))
    rotation.imag = rest * (1 - square * (1 / 6 - square * (1 / 120)))
    phasors *= rotation
    return phasors
