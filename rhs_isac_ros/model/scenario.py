"""The scenario: all parameters of the model, with their ranges and units."""

import dataclasses
import functools
import hashlib
import itertools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.model.arrays import is_masked, read_only
from rhs_isac_ros.model.board import Board
from rhs_isac_ros.model.boards import board_of
from rhs_isac_ros.model.elementwise import Paper
from rhs_isac_ros.model.external import ArrayFile, External
from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.hall import MultipathEstimate, PathChannel
from rhs_isac_ros.model.numerology import nr_grid
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import UNKNOWN, Field, to_number, whole
from rhs_isac_ros.support.files import read_yaml, write_yaml
from rhs_isac_ros.support.plugins import PluginError

# Largest number of elements at given positions, whose covariances are computed one by one.
_MAX_ELEMENTS = 1024
# Relative tolerance for differences between frequencies.
_ROUNDING = 1e-9


class ScenarioError(ValueError):
    """A scenario file is invalid, or a field has a value that the model cannot use."""


def declare(
        default: Any, low: float, high: float, text: str, unit: str = '', source: str = '', *,
        label: str, has_unknown: bool = False) -> Any:
    """Declare a scenario field.

    `low` and `high` are inclusive. `source` cites the publication that defines this part of the
    model, unless it is the paper. `label` is the name on an axis, with the symbol as mathtext and
    without the unit.
    """
    kind = int if isinstance(default, int) else float
    return dataclasses.field(default=default, metadata={
        'declared': Field(kind, text, unit, low, high, has_unknown=has_unknown),
        'source': source, 'label': label})


@dataclasses.dataclass(frozen=True)
class Table1:
    """Geometry, bands and propagation as the paper defines them."""

    center_frequencies_hz: tuple[float, ...] = declare(
        (2.5e9, 3.0e9), 1e6, 1e13, 'Centre frequency f_c,i of each band.', 'Hz',
        label='centre frequencies $f_{c,i}$')
    n_subbands: int = declare(
        8, 1, 4096, 'Sub-bands N_SB of each band.', label=r'sub-bands $N_\mathrm{SB}$')
    subband_width_hz: float = declare(
        125e3, 1.0, 1e10, 'Width W of a sub-band.', 'Hz', label='sub-band width $W$')
    n_frames: int = declare(4, 1, 4096, 'Frames F of each band.', label='frames $F$')
    frame_duration_s: float = declare(
        4e-6, 1e-12, 1.0, 'Duration of a frame.', 's', label=r'frame duration $\Delta_t$')
    elements_per_side: int | tuple[int, int] = declare(
        10, 1, 128, 'Elements along a side of the square surface, or two numbers for a rectangle: '
        'elements along y and along z.',
        label=r'elements along a side $\sqrt{N_\mathrm{E}}$')
    element_interval_wavelengths: float | tuple[float, float] = declare(
        0.3, 1e-3, 10.0, 'Spacing of the elements, in mean wavelengths, or two numbers: along y '
        'and along z.',
        label=r'element spacing in $\lambda_\mathrm{avr}$')
    n_feeds: int = declare(3, 1, 256, 'Feeds K of the surface.', label='feeds $K$')
    feed_positions_m: tuple[tuple[float, float, float], ...] | None = declare(
        None, -1e3, 1e3,
        'Positions of the feeds; if null, they are evenly spaced on the centre line.', 'm',
        label='feed positions')
    refractive_index: float = declare(
        2.1, 1.0, 100.0, 'Refractive index n_r of the board.', label='refractive index $n_r$')
    element_gain: float | GainPattern = declare(
        1.0, 1e-6, 1e6, 'Amplitude gain g^E of an element.', label=r'element gain $g^\mathrm{E}$')
    user_gain: float | GainPattern = declare(
        1.0, 1e-6, 1e6, "Amplitude gain g^U of the user's antenna.",
        label=r'user gain $g^\mathrm{U}$')
    delay_spread_s: float = declare(
        0.5e-6, 0.0, 1.0, 'RMS delay spread of the multipath.', 's',
        label=r'delay spread $\sigma_\mathrm{rms}$')
    max_user_speed_mps: float = declare(
        20 / 3.6, 0.0, 1e4, 'Highest speed of a user.', 'm/s',
        label=r'user speed $v_\mathrm{max}$')
    angular_spread_deg: float = declare(
        10.0, 1e-2, 1e3, 'Angular spread of the multipath, in azimuth and elevation.', 'deg',
        label='angular spread')
    noise_psd_dbm_hz: float = declare(
        -174.0, -400.0, 100.0, 'Power spectral density P_N of the noise.', 'dBm/Hz',
        label='noise density $P_N$')
    max_power_w: float = declare(
        1e-3, 1e-15, 1e6, 'Power P_max of the combining vectors.', 'W',
        label=r'power $P_\mathrm{max}$')
    roi_center_m: tuple[float, float, float] = declare(
        (10.0, 0.0, 0.0), -1e6, 1e6, 'Centre of the region of interest.', 'm',
        label='centre of the region')
    roi_size_m: tuple[float, float, float] = declare(
        (10.0, 10.0, 2.0), 0.0, 1e6,
        'Side lengths of the region of interest; 0 for no extent along an axis.', 'm',
        label='size of the region')


_WRAPPED = 'wrapped normal distribution, Mardia and Jupp, Directional Statistics, 2000, sec. 3.5'


@dataclasses.dataclass(frozen=True)
class Extensions:
    """Effects beyond the paper's model; with the defaults, none of them changes it.

    Standard deviations describe Gaussians with zero mean. Phases are wrapped to the circle: with a
    standard deviation of 2 pi or more, a phase is practically uniform, because its mean resultant
    length, exp(-std^2 / 2), is below 3e-9. A gain, phase or offset may also be ``unknown``, or
    infinity, and then has no prior: an unknown phase or offset is uniform, and an unknown gain has
    no distribution.

    Gain, carrier offset and blockage of a user are drawn once per user, phases and the timing
    offset once per cycle, and element errors and failures once per surface.
    """

    subband_spacing_hz: float = declare(
        0.0, 0.0, 1e10,
        'Distance between the centres of neighbouring sub-bands, at least their width, which is '
        'that of the noise; 0 for this width. Pilots on a comb have a larger one.', 'Hz',
        'comb of PRS and SRS, 3GPP TS 38.211, sections 7.4.1.7 and 6.4.1.4',
        label='spacing of the sub-bands')
    multipath_to_los_db: float = declare(
        0.0, -200.0, 100.0,
        'Power of the multipath at an element, relative to the mean power of the direct path in '
        'the region. The paper does not normalise the profile of Eq. (2); 0 dB is the reading '
        'of this package.', 'dB',
        'inverse Rice factor, 3GPP TR 38.901, section 7.5', label='multipath / direct path')
    multipath_direction_deg: tuple[float, float] = declare(
        (0.0, 0.0), -90.0, 90.0,
        'Mean direction of the multipath in azimuth and elevation. The paper assumes the '
        'boresight.', 'deg', label='mean direction of the multipath')
    user_gain_std_db: float = declare(
        0.0, 0.0, 60.0,
        "Standard deviation of the gain of a user, log-normal, in addition to user_gain: "
        'transmit power, antenna and shadowing. It acts on the direct path and on the multipath.',
        'dB', 'log-normal shadow fading, 3GPP TR 38.901, section 7.4',
        label='user gain, standard deviation', has_unknown=True)
    phase_std_rad: float = declare(
        0.0, 0.0, 1e3,
        'Standard deviation of a phase that all bands of a cycle share; 6.2832 for a uniform '
        'phase.', 'rad',
        _WRAPPED, label='common phase, standard deviation', has_unknown=True)
    band_phase_std_rad: float = declare(
        0.0, 0.0, 1e3,
        'Standard deviation of a phase that each band of a cycle draws independently, as after '
        'retuning an oscillator; 6.2832 for a uniform phase.', 'rad',
        _WRAPPED, label='phase of a band, standard deviation', has_unknown=True)
    timing_std_s: float = declare(
        0.0, 0.0, 1.0,
        'Standard deviation of the sampling-time offset of a cycle, which adds a phase that is '
        'linear over the sub-bands.', 's',
        'Speth, Fechtel, Fock and Meyr, Optimum receiver design for wireless broad-band systems '
        'using OFDM, part I, IEEE Trans. Commun. 47 (11), 1999',
        label='timing offset, standard deviation', has_unknown=True)
    carrier_offset_std_hz: float = declare(
        0.0, 0.0, 1e9,
        "Standard deviation of the carrier frequency offset of a user's oscillator. The offset is "
        'the same in all bands and adds a phase that is linear over the frames of a band.', 'Hz',
        'Moose, A technique for orthogonal frequency division multiplexing frequency offset '
        'correction, IEEE Trans. Commun. 42 (10), 1994',
        label='carrier offset, standard deviation', has_unknown=True)
    retune_s: float = declare(
        0.0, 0.0, 1e3, 'Time between the last frame of a band and the first one of the next.', 's',
        label='time to retune')
    user_speed_std_mps: float = declare(
        0.0, 0.0, 1e4, 'Standard deviation of each component of the velocity of a user, along the '
        'axes with an extent of the region; 0 for users who stand still in a cycle.', 'm/s',
        label='user velocity, standard deviation')
    element_error_rms: float = declare(
        0.0, 0.0, 1.0,
        'RMS of the complex error of an element coefficient relative to its value; the error is '
        'the same in all bands and frames.', '',
        'Van Trees, Optimum Array Processing, 2002, section 2.6.3',
        label='relative error of an element, RMS')
    failed_element_share: float = declare(
        0.0, 0.0, 1.0,
        'Probability that an element has failed. A failed element is stuck at an amplitude that '
        'is uniform in [0, 1] and the same in all bands and frames.', '',
        'stuck-at faults, Taghvaee, Cabellos-Aparicio, Georgiou and Abadal, Error analysis of '
        'programmable metasurfaces for beam steering, IEEE J. Emerg. Sel. Top. Circuits Syst. '
        '10 (1), 2020', label='share of failed elements')
    amplitude_levels: int = declare(
        0, 0, 65536,
        'Number L of amplitudes k / (L - 1) that an element can take: 2 for one bit; 0 if '
        'amplitudes are continuous.', '',
        'Smith, Yurduseven, Mancera, Bowen and Kundtz, Analysis of a waveguide-fed metasurface '
        'antenna, Phys. Rev. Applied 8, 2017', label='amplitude levels $L$')
    element_positions_m: tuple[tuple[float, float, float], ...] | None = declare(
        None, -1e3, 1e3,
        'Positions of the elements, such as those of a disc or of a curved panel; if null, they '
        'form the grid of elements_per_side.', 'm', label='element positions')
    element_normals: tuple[tuple[float, float, float], ...] | None = declare(
        None, -1e3, 1e3,
        'Directions in which the elements of element_positions_m face, vectors of any length but '
        '0; if null, all face along x. They are the boresights of element_gain.', '',
        label='element normals')
    board: Board = declare(
        Paper(), 0.0, 0.0,
        'How tunings of the elements determine the transfer from elements to feeds: the name of a '
        'board, or a mapping of kind and its fields (see `model.board`).', '', label='board')
    impairments: tuple[tuple[str, float], ...] = declare(
        (), 0.0, 1e300,
        'Impairments of installed plug-ins: a mapping of names to strengths, each in the unit '
        'that the plug-in documents.', '', label='impairments')
    blocked_probability: float = declare(
        0.0, 0.0, 1.0,
        'Probability that a user has no direct path; drawn once per user. The signals then '
        'consist of multipath only, and estimators assume that its level is known within 10 dB. '
        'Bounds apply to users with a direct path.', '',
        'probability of the line of sight, 3GPP TR 38.901, section 7.4.2',
        label='share of blocked users')
    outside_probability: float = declare(
        0.5, 0.0, 1.0,
        'Prior probability that a user is outside of the region of interest, for estimators that '
        'reject such users. Bounds and simulated users are inside.', '',
        label='share of users outside')
    multipath: MultipathEstimate | None = declare(
        None, 0.0, 0.0,
        'File of a measured covariance of the multipath, as a survey estimates it; it replaces '
        'multipath_to_los_db, delay_spread_s and angular_spread_deg, which then have no effect.',
        '', label='multipath')
    channel: PathChannel | None = declare(
        None, 0.0, 0.0,
        'File of propagation paths of users at known positions. Simulated signals then follow '
        'these paths instead of a direct path and random multipath. Estimators and bounds '
        'ignore the file.', '', label='channel')
    pose: Pose = declare(
        Pose(), -1e6, 1e6,
        'Pose of the surface in the frame of the site: a mapping of position_m, quaternion '
        '(x, y, z, w) and uncertainty, as in `Pose`. Messages are in the frame of the site; the '
        'other fields and the model are in the frame of the surface.', 'm',
        label='pose of the surface')


# Fields with a number for both axes of the surface, or one each for y and z.
_OF_AXES = ('elements_per_side', 'element_interval_wavelengths')
# Fields whose values can come from plug-ins or files, and those of them that are files.
_EXTERNAL: dict[str, type[External]] = {
    'element_gain': GainPattern, 'user_gain': GainPattern, 'multipath': MultipathEstimate,
    'channel': PathChannel}
_FILES = [name for name, kind in _EXTERNAL.items() if issubclass(kind, ArrayFile)]
# Identifiers in existing files stay valid: of `Extensions`, these alone count with defaults, too.
_OF_EVERY_ID = {
    'amplitude_levels', 'multipath_to_los_db', 'user_gain_std_db', 'phase_std_rad', 'timing_std_s',
    'band_phase_std_rad', 'carrier_offset_std_hz', 'element_error_rms', 'failed_element_share'}
_OPTIONAL = {field.name for field in dataclasses.fields(Extensions)} - _OF_EVERY_ID


@dataclasses.dataclass(frozen=True)
class Scenario(Extensions, Table1):
    """Geometry, bands and propagation of one system; the defaults are the paper's Table I.

    A scenario has the fields of `Table1` and those of `Extensions`.

    Lengths are in metres in the frame of the surface, which lies in the plane x = 0, centred on
    the origin, with x pointing outward and z up. Only `pose` is in the frame of the site.

    A gain is a number, a `GainPattern`, a function of the angle from boresight, or the name of an
    installed plug-in; in a file, it is a number or a name. `multipath` and `channel` are objects
    or paths of files. Raises ScenarioError if a value has the wrong type, is out of range, or
    contradicts another one.

    Examples
    --------
    >>> scenario = Scenario(n_frames=2, roi_size_m=(4.0, 4.0, 1.0))
    >>> scenario.changes()
    {'n_frames': 2, 'roi_size_m': [4.0, 4.0, 1.0]}
    """

    def __post_init__(self) -> None:
        """Convert every field to its declared type and check it."""
        for field in dataclasses.fields(self):
            # Defaults are valid; most fields have them.
            if (value := getattr(self, field.name)) is not field.default:
                object.__setattr__(self, field.name, checked(field, value))
        if self.feed_positions_m is not None and len(self.feed_positions_m) != self.n_feeds:
            raise ScenarioError(f'feed_positions_m: {len(self.feed_positions_m)} positions, '
                                f'expected n_feeds = {self.n_feeds}')
        if self.roi_center_m[0] - self.roi_size_m[0] / 2 <= 0:
            raise ScenarioError(
                f'roi_center_m: {self.roi_center_m} with roi_size_m {self.roi_size_m} reaches '
                'behind the surface, expected x > 0 in the whole region')
        if not any(self.roi_size_m):
            raise ScenarioError(
                f'roi_size_m: {self.roi_size_m}, expected at least one length above 0')
        if self.spacing_hz < self.subband_width_hz:
            raise ScenarioError(
                f'subband_spacing_hz: {self.subband_spacing_hz:g} Hz, expected 0 or at least '
                f'subband_width_hz = {self.subband_width_hz:g} Hz')
        span_hz = self.bandwidth_hz
        frequencies_hz = sorted(self.center_frequencies_hz)
        if span_hz >= 2 * frequencies_hz[0]:
            raise ScenarioError(
                f'{"subband_spacing_hz" if self.subband_spacing_hz else "subband_width_hz"}: '
                f'{self.n_subbands} sub-bands span {span_hz:g} Hz, expected '
                'less than twice the lowest centre frequency')
        for low, high in itertools.pairwise(frequencies_hz):
            if high - low < span_hz * (1 - _ROUNDING):
                raise ScenarioError(
                    f'center_frequencies_hz: {low:g} and {high:g} Hz, expected at least '
                    f'{span_hz:g} Hz apart, the width of a band of {self.n_subbands} sub-bands')
        self._check_elements()
        if self.amplitude_levels == 1:
            raise ScenarioError(
                'amplitude_levels: 1, expected 0 for continuous amplitudes, or at least 2')
        for name in ('board', *_FILES):
            if (part := getattr(self, name)) is not None and (misfit := part.misfit(self)):
                raise ScenarioError(f'{name}: {misfit}')

    def _check_elements(self) -> None:
        """Raise ScenarioError if positions of the elements contradict other fields."""
        positions, normals = self.element_positions_m or (), self.element_normals or ()
        if normals and len(normals) != len(positions):
            raise ScenarioError(f'element_normals: {len(normals)} vectors, expected one for each '
                                f'of the {len(positions)} element_positions_m')
        if not all(map(any, normals)):
            raise ScenarioError('element_normals: [0, 0, 0], expected a length other than 0')
        if len(positions) > _MAX_ELEMENTS:
            raise ScenarioError(f'element_positions_m: {len(positions)} positions, expected at '
                                f'most {_MAX_ELEMENTS}; more only in a grid')
        foremost = max((x for x, _, _ in positions), default=-np.inf)
        if self.roi_center_m[0] - self.roi_size_m[0] / 2 <= foremost:
            raise ScenarioError(f'element_positions_m: x up to {foremost:g} m, expected all '
                                'elements in front of the region of interest')
        if positions and self.multipath is not None:
            raise ScenarioError('element_positions_m: with a file multipath, expected a grid')

    @classmethod
    def from_yaml(cls, path: str | Path) -> 'Scenario':
        """Read a scenario from a YAML file that maps field names to values.

        ``grid`` may map the parameters of `nr_grid` to values, in place of the fields that this
        function returns. Fields that the file omits keep their defaults. Paths in the file are
        relative to its folder. Raises ScenarioError if the file is unreadable or invalid.
        """
        with translated(ValueError, ScenarioError):
            content = read_yaml(path)
        content = {} if content is None else content
        if not isinstance(content, dict):
            raise ScenarioError(f'{path}: expected a mapping of field names to values')
        if 'grid' in content:
            with translated((TypeError, ValueError), ScenarioError, f'{path}: grid'):
                content = nr_grid(**content.pop('grid')) | content
        known = [field.name for field in dataclasses.fields(cls)]
        if unknown := [key for key in content if key not in known]:
            raise ScenarioError(f'{path}: {unknown[0]}: unknown field, expected one of {known}')
        content = _with_paths(content, lambda file: str(Path(path).parent / file))
        with translated(ScenarioError, ScenarioError, path):
            return cls(**content)

    def changes(self, folder: str | Path | None = None) -> dict[str, Any]:
        """Return the fields that differ from their defaults, as values that `from_yaml` can read.

        Gain patterns are written as name and digest, and files as path and digest. Given the
        `folder` of a scenario file, paths are relative to it. A pattern that is not a plug-in
        can be read back only in this process and its jobs, as can arrays that are not in a file.
        """
        changes = {field.name: as_plain(value) for field in dataclasses.fields(self)
                   if (value := getattr(self, field.name)) != field.default}
        if folder is not None:
            changes = _with_paths(changes, lambda file: os.path.relpath(
                os.path.realpath(file), os.path.realpath(folder)))
        return changes

    def to_yaml(self, path: str | Path, about: str = '') -> None:
        """Write the `changes` to a file for `from_yaml`, with a comment; OSError if this fails."""
        write_yaml(path, self.changes(Path(path).parent), about)

    def fields(self) -> dict[str, Any]:
        """Return all fields by name, as plain values; see `changes`."""
        return {field.name: as_plain(getattr(self, field.name))
                for field in dataclasses.fields(self)}

    def __hash__(self) -> int:
        """Return the hash of `id`; that of all fields would take part of every estimate."""
        return hash(self.id)

    @functools.cached_property
    def id(self) -> str:
        """Hash of the fields: ``sc`` and 16 hex digits, which YAML never parses as a number."""
        fields: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            if name in _OPTIONAL and value == field.default:
                continue
            plain = value.id if name == 'board' else as_plain(value)
            # The same file has the same identifier on every host.
            fields[name] = plain.rpartition('@')[2] if name in _FILES else plain
        return f'sc{hashlib.sha256(json.dumps(fields).encode()).hexdigest()[:16]}'

    @property
    def unplaced(self) -> 'Scenario':
        """The scenario with the default pose: all that the model and its files depend on."""
        return dataclasses.replace(self, pose=Pose())

    @property
    def n_bands(self) -> int:
        """Number of bands N_B."""
        return len(self.center_frequencies_hz)

    @property
    def n_columns(self) -> int:
        """Number of elements along y; all of them if they do not form a grid."""
        sides = self.elements_per_side
        return len(self.element_positions_m or ()) or (
            sides if isinstance(sides, int) else sides[0])

    @property
    def n_rows(self) -> int:
        """Number of elements along z; 1 if they do not form a grid."""
        sides = 1 if self.element_positions_m else self.elements_per_side
        return sides if isinstance(sides, int) else sides[1]

    @property
    def multipath_level_db(self) -> tuple[float, float]:
        """Median and standard deviation of a user's multipath level [dB]; 0 without a survey."""
        return self.multipath.level_db if self.multipath else (0.0, 0.0)

    @property
    def n_elements(self) -> int:
        """Number of elements N_E."""
        return self.n_columns * self.n_rows

    @property
    def spacing_hz(self) -> float:
        """Distance between the centres of neighbouring sub-bands [Hz]."""
        return self.subband_spacing_hz or self.subband_width_hz

    @property
    def bandwidth_hz(self) -> float:
        """Bandwidth of a band, of which each sub-band occupies one spacing [Hz]."""
        return self.n_subbands * self.spacing_hz

    @property
    def noise_power_w(self) -> float:
        """Noise power sigma_n^2 = P_N W of one sub-band [W]."""
        return 10 ** (self.noise_psd_dbm_hz / 10) * 1e-3 * self.subband_width_hz

    @functools.cached_property
    def sizes(self) -> dict[str, int]:
        """Array dimensions by their symbols in the paper."""
        return {'N_B': self.n_bands, 'N_SB': self.n_subbands, 'F': self.n_frames,
                'N_E': self.n_elements, 'K': self.n_feeds}

    @functools.cached_property
    def roi_bounds_m(self) -> np.ndarray:
        """Lower and upper corners of the region of interest, float64 [2, 3] [m], read-only."""
        center, size = np.array(self.roi_center_m), np.array(self.roi_size_m)
        return read_only(np.stack([center - size / 2, center + size / 2]))

    def sample_positions(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw positions, float64 [n, 3] [m], in the region or of the users of a channel file."""
        if self.channel:
            return self.channel.users[rng.integers(len(self.channel.users), size=whole('n', n))]
        low, high = self.roi_bounds_m
        return rng.uniform(low, high, size=(whole('n', n), 3))


def _with_paths(values: dict[str, Any], convert: Callable[[str], str]) -> dict[str, Any]:
    """Return values of fields with converted paths of files, also of the file of a board."""
    found: dict[str, Any] = {
        name: convert(values[name]) for name in _FILES if isinstance(values.get(name), str)}
    board = values.get('board')
    if isinstance(board, dict) and isinstance(board.get('file'), str):
        found['board'] = board | {'file': convert(board['file'])}
    return values | found


def check_shape(name: str, array: np.ndarray, symbols: str, scenario: Scenario) -> None:
    """Raise ValueError unless the shape of `array` is `symbols`, keys of `Scenario.sizes`."""
    expected = tuple(scenario.sizes[symbol] for symbol in symbols.split())
    if np.shape(array) != expected:
        listed = ', '.join(symbols.split())
        raise ValueError(f'{name}: shape {np.shape(array)}, expected [{listed}] = {expected}')


def as_plain(value: Any) -> Any:
    """Return the value of a field as in a scenario file."""
    if isinstance(value, External | str):
        return str(value)
    if isinstance(value, Board):
        return value.plain
    if isinstance(value, float) and value == np.inf:
        return UNKNOWN
    if isinstance(value, Pose):
        return {field.name: as_plain(getattr(value, field.name))
                for field in dataclasses.fields(value)}
    return [as_plain(entry) for entry in value] if isinstance(value, tuple) else value


def checked(field: dataclasses.Field[Any], value: Any) -> Any:
    """Convert a field's value to its declared type; raise ScenarioError if it is invalid."""
    name = field.name
    if name in ('feed_positions_m', 'element_positions_m', 'element_normals'):
        return None if value is None else tuple(
            _numbers(field, row, 3) for row in _entries(field, value, '[x, y, z]'))
    if name == 'impairments':
        return _strengths(field, value)
    if name == 'pose':
        return _pose(field, value)
    if name == 'board':
        with translated(ValueError, ScenarioError, name):
            return board_of(value)
    if name in _FILES or name in _EXTERNAL and not isinstance(to_number(value, float), float):
        return _external(field, value, _EXTERNAL[name])
    if name in _OF_AXES and isinstance(value, list | tuple | np.ndarray):
        return _of_axes(field, value)
    if isinstance(field.default, tuple):
        length = None if name == 'center_frequencies_hz' else len(field.default)
        return _numbers(field, value, length)
    return _number(field, value)


def _of_axes(field: dataclasses.Field[Any], value: Any) -> Any:
    """Convert numbers along y and z; equal ones are the same scenario as a single number."""
    kind = field.metadata['declared'].kind
    one, many = ('an integer', 'integers') if kind is int else ('a number', 'numbers')
    # MATLAB has no other scalars than arrays of one number.
    if isinstance(number := to_number(value, kind), kind):
        return _number(field, number)
    if len(_entries(field, value, many)) != 2:
        raise ScenarioError(f'{field.name}: {value!r}, expected {one} or two')
    along_y, along_z = (_number(field, entry) for entry in value)
    return along_y if along_y == along_z else (along_y, along_z)


def _number(field: dataclasses.Field[Any], value: Any) -> Any:
    with translated(ValueError, ScenarioError):
        return field.metadata['declared'].checked(field.name, value)


def _external(field: dataclasses.Field[Any], value: Any, kind: type[External]) -> Any:
    if isinstance(value, kind) or value is None and field.default is None:
        return value and value.held()
    with translated(ValueError, ScenarioError, field.name):
        if isinstance(value, str | Path):
            return kind.named(str(value))
        if kind is GainPattern and callable(value):
            return GainPattern(value).held()
    raise ScenarioError(f'{field.name}: {value!r}, expected {kind.WORDS[1]}')


def _pose(field: dataclasses.Field[Any], value: Any) -> Any:
    if not isinstance(value, Pose):
        names = [part.name for part in dataclasses.fields(Pose)]
        if not isinstance(value, dict) or not value.keys() <= set(names):
            raise ScenarioError(f'{field.name}: {value!r}, expected a mapping of {names}')
        with translated(ValueError, ScenarioError, field.name):
            value = Pose(**value)
    for coordinate in value.position_m:
        _number(field, coordinate)
    return value


def _strengths(field: dataclasses.Field[Any], value: Any) -> tuple[tuple[str, float], ...]:
    # The module imports this one.
    from rhs_isac_ros.model.impairments import Impairment

    try:
        pairs = sorted((plugins.name_of(name), strength) for name, strength in dict(value).items())
    except (TypeError, ValueError):
        raise ScenarioError(
            f'{field.name}: {value!r}, expected a mapping of names to strengths') from None
    for name, _ in pairs:
        with translated(PluginError, ScenarioError, field.name):
            plugins.load(plugins.IMPAIRMENTS, name, Impairment)
    # An impairment of strength 0 is the same as none.
    checked_pairs = ((name, _number(field, strength)) for name, strength in pairs)
    return tuple(pair for pair in checked_pairs if pair[1])


def _entries(field: dataclasses.Field[Any], value: Any, expected: str) -> Any:
    """Return the value if it is a list with at least one entry, or raise ScenarioError."""
    if is_masked(value):
        raise ScenarioError(f'{field.name}: a masked array, expected a list of {expected}')
    if (not isinstance(value, list | tuple | np.ndarray) or getattr(value, 'shape', None) == ()
            or len(value) == 0):
        raise ScenarioError(f'{field.name}: {value!r}, expected a list of {expected}')
    return value


def _numbers(field: dataclasses.Field[Any], value: Any, length: int | None) -> tuple[float, ...]:
    expected = 'numbers' if length is None else f'{length} numbers'
    if len(_entries(field, value, expected)) != (length or len(value)):
        raise ScenarioError(f'{field.name}: {len(value)} values, expected a list of {expected}')
    return tuple(_number(field, entry) for entry in value)
