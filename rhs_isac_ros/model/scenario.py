"""The scenario: all parameters of the model, with their ranges and units."""

import dataclasses
import functools
import hashlib
import json
import math
import numbers
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rhs_isac_ros.model.gain_pattern import GainPattern, PatternError
from rhs_isac_ros.model.plugins import PluginError

SPEED_OF_LIGHT_MPS = 299_792_458.0


class ScenarioError(ValueError):
    """A scenario field has a value that the model cannot use."""


def _field(default: Any, low: float, high: float, text: str, unit: str = '') -> Any:
    """Declare a scenario field with its range (inclusive), description and unit."""
    meta = {'low': low, 'high': high, 'text': text, 'unit': unit}
    return dataclasses.field(default=default, metadata=meta)


@dataclasses.dataclass(frozen=True)
class Scenario:
    """Geometry, bands and propagation of one system; the defaults are the paper's Table I.

    Lengths are in metres in the frame ``map``: the surface lies in the plane x = 0, centred on
    the origin, with x pointing outward and z up.

    A gain is a number, a `GainPattern`, a function of the angle from the boresight, or the name
    of an installed plug-in. Files can hold numbers and names only.

    Raises
    ------
    ScenarioError
        If a value has the wrong type, is out of range, or contradicts another one.
    """

    center_frequencies_hz: tuple[float, ...] = _field(
        (2.5e9, 3.0e9), 1e6, 1e13, 'Centre frequency f_c,i of each band.', 'Hz')
    n_subbands: int = _field(8, 1, 4096, 'Sub-bands N_SB of each band.')
    subband_width_hz: float = _field(125e3, 1.0, 1e10, 'Width W of a sub-band.', 'Hz')
    n_frames: int = _field(4, 1, 4096, 'Frames F of each band.')
    frame_duration_s: float = _field(4e-6, 1e-12, 1.0, 'Duration of a frame.', 's')
    elements_per_side: int = _field(10, 1, 128, 'Elements along one side of the square surface.')
    element_interval_wavelengths: float = _field(
        0.3, 1e-3, 10.0, 'Spacing of the elements, in mean wavelengths.')
    n_feeds: int = _field(3, 1, 256, 'Feeds K of the surface.')
    feed_positions_m: tuple[tuple[float, float, float], ...] | None = _field(
        None, -1e3, 1e3,
        'Positions of the feeds; if null, they are evenly spaced on the centre line.', 'm')
    refractive_index: float = _field(2.1, 1.0, 100.0, 'Refractive index n_r of the board.')
    element_gain: float | GainPattern = _field(
        1.0, 1e-6, 1e6, 'Amplitude gain g^E of an element.')
    user_gain: float | GainPattern = _field(
        1.0, 1e-6, 1e6, "Amplitude gain g^U of the user's antenna.")
    delay_spread_s: float = _field(0.5e-6, 0.0, 1.0, 'RMS delay spread of the multipath.', 's')
    max_user_speed_mps: float = _field(20 / 3.6, 0.0, 1e4, 'Highest speed of a user.', 'm/s')
    angular_spread_deg: float = _field(
        10.0, 1e-2, 1e3, 'Angular spread of the multipath, in azimuth and elevation.', 'deg')
    noise_psd_dbm_hz: float = _field(
        -174.0, -400.0, 100.0, 'Power spectral density P_N of the noise.', 'dBm/Hz')
    max_power_w: float = _field(1e-3, 1e-15, 1e6, 'Power P_max of the combining vectors.', 'W')
    roi_center_m: tuple[float, float, float] = _field(
        (10.0, 0.0, 0.0), -1e6, 1e6, 'Centre of the region of interest.', 'm')
    roi_size_m: tuple[float, float, float] = _field(
        (10.0, 10.0, 2.0), 1e-6, 1e6, 'Side lengths of the region of interest.', 'm')

    def __post_init__(self) -> None:
        """Convert every field to its declared type and check it."""
        for field in dataclasses.fields(self):
            value = _checked(field, getattr(self, field.name))
            object.__setattr__(self, field.name, value)
        if self.feed_positions_m is not None and len(self.feed_positions_m) != self.n_feeds:
            raise ScenarioError(
                f'feed_positions_m: {len(self.feed_positions_m)} positions, expected n_feeds = '
                f'{self.n_feeds}')
        if self.roi_center_m[0] - self.roi_size_m[0] / 2 <= 0:
            raise ScenarioError(
                f'roi_center_m: {self.roi_center_m} with roi_size_m {self.roi_size_m} reaches '
                'behind the surface, expected x > 0 in the whole region')
        span_hz = self.n_subbands * self.subband_width_hz
        if span_hz >= 2 * min(self.center_frequencies_hz):
            raise ScenarioError(
                f'subband_width_hz: {self.n_subbands} sub-bands span {span_hz:g} Hz, expected '
                'less than twice the lowest centre frequency')

    @classmethod
    def from_yaml(cls, path: str | Path) -> 'Scenario':
        """Read a scenario from a YAML file that maps field names to values.

        Fields that are not in the file have their defaults.

        Raises
        ------
        ScenarioError
            If the file cannot be read, is not a mapping, or has an unknown field or invalid value.
        """
        try:
            content = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
        # PyYAML also raises ValueError, for invalid bytes and dates.
        except (OSError, ValueError, yaml.YAMLError) as error:
            reason = ' '.join(str(error).split())
            raise ScenarioError(f'{path}: cannot be read: {reason}') from error
        content = {} if content is None else content
        if not isinstance(content, dict):
            raise ScenarioError(f'{path}: expected a mapping of field names to values')
        known = [field.name for field in dataclasses.fields(cls)]
        for key in content:
            if key not in known:
                raise ScenarioError(f'{path}: {key}: unknown field, expected one of {known}')
        try:
            return cls(**content)
        except ScenarioError as error:
            raise ScenarioError(f'{path}: {error}') from None

    def changes(self) -> dict[str, Any]:
        """Return the fields that differ from Table I, as values that `from_yaml` can read.

        Gain patterns are written as name and digest. A pattern that is not a plug-in cannot be
        read back.
        """
        return {field.name: _plain(value) for field in dataclasses.fields(self)
                if (value := getattr(self, field.name)) != field.default}

    def fields(self) -> dict[str, Any]:
        """Return all fields by name, as plain values; see `changes`."""
        return {field.name: _plain(getattr(self, field.name))
                for field in dataclasses.fields(self)}

    @functools.cached_property
    def id(self) -> str:
        """Hash of the fields: ``sc`` and 16 hex digits, which YAML never parses as a number."""
        return f'sc{hashlib.sha256(json.dumps(self.fields()).encode()).hexdigest()[:16]}'

    @property
    def n_bands(self) -> int:
        """Number of bands N_B."""
        return len(self.center_frequencies_hz)

    @property
    def n_elements(self) -> int:
        """Number of elements N_E."""
        return self.elements_per_side**2

    @property
    def noise_power_w(self) -> float:
        """Noise power sigma_n^2 = P_N W of one sub-band [W]."""
        return 10 ** (self.noise_psd_dbm_hz / 10) * 1e-3 * self.subband_width_hz

    @property
    def sizes(self) -> dict[str, int]:
        """Array dimensions by their symbols in the paper."""
        return {'N_B': self.n_bands, 'N_SB': self.n_subbands, 'F': self.n_frames,
                'N_E': self.n_elements, 'K': self.n_feeds}

    @functools.cached_property
    def roi_bounds_m(self) -> np.ndarray:
        """Lower and upper corner of the region of interest, float64 [2, 3] [m], read-only."""
        center, size = np.array(self.roi_center_m), np.array(self.roi_size_m)
        bounds = np.stack([center - size / 2, center + size / 2])
        bounds.flags.writeable = False
        return bounds

    def sample_positions(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw positions uniformly from the region of interest, float64 [n, 3] [m]."""
        low, high = self.roi_bounds_m
        return rng.uniform(low, high, size=(n, 3))


def _plain(value: Any) -> Any:
    if isinstance(value, GainPattern):
        return str(value)
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value


def _checked(field: dataclasses.Field[Any], value: Any) -> Any:
    """Return a field's value in its declared type, or raise ScenarioError."""
    name = field.name
    if name == 'feed_positions_m':
        return None if value is None else _vectors(field, value)
    if name in ('element_gain', 'user_gain'):
        return _gain(field, value)
    if field.type is int or isinstance(field.default, int):
        if isinstance(value, bool) or not isinstance(value, numbers.Integral):
            raise ScenarioError(f'{name}: {value!r}, expected an integer')
        _check_range(field, int(value))
        return int(value)
    if isinstance(field.default, tuple):
        length = None if name == 'center_frequencies_hz' else 3
        return _numbers(field, value, length)
    return _number(field, value)


def _gain(field: dataclasses.Field[Any], value: Any) -> float | GainPattern:
    try:
        if isinstance(value, GainPattern) or callable(value):
            return value if isinstance(value, GainPattern) else GainPattern(value)
        if isinstance(value, str) and not _is_number(value):
            return GainPattern.named(value)
    except (PatternError, PluginError) as error:
        raise ScenarioError(f'{field.name}: {error}') from None
    return _number(field, value)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _vectors(field: dataclasses.Field[Any], value: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, list | tuple | np.ndarray) or len(value) == 0:
        raise ScenarioError(f'{field.name}: {value!r}, expected a list of [x, y, z]')
    return tuple(_numbers(field, row, 3) for row in value)


def _numbers(field: dataclasses.Field[Any], value: Any, length: int | None) -> tuple[float, ...]:
    expected = 'a list of numbers' if length is None else f'a list of {length} numbers'
    if not isinstance(value, list | tuple | np.ndarray) or len(value) == 0:
        raise ScenarioError(f'{field.name}: {value!r}, expected {expected}')
    if length is not None and len(value) != length:
        raise ScenarioError(f'{field.name}: {len(value)} values, expected {expected}')
    return tuple(_number(field, entry) for entry in value)


def _number(field: dataclasses.Field[Any], value: Any) -> float:
    # YAML reads 28e9 as a string, so that strings must be accepted.
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ScenarioError(f'{field.name}: {value!r}, expected a number') from None
    if isinstance(value, bool) or not math.isfinite(number):
        raise ScenarioError(f'{field.name}: {value!r}, expected a finite number')
    _check_range(field, number)
    return number


def _check_range(field: dataclasses.Field[Any], value: float) -> None:
    low, high = field.metadata['low'], field.metadata['high']
    if not low <= value <= high:
        unit = f' {field.metadata["unit"]}' if field.metadata['unit'] else ''
        # Integers may be too large for a float.
        shown = value if isinstance(value, int) else f'{value:g}'
        raise ScenarioError(
            f'{field.name}: {shown}{unit}, expected {low:g} to {high:g}{unit}')
