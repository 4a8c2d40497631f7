"""The pose of a surface in the frame of its site, and what its uncertainty adds to positions.

The model, and all signals of a surface, are in the frame of the surface: x outward, y left, z up.
Several surfaces of one site share the frame of the site. A pose converts between the two.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rhs_isac_ros.model.arrays import cross, numbers, read_only, to_tuples

# Smallest eigenvalue of a covariance relative to the largest one, up to rounding.
_MIN_EIGENVALUE = -1e-9
# Reach of errors in standard deviations, and largest share of the distance to a region by which
# they widen it.
_REACH, _NEARER = 3.0, 0.5
# Shapes of the fields.
_SHAPES: tuple[Sequence[tuple[int, ...]], ...] = [(3,)], [(4,)], [(2,), (6, 6)]


@dataclasses.dataclass(frozen=True)
class Pose:
    """Position and orientation of a surface in the frame of its site, with their uncertainty.

    The position x in the frame of the surface is the position R x + p of the site. The errors of
    the pose are a shift t of the surface and a turn of the surface about itself, by a small
    rotation vector a. Both are in the frame of the site and have the given covariance.

    Raises ValueError if a value does not have the expected shape, is not finite, or is no
    orientation or covariance.

    Examples
    --------
    >>> pose = Pose((0.0, 10.0, 1.0), (0.0, 0.0, -1.0, 1.0))  # Faces -y.
    >>> pose.to_site(np.array([[8.0, 0.0, 0.0]])).round(2)
    array([[0., 2., 1.]])
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: p, x, y, z [m].
    #: Quaternion of any length but 0: the rotation R from the surface to the site. A mapping of x,
    #: y, z and w is converted.
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    #: Standard deviations of each coordinate of t [m] and of a [deg], or the covariance [6, 6] of
    #: t [m] and a [rad]. 0 for a pose that is known exactly.
    uncertainty: tuple[float, ...] | tuple[tuple[float, ...], ...] = (0.02, 0.2)

    def __post_init__(self) -> None:
        """Convert every field to tuples of floats, and check it."""
        parts: Any = self.quaternion
        if isinstance(parts, Mapping):
            if parts.keys() != set('xyzw'):
                raise ValueError(f'quaternion: {parts!r}, expected x, y, z and w')
            object.__setattr__(self, 'quaternion', tuple(parts[name] for name in 'xyzw'))
        position, quaternion, uncertainty = (
            numbers(field.name, getattr(self, field.name), shapes=shapes)
            for field, shapes in zip(dataclasses.fields(self), _SHAPES, strict=True))
        unit_quaternion(quaternion)
        if uncertainty.ndim == 1 and uncertainty.min() < 0:
            raise ValueError(f'uncertainty: {uncertainty.min():g}, expected at least 0')
        if uncertainty.ndim == 2:
            _check_covariance('uncertainty', uncertainty)
        for name, array in (('position_m', position), ('quaternion', quaternion),
                            ('uncertainty', uncertainty)):
            object.__setattr__(self, name, to_tuples(array.tolist()))

    @functools.cached_property
    def origin(self) -> np.ndarray:
        """The position p, float64 [3] [m], read-only."""
        return read_only(np.array(self.position_m))

    @functools.cached_property
    def unit_quaternion(self) -> np.ndarray:
        """The quaternion x, y, z, w of length 1, float64 [4], read-only."""
        return read_only(unit_quaternion(np.array(self.quaternion)))

    @functools.cached_property
    def rotation(self) -> np.ndarray:
        """The matrix R, float64 [3, 3], read-only."""
        return read_only(rotation_matrix(np.array(self.quaternion)))

    def frames(self, n: int) -> 'Frames':
        """Return n equal frames."""
        return Frames(self.origin[None].repeat(n, axis=0), self.rotation[None].repeat(n, axis=0))

    @functools.cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the shift [m] and the rotation vector [rad], float64 [6, 6], read-only."""
        values = np.array(self.uncertainty)
        if values.ndim == 1:
            values = np.diag(np.repeat([values[0], math.radians(values[1])], 3)**2)
        return read_only(values)

    def to_site(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions, [..., 3] [m], from the frame of the surface to that of the site."""
        return self.vectors_to_site(positions) + self.origin

    def to_surface(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions, [..., 3] [m], from the frame of the site to that of the surface."""
        return self.vectors_to_surface(positions - self.origin)

    def states_to_surface(self, states: np.ndarray) -> np.ndarray:
        """Convert positions, [N, 3], or positions and velocities, [N, 6], as `to_surface`.

        Raises ValueError if the shape is another one, or a number is not finite.
        """
        states = numbers('positions', states, shapes=[('N', 3), ('N', 6)])
        places = self.to_surface(states[:, :3])
        return np.hstack([places, *(
            [self.vectors_to_surface(states[:, 3:])] if states.shape[1] > 3 else [])])

    def vectors_to_site(self, vectors: np.ndarray) -> np.ndarray:
        """Rotate vectors, such as velocities, [..., 3], into the frame of the site."""
        return vectors @ self.rotation.T

    def vectors_to_surface(self, vectors: np.ndarray) -> np.ndarray:
        """Rotate vectors, such as velocities, [..., 3], into the frame of the surface."""
        return vectors @ self.rotation

    def covariances_to_site(self, covariances: np.ndarray) -> np.ndarray:
        """Rotate covariances of vectors, [..., 3, 3], into the frame of the site."""
        return self.rotation @ covariances @ self.rotation.T

    def covariances_to_surface(self, covariances: np.ndarray) -> np.ndarray:
        """Rotate covariances of vectors, [..., 3, 3], into the frame of the surface."""
        return self.rotation.T @ covariances @ self.rotation

    def spread(self, positions: np.ndarray) -> np.ndarray:
        """Return the covariances that the pose adds to positions, float64 [..., 3, 3] [m^2].

        The positions, float64 [..., 3] [m], and the covariances are in the frame of the site.
        """
        turns = -_cross_matrices(positions - self.origin)
        by_error = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=-1)
        return by_error @ self.covariance @ np.swapaxes(by_error, -1, -2)

    def seen(self, bounds_m: np.ndarray) -> np.ndarray:
        """Return the bounds of a region in which a surface with the errors of the pose sees users.

        Bounds are float64 [2, 3] [m], in the frame of the surface. Where the region is thinner
        than three standard deviations of the errors on either side, the result is as thick as
        these: a user on a plane or a line of the site is beside it if the pose is off.
        """
        corners = np.stack(np.meshgrid(*bounds_m.T), axis=-1).reshape(-1, 3)
        covariances = self.covariances_to_surface(self.spread(self.to_site(corners)))
        reach = _REACH * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).max(axis=0))
        margin = np.maximum(reach - np.ptp(bounds_m, axis=0) / 2, 0.0)
        margin[0] = min(margin[0], max(_NEARER * bounds_m[0, 0], 0.0))
        return bounds_m + [-margin, margin]

    def scatter(self, positions: np.ndarray) -> np.ndarray:
        """Return `spread` to second order: the mean squares of errors of positions [..., 3].

        A turn moves a position along a sphere around the surface, so it changes the distance only
        to second order. This matters where signals determine the range far better.
        """
        sights, turns = positions - self.origin, self.covariance[3:, 3:]
        # Twice the coordinates of (a . x) a - |a|^2 x, the second-order move of x by a turn a, are
        # quadratic forms of a. Their moments are those of products of Gaussians.
        halves = np.eye(3)[:, :, None] * sights[..., None, None, :] / 2
        forms = (halves + np.swapaxes(halves, -1, -2)
                 - sights[..., :, None, None] * np.eye(3)) @ turns
        means = np.trace(forms, axis1=-2, axis2=-1)
        squares = np.einsum('...iab,...jba->...ij', forms, forms)
        bent: np.ndarray = (means[..., None] * means[..., None, :] + 2 * squares) / 4
        return self.spread(positions) + bent

    def spread_of_vectors(self, vectors: np.ndarray) -> np.ndarray:
        """Return the covariances that the pose adds to vectors [..., 3], such as velocities."""
        turns = _cross_matrices(vectors)
        return turns @ self.covariance[3:, 3:] @ np.swapaxes(turns, -1, -2)

    def displaced(self, error: ArrayLike) -> 'Pose':
        """Return the pose after an error: a shift [m] and a rotation vector [rad], [6]."""
        shift, turn = np.split(numbers('error', error), 2)
        angle = float(np.linalg.norm(turn))
        half = np.append(turn * np.sinc(angle / (2 * math.pi)) / 2, math.cos(angle / 2))
        moved = (self.origin + shift).tolist()
        turned = quaternion_product(half, self.unit_quaternion).tolist()
        return dataclasses.replace(self, position_m=moved, quaternion=turned)

    def error_of(self, other: 'Pose') -> np.ndarray:
        """Return the error that displaces this pose to another one, float64 [6]; see `displaced`.

        The rotation vector has a length of at most pi.
        """
        shift = other.origin - self.origin
        turn = quaternion_product(other.unit_quaternion, self.unit_quaternion * [-1, -1, -1, 1])
        turn = turn if turn[3] >= 0 else -turn
        sine = float(np.linalg.norm(turn[:3]))
        angle = 2 * math.atan2(sine, turn[3])
        return np.append(shift, turn[:3] * (angle / sine if sine else 2.0))


class Frames(NamedTuple):
    """The frames of M surfaces in that of the site, for positions or vectors [M, ..., 3]."""

    origin: np.ndarray  # Float64 [M, 3] [m].
    rotation: np.ndarray  # From the surface to the site, float64 [M, 3, 3].

    def to_site(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions [M, 3] [m]; see `Pose.to_site`."""
        return self.vectors_to_site(positions) + self.origin

    def to_surface(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions [M, 3] or [M, S, 3] [m]; see `Pose.to_surface`."""
        origin = self.origin[:, None] if positions.ndim > 2 else self.origin
        return _turned(positions - origin, self.rotation)

    def vectors_to_site(self, vectors: np.ndarray) -> np.ndarray:
        """Rotate vectors [M, 3]; see `Pose.vectors_to_site`."""
        return _turned(vectors, self.rotation.swapaxes(1, 2))

    def frames(self, _: int) -> 'Frames':
        """Return these frames."""
        return self


def _turned(vectors: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Multiply rows [M, 3] or [M, S, 3] by matrices [M, 3, 3]."""
    return np.matmul(vectors.reshape(len(vectors), -1, 3), rotations).reshape(vectors.shape)


def unit_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Return a quaternion [4] of any length except 0 with the length 1, or raise ValueError."""
    largest = np.abs(quaternion).max()
    if not 0 < largest < np.inf:
        raise ValueError(f'quaternion: {quaternion.tolist()}, expected finite numbers and a '
                         'length other than 0')
    # Squares of the given numbers may underflow or overflow.
    scaled = quaternion / largest
    return scaled / np.linalg.norm(scaled)


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix [3, 3] of a quaternion x, y, z, w, as `unit_quaternion`."""
    x, y, z, w = unit_quaternion(quaternion)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def quaternion_product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the quaternion of two successive rotations: first `other`, then `one`."""
    (u, a), (v, b) = (one[:3], one[3]), (other[:3], other[3])
    return np.append(a * v + b * u + cross(u, v), a * b - u @ v)


def _cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices [..., 3, 3] whose products with a vector are cross products."""
    return cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)


def _check_covariance(name: str, matrix: np.ndarray) -> None:
    """Raise ValueError unless a matrix is symmetric and has no negative eigenvalues."""
    scale = np.abs(matrix).max()
    values = np.linalg.eigvalsh(matrix)
    if (np.abs(matrix - matrix.T) > 1e-9 * scale).any() or values[0] < _MIN_EIGENVALUE * scale:
        raise ValueError(f'{name}: smallest eigenvalue {values[0]:g}, expected a symmetric matrix '
                         'without negative eigenvalues')
