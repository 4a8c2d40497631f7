"""The scenario: all parameters of the model, with their ranges and units."""

import dataclasses
import functools
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rhs_isac_ros.model.deviations import Deviations
from rhs_isac_ros.model.fields import ScenarioError, checked
from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.table1 import Table1

SPEED_OF_LIGHT_MPS = 299_792_458.0


@dataclasses.dataclass(frozen=True)
class Scenario(Deviations, Table1):
    """Geometry, bands and propagation of one system; the defaults are the paper's Table I.

    The fields are those of `Table1`, followed by those of `Deviations`, all of which are off by
    default.

    Lengths are in metres in the frame ``map``: the surface lies in the plane x = 0, centred on
    the origin, with x pointing outward and z up.

    A gain is a number, a `GainPattern`, a function of the angle from the boresight, or the name
    of an installed plug-in. Files can hold numbers and names only.

    Raises
    ------
    ScenarioError
        If a value has the wrong type, is out of range, or contradicts another one.
    """

    def __post_init__(self) -> None:
        """Convert every field to its declared type and check it."""
        for field in dataclasses.fields(self):
            value = checked(field, getattr(self, field.name))
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
        if self.amplitude_levels == 1:
            raise ScenarioError(
                'amplitude_levels: 1, expected 0 for continuous amplitudes, or at least 2')

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
