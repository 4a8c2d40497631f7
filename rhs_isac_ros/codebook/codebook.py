"""The codebook: the beamforming of the surface and the base station in a positioning phase.

`Codebook` reads and writes ROS parameters and files; `Provenance` describes an optimisation.
"""

import dataclasses
import functools
import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rhs_isac_ros import __version__
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import numbers, read_only
from rhs_isac_ros.model.scenario import check_shape
from rhs_isac_ros.model.surface import on_levels
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import to_number
from rhs_isac_ros.support.files import read_yaml, write_whole

# Node that receives the parameters in a codebook file, in any namespace.
PARAMETER_NODE = '/**/optimizer'
# Relative tolerance of the power constraint.
_POWER_TOLERANCE = 1e-6
# Absolute tolerance of amplitudes that must equal one of the levels.
_LEVEL_TOLERANCE = 1e-9


class CodebookError(ValueError):
    """A codebook is missing or malformed, or does not fit a scenario."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Codebook:
    """Analog and digital beamforming of a positioning phase.

    Raises CodebookError if an array is empty, has the wrong number of dimensions or contains
    anything but finite numbers, if the sizes disagree, or if `analog` is not within [0, 1].

    Examples
    --------
    >>> codebook = Codebook.default()
    >>> codebook.check(Scenario())  # An error if it did not fit.
    >>> codebook
    Codebook(id='cbc9e0547b8d8915e7', shape=(2, 8, 4, 3, 100), average_crlb_m2=0.0465)
    """

    analog: np.ndarray  #: Configurations C, float64 [N_B, F, N_E], each entry in [0, 1].
    digital: np.ndarray  #: Combining vectors S, complex128 [N_B, N_SB, F, K] [sqrt(W)].
    average_crlb_m2: float = math.nan  #: CRLB averaged over sampled positions; NaN if unknown.
    provenance: str = ''  #: Origin of the codebook; see `Provenance`.

    def __post_init__(self) -> None:
        """Copy the arrays, check them, and make them read-only."""
        for name, kind, shape in (('analog', float, ('N_B', 'F', 'N_E')),
                                  ('digital', complex, ('N_B', 'N_SB', 'F', 'K'))):
            # A copy, which the caller cannot change.
            array = np.array(numbers(
                name, getattr(self, name), kind, CodebookError, shapes=[shape]), order='C')
            if not array.size:
                raise CodebookError(f'{name}: shape {array.shape}, expected sizes from 1')
            object.__setattr__(self, name, read_only(array))
        if self.analog.min() < 0 or self.analog.max() > 1:
            raise CodebookError(
                f'analog: {self.analog.min():g} to {self.analog.max():g}, expected 0 to 1')
        n_bands, _, n_frames, _ = self.digital.shape
        if self.analog.shape[:2] != (n_bands, n_frames):
            raise CodebookError(
                f'analog: [N_B, F] = {self.analog.shape[:2]}, expected {(n_bands, n_frames)} '
                'as in digital')

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and unpickle through the constructor: NumPy's own copies could be changed."""
        return type(self), tuple(getattr(self, field.name) for field in dataclasses.fields(self))

    def __repr__(self) -> str:
        """Return the identifier, the sizes and the bound, but no arrays."""
        return (f'Codebook(id={self.id!r}, shape={self.shape}, '
                f'average_crlb_m2={self.average_crlb_m2:.3g})')

    @property
    def shape(self) -> tuple[int, int, int, int, int]:
        """Sizes (N_B, N_SB, F, K, N_E)."""
        return (*self.digital.shape, self.analog.shape[2])

    @functools.cached_property
    def id(self) -> str:
        """Hash of the arrays: ``cb`` and 16 hex digits, which YAML never parses as a number."""
        digest = hashlib.sha256(repr(self.shape).encode())
        digest.update(self.analog.astype('<f8').tobytes())
        digest.update(self.digital.astype('<c16').tobytes())
        return f'cb{digest.hexdigest()[:16]}'

    def check(self, scenario: Scenario, *, discrete: bool = True) -> None:
        """Raise CodebookError if the codebook does not fit a scenario.

        The sizes must be those of the scenario, and every frame must have the power `max_power_w`.
        If `discrete`, and the scenario has amplitude levels, every amplitude must equal one of
        them.
        """
        with translated(ValueError, CodebookError):
            check_shape('analog', self.analog, 'N_B F N_E', scenario)
            check_shape('digital', self.digital, 'N_B N_SB F K', scenario)
        power = np.sum(np.abs(self.digital)**2, axis=(1, 3))
        worst = power.flat[np.abs(power - scenario.max_power_w).argmax()]
        if abs(worst - scenario.max_power_w) > _POWER_TOLERANCE * scenario.max_power_w:
            raise CodebookError(
                f'digital: a frame has power {worst:g} W, expected max_power_w = '
                f'{scenario.max_power_w:g} W')
        errors = np.abs(self.analog - on_levels(scenario, self.analog))
        if discrete and errors.max() > _LEVEL_TOLERANCE:
            raise CodebookError(
                f'analog: {self.analog.flat[errors.argmax()]:g}, expected one of '
                f'amplitude_levels = {scenario.amplitude_levels} levels from 0 to 1')

    def to_parameters(self) -> dict[str, Any]:
        """Return ROS parameters ``codebook.*`` by name: strings, floats and lists of numbers."""
        return {
            'codebook.id': self.id,
            'codebook.shape': list(self.shape),
            'codebook.average_crlb': float(self.average_crlb_m2),
            'codebook.provenance': to_parameter(self.provenance),
            'codebook.analog': self.analog.ravel().tolist(),
            'codebook.digital_re': self.digital.real.ravel().tolist(),
            'codebook.digital_im': self.digital.imag.ravel().tolist(),
        }

    @classmethod
    def from_parameters(cls, parameters: dict[str, Any]) -> 'Codebook':
        """Create a codebook from ROS parameters as returned by `to_parameters`.

        Id, average CRLB and provenance may be missing, and the id may be empty. Raises
        CodebookError if another parameter is missing, one is malformed, or the id does not match.
        """
        shape = parameters.get('codebook.shape')
        if not isinstance(shape, Sequence) or len(shape) != 5 or not all(
                isinstance(size, int) and size > 0 for size in shape):
            raise CodebookError(
                f'codebook.shape: {shape!r}, expected [N_B, N_SB, F, K, N_E], all positive')
        n_bands, n_subbands, n_frames, n_feeds, n_elements = shape
        digital_shape = (n_bands, n_subbands, n_frames, n_feeds)
        # `_array` compares the sizes before memory is allocated for a shape that may be too large.
        real, imag = (_array(parameters, name, digital_shape)
                      for name in ('digital_re', 'digital_im'))
        digital = np.empty(digital_shape, complex)
        digital.real, digital.imag = real, imag
        codebook = cls(
            _array(parameters, 'analog', (n_bands, n_frames, n_elements)), digital,
            _number(parameters, 'average_crlb'),
            from_parameter(str(parameters.get('codebook.provenance', ''))))
        claimed_id = parameters.get('codebook.id', '')
        if claimed_id and claimed_id != codebook.id:
            raise CodebookError(
                f'codebook.id: {claimed_id!r}, expected {codebook.id!r}, the hash of the content')
        return codebook

    def save(self, path: str | Path) -> None:
        """Write a ROS 2 parameter file atomically; raise OSError if it cannot be written."""
        values = {name.partition('.')[2]: value for name, value in self.to_parameters().items()}
        content = {PARAMETER_NODE: {'ros__parameters': {'codebook': values}}}
        text = yaml.safe_dump(content, sort_keys=False, width=95, default_flow_style=None)
        write_whole(path, text)

    @classmethod
    def default(cls) -> 'Codebook':
        """Return the codebook of the package for Table I; see `default_codebook_file`."""
        return cls.load(default_codebook_file())

    @classmethod
    def load(cls, path: str | Path, scenario: Scenario | None = None) -> 'Codebook':
        """Read a ROS 2 parameter file, and check that the codebook fits a `scenario`, if given.

        Raises CodebookError unless the file contains a valid codebook.
        """
        with translated(ValueError, CodebookError):
            content = read_yaml(path)
        for node in content.values() if isinstance(content, dict) else ():
            parameters = node.get('ros__parameters', {}) if isinstance(node, dict) else {}
            values = parameters.get('codebook') if isinstance(parameters, dict) else None
            if isinstance(values, dict):
                with translated(CodebookError, CodebookError, path):
                    codebook = cls.from_parameters(
                        {f'codebook.{k}': v for k, v in values.items()})
                    if scenario:
                        codebook.check(scenario)
                    return codebook
        raise CodebookError(f'{path}: expected ros__parameters with a mapping named codebook')


def _number(parameters: dict[str, Any], name: str) -> float:
    """Return a parameter, or NaN if it is missing; raise CodebookError if it is not a number."""
    value = parameters.get(f'codebook.{name}', math.nan)
    # ``ros2 param load`` sends NaN as text.
    value = math.nan if value in ('.nan', 'nan') else to_number(value, float)
    if not isinstance(value, float):
        raise CodebookError(f'codebook.{name}: {value!r}, expected a number')
    return value


def _array(parameters: dict[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return a list parameter as float64 of `shape`; raise CodebookError if it does not fit."""
    values = parameters.get(f'codebook.{name}', ())
    if isinstance(values, str):
        # ``ros2 param load`` sends a list as text if it contains a number such as 1e-05.
        values = [value.strip() for value in values.strip('[]').split(',')]
    if isinstance(values, Sequence):
        # YAML 1.1 reads 1e-05 as text.
        values = [to_number(value, float) for value in values]
    values = numbers(f'codebook.{name}', values, error=CodebookError, finite=False)
    if values.size != math.prod(shape):
        raise CodebookError(
            f'codebook.{name}: {values.size} values, expected {math.prod(shape)} = '
            f'{" x ".join(map(str, shape))} by codebook.shape')
    return values.reshape(shape)


def default_codebook_file() -> Path:
    """Return the path of ``config/codebook.yaml``; raise CodebookError if it is not found.

    Examples
    --------
    >>> Codebook.load(default_codebook_file()).id == Codebook.default().id
    True
    """
    # Every installation scheme puts share/ into a folder above the modules: the prefix of pip and
    # colcon, or the folder of pip's --target. A clone has config/ beside the package.
    package = Path(__file__).resolve().parents[1]
    folders = [package.parent / 'config',
               *(folder / 'share' / 'rhs_isac_ros' / 'config' for folder in package.parents)]
    for folder in folders:
        if (file := folder / 'codebook.yaml').is_file():
            return file
    raise CodebookError(f'codebook.yaml: not found in {folders[0]}, nor in '
                        f'share/rhs_isac_ros/config of any folder above {package}')


@dataclasses.dataclass(frozen=True)
class Provenance:
    """The arguments and the progress of an optimisation, and the version of the package."""

    method: str
    objective: str
    seed: int
    sampling: str
    positions: int  #: Number of positions.
    scenario: dict[str, Any]  #: Fields of the scenario that differ from Table I.
    version: str = __version__
    calibration: str = ''  #: Id of the calibration, if any.
    steps: int = 0  #: Number of steps, including those before a resumption.
    evaluations: int = 0  #: Number of evaluations, including earlier ones.
    value_m2: float = math.nan  #: Lowest value of the objective; NaN if unknown.
    reason: str = ''

    def to_text(self) -> str:
        """Return the provenance as one line of text, for `Codebook.provenance`."""
        fields = dataclasses.asdict(self)
        if not self.calibration:
            del fields['calibration']
        return encode(fields)

    def resumed(self, text: str) -> 'Provenance':
        """Parse the provenance of an earlier result that this optimisation continues.

        Raises ValueError unless the text describes an optimisation with the same arguments.
        """
        earlier = Provenance.parse(text)
        if earlier is None:
            raise ValueError(f'resume: provenance {text!r}, expected that of an optimisation')
        for name in ('method', 'objective', 'seed', 'sampling', 'positions', 'scenario',
                     'calibration'):
            given, expected = getattr(self, name), getattr(earlier, name)
            if given != expected:
                raise ValueError(
                    f'{name}: {given!r}, expected {expected!r} as in the codebook to resume from')
        return earlier

    @classmethod
    def parse(cls, text: str) -> 'Provenance | None':
        """Parse a text that `to_text` or version 0.1.0 wrote; return None for any other text."""
        try:
            return cls(**decode(from_parameter(text)))
        except (TypeError, ValueError, RecursionError):
            return None


# ``ros2 param load`` parses each value of a file as YAML a second time. It cannot send a string
# such as ``{seed: 0}``, which then becomes a mapping, but it preserves strings that need no quotes
# in YAML. The strings that match `_WORDS` need none. They contain no comma, so ``, `` can separate
# the fields.
_WORDS = re.compile(r'[A-Za-z][\w.+-]*( [\w.+-]+)*', re.ASCII)
# Values of JSON that look like words.
_CONSTANTS = {'null', 'true', 'false', 'NaN', 'Infinity'}
_NOTE = 'note='


def encode(fields: Mapping[str, Any]) -> str:
    """Return fields as ``name=value, name=value``; each value is JSON unless it is plain words."""
    return ', '.join(
        f'{name}={value if _is_bare(value) else _to_json(value)}'
        for name, value in fields.items())


def decode(text: str) -> dict[str, Any]:
    """Return the fields of a text that `encode` returned, or raise ValueError."""
    pairs = [part.partition('=') for part in text.split(', ')]
    if not all(name and separator for name, separator, _ in pairs):
        raise ValueError(f'{text!r}, expected name=value, name=value')
    return {name: value if _is_bare(value) else json.loads(value) for name, _, value in pairs}


def to_parameter(text: str) -> str:
    """Return a text, encoded if parsing it as YAML would change it or if it looks encoded."""
    if not text or _parse_yaml(text) == text and not text.startswith(_NOTE):
        return text
    return _NOTE + _to_json(text)


def from_parameter(text: str) -> str:
    """Return the original text of a string from `to_parameter`; return other texts unchanged.

    A mapping, which versions up to 0.1.0 wrote, is converted to the format of `encode`.
    """
    legacy = _parse_yaml(text) if text.startswith('{') else None
    if isinstance(legacy, dict):
        return encode(legacy)
    if not text.startswith(f'{_NOTE}"'):
        return text
    try:
        return str(json.loads(text.removeprefix(_NOTE)))
    except ValueError:
        return text


def _to_json(value: Any) -> str:
    # Compact JSON contains spaces only within strings, where they can be escaped.
    return json.dumps(value, separators=(',', ':'), default=str).replace(' ', r'\u0020')


def _is_bare(value: Any) -> bool:
    return (isinstance(value, str) and bool(_WORDS.fullmatch(value))
            and value not in _CONSTANTS)


def _parse_yaml(text: str) -> Any:
    """Parse a text as YAML; return None if it is invalid."""
    try:
        return yaml.safe_load(text)
    # PyYAML raises ValueError for impossible dates and RecursionError for deep nesting.
    except (yaml.YAMLError, ValueError, RecursionError):
        return None
