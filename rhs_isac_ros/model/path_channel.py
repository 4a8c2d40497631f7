"""Channels as data: propagation paths of users at known positions, from a ray tracer for example.

A path is a spherical wave from a virtual source, such as the mirror image of the user in a wall.
It is a line of sight to that source, times a complex reflection coefficient: the amplitude of the
path at the surface's centre relative to free space over the same distance. Gain patterns of
elements and users apply to a path as they do to a line of sight to its source.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.support.files import ArchiveError, ArrayFile, read_arrays, write_whole

_SPEED_OF_LIGHT_MPS = 299_792_458.0
# Largest ratio of a centre frequency to the frequency of the paths, or the inverse.
_MAX_FREQUENCY_RATIO = 1.5
# Largest amplitude relative to free space, and distance of a direct path's source from its user.
_MAX_COEFFICIENT, _MAX_OFFSET_M = 2.0, 0.01
# Smallest share of the users that are in the region of interest.
_MIN_SHARE = 0.5


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class PathChannel(ArrayFile):
    """Propagation paths between users and the surface, as a value of `Scenario.channel`.

    Users have at most P paths; the amplitude of missing ones is 0.

    Attributes
    ----------
    users
        Positions, float64 [N, 3] [m], in the frame of the scenario.
    a
        Amplitudes at the surface's centre and the frequency `f0` for antennas without gain,
        without the phase of the distance, complex128 [N, P]; c / (4 pi f0 d) in free space.
    src
        Virtual sources, float64 [N, P, 3] [m]; the user itself for the direct path.
    n
        Number of reflections, int [N, P]; 0 for the direct path, and -1 for a missing path.
    f0
        Frequency of the amplitudes [Hz], which are inversely proportional to the frequency.
    gains
        Factors of the paths at each element, complex128 [N, P, N_E], for objects that only a part
        of the surface sees; None if all are 1.
    path
        File from which the paths were read.

    Raises
    ------
    ArchiveError
        If sizes disagree, or a number is not finite or not possible.
    """

    users: np.ndarray
    a: np.ndarray
    src: np.ndarray
    n: np.ndarray
    f0: float
    gains: np.ndarray | None = None
    path: str = ''

    def __post_init__(self) -> None:
        """Check sizes and numbers, and make the arrays read-only."""
        shape = np.shape(self.a) if np.ndim(self.a) == 2 else (0, 0)
        expected: dict[str, tuple[int, ...]] = {
            'a': shape, 'users': (shape[0], 3), 'src': (*shape, 3), 'n': shape}
        if self.gains is not None:
            expected['gains'] = (*shape, self.gains.shape[-1])
        for name, expected_shape in expected.items():
            array = getattr(self, name)
            if np.shape(array) != expected_shape or not np.size(array):
                raise ArchiveError(f'{name}: shape {np.shape(array)}, expected '
                                   f'{expected_shape} for N, P = {shape}')
            if not np.isfinite(array).all():
                raise ArchiveError(f'{name}: not finite, expected finite numbers')
            array.flags.writeable = False
        if not (np.isfinite(self.f0) and self.f0 > 0):
            raise ArchiveError(f'f0: {self.f0:g} Hz, expected a positive frequency')
        if (self.users[:, 0] <= 0).any():
            raise ArchiveError(f'users: x = {self.users[:, 0].min():g} m, expected users in front '
                               'of the surface, which lies in the plane x = 0')
        largest = float(np.abs(self.coefficients).max())
        if largest > _MAX_COEFFICIENT:
            raise ArchiveError(f'a: {largest:.3g} times that of free space, expected at most '
                               f'{_MAX_COEFFICIENT:g}')
        direct = (self.n == 0) & (self.a != 0)
        offset = np.linalg.norm(self.src - self.users[:, None], axis=2)[direct]
        if offset.size and offset.max() > _MAX_OFFSET_M:
            raise ArchiveError(f'src: {offset.max():.3g} m from the user for a direct path, '
                               f'expected at most {_MAX_OFFSET_M:g} m')

    @classmethod
    def from_sionna(cls, paths: Any, f0: float) -> 'PathChannel':
        """Convert paths of Sionna RT, as its `PathSolver` returns them.

        Users are the transmitters, and the only receiver is at the surface's centre, with axes
        like those of the scenario. Both have one isotropic antenna. Paths from behind the surface
        are removed.

        Parameters
        ----------
        paths
            Paths with specular reflections only.
        f0
            Frequency of the scene [Hz].

        Raises
        ------
        ArchiveError
            If there are several receivers or antennas, or the result is not possible.
        """
        a = np.array(paths.a[0]) + 1j * np.array(paths.a[1])
        if a.ndim != 5 or (*a.shape[:2], a.shape[3]) != (1, 1, 1):
            raise ArchiveError(f'a: shape {a.shape}, expected [1, 1, N, 1, P] of one receiver and '
                               'N transmitters with one antenna each')
        centre = np.array(paths.targets, float).T
        users = np.array(paths.sources, float).T - centre
        elevation, azimuth, delay = (
            np.array(angles, float)[0] for angles in (paths.theta_r, paths.phi_r, paths.tau))
        direction = np.stack([np.sin(elevation) * np.cos(azimuth),
                              np.sin(elevation) * np.sin(azimuth), np.cos(elevation)], axis=-1)
        sources = _SPEED_OF_LIGHT_MPS * delay[..., None] * direction
        present = np.array(paths.valid)[0] & (sources[..., 0] > 0)
        n = np.sum(np.array(paths.interactions)[:, 0] > 0, axis=0).astype(int)
        return cls(users, np.where(present, a[0, 0, :, 0], 0),
                   np.where(present[..., None], sources, 0.0), np.where(present, n, -1), f0)

    @classmethod
    def joined(cls, parts: Sequence['PathChannel']) -> 'PathChannel':
        """Join the users of several channels of one frequency and without factors `gains`."""
        n_paths = max(part.a.shape[1] for part in parts)

        def padded(name: str, value: float) -> np.ndarray:
            arrays = [getattr(part, name) for part in parts]
            return np.concatenate([np.pad(
                array, [(0, 0), (0, n_paths - array.shape[1]), *[(0, 0)] * (array.ndim - 2)],
                constant_values=value) for array in arrays])

        if len({part.f0 for part in parts}) > 1 or any(part.gains is not None for part in parts):
            raise ArchiveError('f0: channels of several frequencies or with gains, expected one '
                               'frequency and no gains')
        return cls(np.concatenate([part.users for part in parts]), padded('a', 0),
                   padded('src', 0), padded('n', -1), parts[0].f0)

    @functools.cached_property
    def sources(self) -> np.ndarray:
        """Sources in full precision, float64 [N, P, 3] [m]; that of a direct path is the user."""
        missing, direct = (self.a == 0)[..., None], (self.n == 0)[..., None]
        return np.where(missing | direct, self.users[:, None], self.src)

    @functools.cached_property
    def coefficients(self) -> np.ndarray:
        """Amplitudes relative to free space over the same distance, complex128 [N, P]."""
        distance = np.linalg.norm(self.sources, axis=2)
        return self.a * 4 * np.pi * self.f0 * distance / _SPEED_OF_LIGHT_MPS

    def nearest(self, positions: np.ndarray) -> np.ndarray:
        """Return the index of the user nearest to each position [N, 3] [m], int64 [N]."""
        squares = np.sum((positions[:, None] - self.users)**2, axis=2)
        return np.argmin(squares, axis=1)

    def content(self) -> tuple[np.ndarray, ...]:
        """Return the arrays that the digest covers."""
        gains = () if self.gains is None else (self.gains,)
        return self.users, self.a, self.src, self.n, np.array([self.f0]), *gains

    def misfit(self, scenario: Any) -> str:
        """Return why the paths do not fit a scenario; empty if they do."""
        for frequency in scenario.center_frequencies_hz:
            ratio = max(frequency, self.f0) / min(frequency, self.f0)
            if ratio > _MAX_FREQUENCY_RATIO:
                return (f'f0: {self.f0:g} Hz, expected at most {_MAX_FREQUENCY_RATIO:g} times '
                        f'more or less than the centre frequency {frequency:g} Hz')
        if self.gains is not None and self.gains.shape[-1] != scenario.n_elements:
            return f'gains: {self.gains.shape[-1]} elements, expected {scenario.n_elements}'
        low, high = scenario.roi_bounds_m
        share = float(np.mean(((low <= self.users) & (self.users <= high)).all(axis=1)))
        if share < _MIN_SHARE:
            return (f'users: {100 * share:.0f} % in the region of interest, expected at least '
                    f'{100 * _MIN_SHARE:.0f} %, in metres and in the frame of the surface')
        return ''

    def save(self, path: str | Path) -> None:
        """Write the paths to a compressed file of NumPy's format ``.npz``.

        Amplitudes and virtual sources are rounded to single precision.
        """
        arrays = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        del arrays['path']
        types = {'a': np.complex64, 'gains': np.complex64, 'src': np.float32, 'n': np.int8}
        present: dict[str, Any] = {name: np.asarray(array, types.get(name))
                   for name, array in arrays.items() if array is not None}
        write_whole(path, lambda stream: np.savez_compressed(stream, **present))

    @classmethod
    def load(cls, path: str | Path) -> 'PathChannel':
        """Read paths from a file; arrays with other names are ignored.

        Raises
        ------
        ArchiveError
            If the file cannot be read or its content is invalid; the message gives the array.
        """
        arrays = read_arrays(path)
        try:
            for name in ('users', 'a', 'src', 'n', 'f0'):
                if name not in arrays:
                    raise ArchiveError(f'{name}: missing, expected an array of this name')
            gains = arrays.get('gains')
            return cls(
                arrays['users'].astype(float), arrays['a'].astype(complex),
                arrays['src'].astype(float), arrays['n'].astype(int), float(arrays['f0']),
                None if gains is None else gains.astype(complex), str(path))
        except (TypeError, ValueError) as error:
            raise ArchiveError(f'{path}: {error}') from None
