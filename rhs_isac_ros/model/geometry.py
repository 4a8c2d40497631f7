"""Positions of elements and feeds, frequencies of sub-bands, times of frames, polar coordinates.

The polar coordinates (r, u, v) of a position in front of the surface are its range r and its
direction cosines u along y and v along z: it is at r (w, u, v) with w = sqrt(1 - u^2 - v^2).
"""

import functools

import numpy as np

from rhs_isac_ros.model.arrays import read_only
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.scenario import Scenario

# Lower limit of x in conversions [m]; the model is not defined at x = 0.
_MIN_X_M = 1e-15
# Change of the phase in a cycle below which users are taken for users at rest [rad].
_AT_REST_RAD = 1.0
# Way in a cycle up to which users are found, relative to the shortest range of the region.
_LONGEST_WAY = 0.5
# Lower limit of a region's extent [wavelengths]; the information for an extent of 0 is infinite.
_NO_EXTENT = 1e-5
# Derivative of (y, z) with respect to the position.
_ACROSS = np.eye(3)[1:]


def element_intervals_m(scenario: Scenario) -> np.ndarray:
    """Return the element spacing Delta_E along y and z, float64 [2] [m].

    It is a multiple of the mean wavelength (Section V).
    """
    wavelength_m = np.mean(SPEED_OF_LIGHT_MPS / np.array(scenario.center_frequencies_hz))
    return wavelength_m * np.broadcast_to(scenario.element_interval_wavelengths, 2)


@functools.lru_cache(maxsize=16)
def element_positions(scenario: Scenario) -> np.ndarray:
    """Return the positions of the elements, float64 [N_E, 3] [m], read-only.

    Unless the scenario specifies them, they form a grid in the plane x = 0, centred on the origin.
    The index of an element is then row * n_columns + column; a row runs along y, a column along z.
    """
    if scenario.element_positions_m is not None:
        return read_only(np.array(scenario.element_positions_m))
    y, z = ((np.arange(n) - (n - 1) / 2) * interval_m for n, interval_m in zip(
        (scenario.n_columns, scenario.n_rows), element_intervals_m(scenario), strict=True))
    lattice = np.zeros((scenario.n_rows, scenario.n_columns, 3))
    lattice[..., 1], lattice[..., 2] = y, z[:, None]
    return read_only(lattice.reshape(-1, 3))


@functools.lru_cache(maxsize=16)
def element_normals(scenario: Scenario) -> np.ndarray:
    """Return the directions in which the elements face, unit vectors, float64 [N_E, 3], read-only.

    Unless the scenario specifies them, all are the x axis.
    """
    if scenario.element_normals is None:
        return read_only(np.tile([1.0, 0.0, 0.0], (scenario.n_elements, 1)))
    normals = np.array(scenario.element_normals)
    # Squares of the given numbers may underflow.
    normals /= np.abs(normals).max(axis=1, keepdims=True)
    return read_only(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def surface_sides_m(scenario: Scenario) -> np.ndarray:
    """Return the lengths of the surface along y and z, float64 [2] [m]."""
    intervals_m = element_intervals_m(scenario)
    if scenario.element_positions_m is not None:
        return np.ptp(element_positions(scenario)[:, 1:], axis=0) + intervals_m
    return intervals_m * (scenario.n_columns, scenario.n_rows)


def feed_positions(scenario: Scenario) -> np.ndarray:
    """Return the positions of the feeds, float64 [K, 3] [m].

    Unless the scenario specifies them, they are evenly spaced on the horizontal centre line.
    """
    if scenario.feed_positions_m is not None:
        return np.array(scenario.feed_positions_m)
    n_feeds = scenario.n_feeds
    length = surface_sides_m(scenario)[0]
    positions = np.zeros((n_feeds, 3))
    positions[:, 1] = ((np.arange(n_feeds) + 0.5) / n_feeds - 0.5) * length
    return positions


@functools.lru_cache(maxsize=16)
def subband_frequencies_hz(scenario: Scenario) -> np.ndarray:
    """Compute the sub-bands' centre frequencies f_{i,j}, float64 [N_B, N_SB] [Hz], read-only."""
    centers = np.array(scenario.center_frequencies_hz)[:, None]
    offsets = np.arange(scenario.n_subbands) - (scenario.n_subbands - 1) / 2
    return read_only(centers + offsets * scenario.spacing_hz)


@functools.lru_cache(maxsize=16)
def frame_lags_s(scenario: Scenario) -> np.ndarray:
    """Return the times of the frames of a band after its first one, float64 [F] [s], read-only."""
    return read_only(np.arange(scenario.n_frames) * scenario.frame_duration_s)


@functools.lru_cache(maxsize=16)
def frame_times_s(scenario: Scenario) -> np.ndarray:
    """Return the times of the frames of a cycle, float64 [N_B, F] [s], read-only.

    The bands follow each other in the order of the scenario, with `retune_s` between them. Times
    are relative to the *reference time* of the cycle, the mean of all of them. The position of a
    user is that at the reference time: its error is then nearly uncorrelated with that of the
    velocity.
    """
    band_s = scenario.n_frames * scenario.frame_duration_s + scenario.retune_s
    times = np.arange(scenario.n_bands)[:, None] * band_s + frame_lags_s(scenario)
    return read_only(times - times.mean())


def reference_s(scenario: Scenario) -> float:
    """Return the time from the first frame of a cycle to the reference time [s]."""
    return float(-frame_times_s(scenario)[0, 0])


def frames_s(scenario: Scenario) -> float:
    """Return the time from the first frame of a cycle to the last one [s]."""
    return float(np.ptp(frame_times_s(scenario)))


def stands_still(scenario: Scenario, speed_mps: float) -> bool:
    """Return whether a user with this speed may be taken for one at rest.

    The phase of the direct path then changes by less than `_AT_REST_RAD` from the first frame of a
    cycle to the last one.
    """
    turn = 2 * np.pi * max(scenario.center_frequencies_hz) / SPEED_OF_LIGHT_MPS
    return bool(turn * speed_mps * frames_s(scenario) < _AT_REST_RAD)


def movement_warning(scenario: Scenario) -> str:
    """Return a warning if users move in a cycle otherwise than estimators assume, or ''.

    They may move although no velocity is declared, or so far that the search, whose users stay at
    one range, may miss the position.
    """
    speed_mps, duration_s = scenario.max_user_speed_mps, frames_s(scenario)
    declared_mps = scenario.user_speed_std_mps
    nearest_m = float(polar_bounds(scenario.roi_bounds_m)[0, 0])
    if declared_mps * duration_s > _LONGEST_WAY * nearest_m:
        return (f'user_speed_std_mps: {declared_mps:g}, but such users move by '
                f'{declared_mps * duration_s:.2g} m in a cycle of {duration_s:.2g} s, and '
                f'positions may be wrong beyond {_LONGEST_WAY * nearest_m:.2g} m, '
                f'{_LONGEST_WAY:g} times the shortest range; expected at most '
                f'{_LONGEST_WAY * nearest_m / duration_s:.2g} m/s, or shorter frames')
    if declared_mps or stands_still(scenario, speed_mps):
        return ''
    return (f'user_speed_std_mps: 0, but users of max_user_speed_mps = {speed_mps:g} m/s move by '
            f'{speed_mps * duration_s:.2g} m in a cycle of {duration_s:.2g} s, and positions '
            f'assume that they stand still; declare about {speed_mps / 3**0.5:.2g} m/s for each '
            'component')


def measurement_times_s(scenario: Scenario) -> np.ndarray:
    """Return the times of all measurements of a cycle, sub-band-major, float64 [N_B, N_SB F]."""
    return np.tile(frame_times_s(scenario), scenario.n_subbands)


def velocity_std_mps(scenario: Scenario) -> np.ndarray:
    """Return the standard deviations of the components of a user's velocity, float64 [3] [m/s].

    They are 0 along axes without an extent of the region.
    """
    return scenario.user_speed_std_mps * (np.array(scenario.roi_size_m) > 0)


def to_positions(points: np.ndarray) -> np.ndarray:
    """Convert points (r [m], u, v), float64 [..., 3], to positions, float64 [..., 3] [m].

    Points outside the unit circle, u^2 + v^2 > 1, are given an x just above 0.
    """
    positions, u, v = np.array(points, float), points[..., 1], points[..., 2]
    positions[..., 0] = np.sqrt(np.maximum(1 - u * u - v * v, 0.0))
    positions *= points[..., :1]
    np.maximum(positions[..., 0], _MIN_X_M, out=positions[..., 0])
    return positions


def to_polar(positions: np.ndarray) -> np.ndarray:
    """Convert positions with x > 0, float64 [..., 3] [m], to (r [m], u, v), float64 [..., 3]."""
    points = np.empty(positions.shape)
    range_m = np.sqrt(np.einsum('...p,...p->...', positions, positions))[..., None]
    points[..., :1], points[..., 1:] = range_m, positions[..., 1:] / range_m
    return points


def jacobian(points: np.ndarray) -> np.ndarray:
    """Compute the derivative of the position with respect to r [m], u and v at points [N, 3].

    Returns float64 [N, 3, 3]: rows x, y and z, columns r, u and v. Here, w is at least 3e-5.
    """
    distance, u, v = points.T
    w = np.sqrt(np.maximum(1 - u**2 - v**2, 1e-9))
    matrix = np.zeros((len(points), 3, 3))
    matrix[:, 0, 0], matrix[:, 1, 0], matrix[:, 2, 0] = w, u, v
    matrix[:, 0, 1], matrix[:, 0, 2] = -distance * u / w, -distance * v / w
    matrix[:, 1, 1] = matrix[:, 2, 2] = distance
    return matrix


def polar_derivative(points: np.ndarray) -> np.ndarray:
    """Compute the derivative of (r [m], u, v) with respect to the position at points [N, 3].

    Returns float64 [N, 3, 3]: rows r, u and v, columns x, y and z, the inverse of `jacobian`.
    """
    matrix, cosines = np.empty((len(points), 3, 3)), points[:, 1:]
    matrix[:, 0, 0] = np.sqrt(np.maximum(1 - np.einsum('na,na->n', cosines, cosines), 0.0))
    matrix[:, 0, 1:] = cosines
    matrix[:, 1:] = (_ACROSS - cosines[:, :, None] * matrix[:, :1]) / points[:, :1, None]
    return matrix


def polar_bounds(bounds: np.ndarray) -> np.ndarray:
    """Compute the limits of (r [m], u, v), [2, 3], in a box with corners `bounds`, [2, 3] [m]."""
    nearest, farthest = np.clip(0.0, *bounds), np.abs(bounds).max(axis=0)
    limits = np.empty((2, 3))
    limits[:, 0] = np.linalg.norm(nearest), np.linalg.norm(farthest)
    for axis in (1, 2):
        # The magnitude of a cosine is largest where the other coordinates are nearest to 0.
        for side, bound in enumerate(bounds[:, axis]):
            outward = bound > 0 if side else bound < 0
            others = np.delete(nearest if outward else farthest, axis)
            limits[side, axis] = bound / np.hypot(bound, np.linalg.norm(others))
    return limits


def seen_bounds(scenario: Scenario) -> np.ndarray:
    """Return the bounds of the region in which a surface sees users of a site, [2, 3] [m].

    They include errors of the pose; see `Pose.seen`. With a measured covariance of the multipath,
    which belongs to a region, they are those of the region of interest.
    """
    bounds_m = scenario.roi_bounds_m
    return scenario.pose.seen(bounds_m) if scenario.multipath is None else bounds_m


def region_information(scenario: Scenario) -> np.ndarray:
    """Return the information of a Gaussian prior as wide as the region, float64 [3, 3] [1/m^2].

    The prior has the variances of a uniform distribution, size^2 / 12; size has a lower limit.
    """
    shortest = SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz)
    return np.diag(12 / np.maximum(scenario.roi_size_m, _NO_EXTENT * shortest)**2)
