"""Data of one hall that replace the declared multipath: a measured covariance, or traced paths.

Let g be the Gaussian gains of the elements in all measurements of a band. Three `FIELDS`, which a
survey fits first, declare their covariance C_0. The survey, with the radiation matrix T, replaces
the covariance L_0 of its signals, T g + noise, by the measured one, L, and keeps the distribution
of g given the signals. If the noise is negligible, the result has the smallest Kullback-Leibler
divergence from C_0 among all covariances of g that give the signals the covariance L:

    C = C_0 + C_0 T^H M T C_0    with    M = L_0^-1 (L - L_0) L_0^-1.

C determines the covariance of signals that any other beams, or single elements, receive.

Paths come from a ray tracer, for example. A path is a spherical wave from a virtual source, such
as the mirror image of the user in a wall. The gain of the path is the line-of-sight gain from this
source, including gain patterns of elements and users, times a complex reflection coefficient: the
amplitude of the path at the centre of the surface, relative to free space over the same distance.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.model.arrays import check_arrays, numbers, position_problem, read_only
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.external import ArrayFile
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import Field
from rhs_isac_ros.support.files import (
    ArchiveError,
    read_archive,
    read_arrays,
    read_matlab,
    write_archive,
    write_arrays,
)

_FORMAT = 1
# Fields of the scenario that a measured covariance replaces.
FIELDS = ('multipath_to_los_db', 'delay_spread_s', 'angular_spread_deg')
# Fields on which a measured covariance depends; its file contains their values.
CONDITIONS = (
    'center_frequencies_hz', 'n_subbands', 'subband_width_hz', 'n_frames', 'elements_per_side',
    'element_interval_wavelengths', 'multipath_direction_deg', 'roi_center_m', 'roi_size_m',
    'subband_spacing_hz')
# Numbers in the record of a survey that estimators use.
_ABOUT = {'inflation': Field(float, low=0.0, is_open=True), 'level_std_db': Field(float, low=0.0)}
# Largest ratio between a centre frequency and the frequency of the paths, in either direction.
_MAX_FREQUENCY_RATIO = 1.5
# Largest amplitude relative to free space, and largest distance between a user and the source of
# the user's direct path.
_MAX_COEFFICIENT, _MAX_OFFSET_M = 2.0, 0.01
# Smallest distance of a moved source from the plane of the surface [m].
_NEAREST_M = 1e-3
# Largest number of reflections, as files store it in 8 bits.
_MAX_REFLECTIONS = 127
# Minimum share of the users in the region of interest.
_MIN_SHARE = 0.5
# Types of the arrays of paths in memory; in a file, some have less precision.
_TYPES = {'users': float, 'a': complex, 'src': float, 'n': int, 'f0': float, 'gains': complex}
_FILE_TYPES = {'a': np.complex64, 'gains': np.complex64, 'src': np.float32, 'n': np.int8}


# Diffuse reflections among the interactions of Sionna RT, and scattering among those of DeepMIMO.
_DIFFUSE, _SCATTERED = 2, '3'
_AT_ORIGIN = Pose()


def _unit_vectors(elevation: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Return directions [..., 3] from angles from the z axis and azimuths [rad]."""
    return np.stack([np.sin(elevation) * np.cos(azimuth), np.sin(elevation) * np.sin(azimuth),
                     np.cos(elevation)], axis=-1)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MultipathEstimate(ArrayFile):
    """A measured covariance of the multipath, as a value of the field `Scenario.multipath`.

    Raises ArchiveError if sizes disagree or a number is not finite.
    """

    # Fields that declare C_0, in place of those of the scenario.
    multipath_to_los_db: float
    delay_spread_s: float
    angular_spread_deg: float
    radiation: np.ndarray  #: T_i of the survey, complex128 [N_B, N_SB F, N_E].
    excess: np.ndarray  #: M_i, complex128 [N_B, N_SB F, N_SB F] [1/W].
    conditions: dict[str, Any]  #: Fields of the survey's scenario that the covariance depends on.
    #: Record of the survey: numbers of ``positions`` with a direct path, of their ``places`` and
    #: of ``blocked`` positions; ``prior_weight`` in places; ``inflation`` of the covariance;
    #: ``level_std_db``, the standard deviation of the power among users [dB]; ``coverage``, the
    #: expected share of users in the 95 % region, and its interval; ``warnings``; ``codebook`` id;
    #: ``version``.
    about: dict[str, Any] = dataclasses.field(default_factory=dict)
    origin: str = ''

    def __post_init__(self) -> None:
        """Check sizes and numbers, and make the arrays read-only."""
        n_bands, n_rows, n_elements = (*np.shape(self.radiation), 0, 0, 0)[:3]
        check_arrays(self, {
            **dict.fromkeys(FIELDS, ()), 'radiation': (n_bands or 1, n_rows, n_elements),
            'excess': (n_bands, n_rows, n_rows)}, ArchiveError)
        for name, declared in _ABOUT.items():
            if problem := name in self.about and declared.problem(self.about[name]):
                raise ArchiveError(f'{name}: {problem}')
        for array in self.content():
            read_only(array)

    @property
    def level_db(self) -> tuple[float, float]:
        """Median and standard deviation of the level of a user's multipath [dB].

        The level is relative to the covariance; if a survey inflated it, the median is negative.
        """
        return (-10 * math.log10(self.about.get('inflation', 1.0)),
                self.about.get('level_std_db', 0.0))

    def content(self) -> tuple[np.ndarray, ...]:
        """Return the arrays that the digest covers."""
        fields = np.array([getattr(self, name) for name in FIELDS])
        return fields, self.radiation, self.excess

    def misfit(self, scenario: Any) -> str:
        """Return the reason why the covariance does not fit a scenario, or '' if it fits."""
        fields = scenario.fields()
        for name in CONDITIONS:
            # Files of earlier versions do not have the spacing.
            own = self.conditions.get(name, 0.0 if name == CONDITIONS[-1] else None)
            if own != fields[name]:
                return f'a survey with {name} {own}, expected {fields[name]} as in the scenario'
        return ''

    def save(self, path: str | Path) -> None:
        """Write the estimate to a file of NumPy's format ``.npz``, without pickled objects.

        An existing file is replaced only when the new one is complete.
        """
        write_archive(path, {'radiation': self.radiation, 'excess': self.excess}, {
            'format': _FORMAT, 'about': self.about, 'conditions': self.conditions,
            **{name: getattr(self, name) for name in FIELDS}})

    @classmethod
    def load(cls, path: str | Path) -> 'MultipathEstimate':
        """Read an estimate from a file; raise ArchiveError if the file is invalid."""
        arrays, about = read_archive(path, 'multipath', _FORMAT, {'radiation', 'excess'})
        with translated((KeyError, TypeError, ValueError), ArchiveError, path):
            content: dict[str, Any] = {name: float(about[name]) for name in FIELDS}
            content |= {name: numbers(name, array, complex, finite=False)
                        for name, array in arrays.items()}
            content |= {name: dict(about[name]) for name in ('conditions', 'about')}
            return cls(**content, origin=str(path))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class PathChannel(ArrayFile):
    """Propagation paths between users and the surface, as a value of `Scenario.channel`.

    Users have at most P paths; the amplitude of missing ones is 0. `f0` may be an array of one
    number. Raises ArchiveError if sizes disagree, or a number is not finite or physically
    impossible.

    Examples
    --------
    >>> users = np.array([[8.0, 1.0, 0.2]])
    >>> gain = SPEED_OF_LIGHT_MPS / (4 * np.pi * 2.75e9 * np.linalg.norm(users))
    >>> PathChannel(users, [[gain]], users[:, None], [[0]], 2.75e9).nearest(users + 0.1)
    array([0])
    """

    users: np.ndarray  #: Positions, float64 [N, 3] [m], in the frame of the scenario.
    #: Amplitudes at the centre of the surface and at the frequency `f0`, complex128 [N, P]. They
    #: omit the phase of the distance d and the gain of antennas: c / (4 pi f0 d) in free space.
    a: np.ndarray
    src: np.ndarray  #: Virtual sources, float64 [N, P, 3] [m]; the user for the direct path.
    n: np.ndarray  #: Number of reflections, int [N, P]; 0: direct path, -1: missing path.
    f0: float  #: Frequency of the amplitudes [Hz], which are inversely proportional to it.
    #: Factors of the paths at each element, complex128 [N, P, N_E], for objects that are visible
    #: from only part of the surface; None if all factors are 1.
    gains: np.ndarray | None = None
    origin: str = ''

    def __post_init__(self) -> None:
        """Check sizes and numbers, and make the arrays read-only."""
        with translated(ValueError, ArchiveError):
            values = {name: numbers(name, getattr(self, name), kind, finite=False)
                      for name, kind in _TYPES.items() if getattr(self, name) is not None}
        # A single number has several dimensions in some files, such as those of MATLAB.
        values['f0'] = values['f0'].reshape(()) if values['f0'].size == 1 else values['f0']
        for name, value in values.items():
            object.__setattr__(self, name, value)
        shape = np.shape(self.a)
        if len(shape) != 2 or not np.size(self.a):
            raise ArchiveError(f'a: shape {shape}, expected [N, P] for N users with P paths')
        expected: dict[str, tuple[int, ...]] = {
            'a': shape, 'users': (shape[0], 3), 'src': (*shape, 3), 'n': shape, 'f0': ()}
        if self.gains is not None:
            expected['gains'] = (*shape, self.gains.shape[-1])
        check_arrays(self, expected, ArchiveError)
        for array in self.content():
            read_only(array)
        object.__setattr__(self, 'f0', float(self.f0))
        if self.n.min() < -1 or self.n.max() > _MAX_REFLECTIONS:
            raise ArchiveError(f'n: {self.n.min()} to {self.n.max()}, expected -1 to '
                               f'{_MAX_REFLECTIONS}')
        if self.f0 <= 0:
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
        if problem := position_problem(self.sources):
            raise ArchiveError(f'src: {problem}')

    @classmethod
    def from_sionna(cls, paths: Any, f0: float) -> 'PathChannel':
        """Convert paths of Sionna RT, as its `PathSolver` returns them.

        Users must be transmitters, and the only receiver must be at the surface's centre, with
        axes like the scenario's. Devices must have one isotropic antenna, and reflections must be
        specular. `f0` [Hz] is the scene's frequency. Paths from behind the surface are removed.
        Raises ArchiveError if there are several receivers or antennas, angles are not in radians,
        a path is diffuse, or the result is invalid.
        """
        a = np.array(paths.a[0]) + 1j * np.array(paths.a[1])
        if a.ndim != 5 or (*a.shape[:2], a.shape[3]) != (1, 1, 1):
            raise ArchiveError(f'a: shape {a.shape}, expected [1, 1, N, 1, P] of one receiver and '
                               'N transmitters with one antenna each')
        n_users, n_paths = a.shape[2], a.shape[4]
        centre = np.array(paths.targets, float).T
        users = np.array(paths.sources, float).T - centre
        # Without synthetic arrays, antennas have axes of their own.
        elevation, azimuth, delay, valid = (
            np.reshape(np.array(array), (n_users, n_paths)).astype(kind) for array, kind in (
                (paths.theta_r, float), (paths.phi_r, float), (paths.tau, float),
                (paths.valid, bool)))
        kinds = np.reshape(
            np.array(paths.interactions), (len(paths.interactions), n_users, n_paths))
        if (valid & (kinds == _DIFFUSE)).any():
            raise ArchiveError('interactions: diffuse paths, expected specular ones: Sionna RT '
                               'gives those of one bounce equal phases')
        for name, angles, low, high in (('theta_r', elevation, 0.0, np.pi),
                                        ('phi_r', azimuth, -2 * np.pi, 2 * np.pi)):
            # Angles of single precision may exceed the limits by rounding.
            outside = valid & ~((low - 1e-3 <= angles) & (angles <= high + 1e-3))
            if outside.any():
                raise ArchiveError(f'{name}: {angles[outside][0]:g}, expected angles of {low:.3g} '
                                   f'to {high:.3g} rad')
        n = np.where(valid, np.sum(kinds > 0, axis=0), -1)
        return cls._of_rays(
            users, a[0, 0, :, 0], delay, _unit_vectors(elevation, azimuth), n, f0)

    @classmethod
    def from_deepmimo(cls, dataset: Any, f0: float, pose: Pose = _AT_ORIGIN,
                      has_delay_phase: bool = True) -> 'PathChannel':
        """Convert the paths of a dataset of DeepMIMO 4: power, phase, delay, angles, interactions.

        The base station, with this pose in the frame of the dataset, is the surface, and receivers
        are users; antenna patterns and rotations of the dataset do not matter. Powers are for 1 W
        and isotropic antennas. `has_delay_phase` tells whether phases include that of the delay at
        `f0` [Hz]; those converted from Sionna RT do not. Users without a path and paths from
        behind the surface are removed. Raises ArchiveError if a path is scattered, or the result
        is invalid.
        """
        power, phase, delay, azimuth, elevation, kinds = (
            np.atleast_2d(np.array(getattr(dataset, name), float))
            for name in ('power', 'phase', 'delay', 'aod_az', 'aod_el', 'inter'))
        # Missing paths are NaN. Digits are interactions, and 0 is a direct path.
        digits = [str(int(kind)) if kind > 0 else '' for kind in kinds.flat]
        if any(_SCATTERED in kind for kind in digits):
            raise ArchiveError('inter: scattered paths, expected reflected ones')
        present = np.isfinite(power) & np.isfinite(delay) & (kinds >= 0)
        n = np.where(present, np.reshape([len(kind) for kind in digits], kinds.shape), -1)
        turn = np.deg2rad(phase) + has_delay_phase * 2 * np.pi * f0 * delay
        amplitude = np.where(present, 10 ** (power / 20) * np.exp(1j * turn), 0)
        # The elevation is the angle from the z axis.
        directions = pose.vectors_to_surface(
            _unit_vectors(np.deg2rad(elevation), np.deg2rad(azimuth)))
        users = pose.to_surface(np.array(dataset.rx_pos, float))
        served = (present & (directions[..., 0] > 0)).any(axis=1)
        return cls._of_rays(users[served], amplitude[served], delay[served], directions[served],
                            n[served], f0)

    @classmethod
    def _of_rays(cls, users: np.ndarray, a: np.ndarray, delay: np.ndarray,
                 directions: np.ndarray, n: np.ndarray, f0: float) -> 'PathChannel':
        """Create a channel from delays [N, P] [s] and directions [N, P, 3] at the surface.

        Paths are missing where `n` is -1 or they come from behind.
        """
        # A channel has at least one path, which may be missing.
        width = (0, 0), (0, not a.shape[1])
        a, delay, n = np.pad(a, width), np.pad(delay, width), np.pad(n, width, constant_values=-1)
        directions = np.pad(directions, (*width, (0, 0)))
        present = (n >= 0) & (directions[..., 0] > 0)
        sources = SPEED_OF_LIGHT_MPS * delay[..., None] * directions
        return cls(users, np.where(present, a, 0), np.where(present[..., None], sources, 0.0),
                   np.where(present, n, -1), f0)

    @classmethod
    def joined(cls, parts: Sequence['PathChannel']) -> 'PathChannel':
        """Join the users of channels; raise ArchiveError if `f0` differs or there are `gains`."""
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
        """Virtual sources, float64 [N, P, 3] [m]; the user for direct and missing paths."""
        missing, direct = (self.a == 0)[..., None], (self.n == 0)[..., None]
        return np.where(missing | direct, self.users[:, None], self.src)

    @functools.cached_property
    def coefficients(self) -> np.ndarray:
        """Amplitudes relative to free space over the same distance, complex128 [N, P]."""
        distance = np.linalg.norm(self.sources, axis=2)
        return self.a * 4 * np.pi * self.f0 * distance / SPEED_OF_LIGHT_MPS

    def nearest(self, positions: np.ndarray) -> np.ndarray:
        """Return the index of the user nearest to each position [M, 3] [m], int64 [M]."""
        squares = np.sum((positions[:, None] - self.users)**2, axis=2)
        return np.argmin(squares, axis=1)

    def moved(self, user: int, shift: np.ndarray) -> np.ndarray:
        """Return the sources of a user who has moved by [3] [m], float64 [P, 3] [m].

        Mirror images move as in the wall halfway between user and source. With more reflections
        than one, this is one of the movements that the positions allow. Amplitudes are those of
        the user's position.
        """
        ways = self.sources[user] - self.users[user]
        squares = np.maximum(np.sum(ways**2, axis=1), np.finfo(float).tiny)
        sources = self.sources[user] + shift - 2 * (ways @ shift / squares)[:, None] * ways
        # Sources are in front of the surface.
        sources[:, 0] = np.maximum(sources[:, 0], _NEAREST_M)
        return sources

    def content(self) -> tuple[np.ndarray, ...]:
        """Return the arrays that the digest covers."""
        gains = () if self.gains is None else (self.gains,)
        return self.users, self.a, self.src, self.n, np.array([self.f0]), *gains

    def misfit(self, scenario: Any) -> str:
        """Return the reason why the paths do not fit a scenario, or '' if they fit."""
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

        Amplitudes, virtual sources and `gains` are rounded to single precision.
        """
        arrays: dict[str, Any] = {
            name: np.asarray(array, _FILE_TYPES.get(name)) for name in _TYPES
            if (array := getattr(self, name)) is not None}
        write_arrays(path, arrays, np.savez_compressed)

    @classmethod
    def load(cls, path: str | Path) -> 'PathChannel':
        """Read paths from a file of NumPy or of MATLAB; arrays with other names are ignored.

        Files of MATLAB have the suffix ``.mat``. Raises ArchiveError if the file cannot be read or
        its content is invalid, and MissingLibraryError for MATLAB 7.3 without h5py.
        """
        arrays = (read_matlab(path, {*_TYPES}) if Path(path).suffix.lower() == '.mat'
                  else read_arrays(path))
        with translated((TypeError, ValueError), ArchiveError, path):
            for name in _TYPES:
                if name not in arrays and name != 'gains':
                    raise ArchiveError(f'{name}: missing, expected an array of this name')
            content: dict[str, Any] = {name: arrays[name] for name in _TYPES if name in arrays}
            return cls(**content, origin=str(path))
