"""Provenance of a codebook, and its text for the parameter ``codebook.provenance``.

``ros2 param load`` parses each value of a file as YAML a second time, so that a string such as
``{seed: 0}`` becomes a mapping, which it cannot send. A plain string in YAML is preserved.
"""

import dataclasses
import json
import re
from collections.abc import Mapping
from typing import Any

import yaml

from rhs_isac_ros import __version__

# A string that needs no quotes. Its only separators are single spaces, so that ``, `` separates
# the fields.
_WORDS = re.compile(r'[A-Za-z][\w.+-]*( [\w.+-]+)*', re.ASCII)
# Values of JSON that look like words.
_CONSTANTS = {'null', 'true', 'false', 'NaN', 'Infinity'}
_NOTE = 'note='


def encode(fields: Mapping[str, Any]) -> str:
    """Return fields as ``name=value, name=value``.

    A value is a string of plain words, or JSON without spaces.
    """
    return ', '.join(f'{name}={_encode_value(value)}' for name, value in fields.items())


def decode(text: str) -> dict[str, Any]:
    """Return the fields of a text that `encode` returned.

    It also accepts a mapping in YAML, the text that versions up to 0.1.0 wrote.

    Raises
    ------
    ValueError
        If the text is neither.
    """
    legacy = _parse_yaml(text)
    if isinstance(legacy, dict):
        return legacy
    pairs = [part.partition('=') for part in text.split(', ')]
    if not all(name and separator for name, separator, _ in pairs):
        raise ValueError(f'{text!r}, expected name=value, name=value')
    return {name: _decode_value(value) for name, _, value in pairs}


def to_parameter(text: str) -> str:
    """Return any text as a string that YAML parses as the same string."""
    if not text or _parse_yaml(text) == text and not text.startswith(_NOTE):
        return text
    return _NOTE + _encode_json(text)


def from_parameter(text: str) -> str:
    """Return the text for which `to_parameter` returned a string.

    The mapping in YAML that earlier versions wrote becomes the text of `encode`.
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


def _encode_value(value: Any) -> str:
    return value if isinstance(value, str) and _is_bare(value) else _encode_json(value)


def _encode_json(value: Any) -> str:
    # Compact JSON contains spaces only within strings, where they can be escaped.
    return json.dumps(value, separators=(',', ':'), default=str).replace(' ', r'\u0020')


def _decode_value(text: str) -> Any:
    return text if _is_bare(text) else json.loads(text)


def _is_bare(text: str) -> bool:
    return bool(_WORDS.fullmatch(text)) and text not in _CONSTANTS


def _parse_yaml(text: str) -> Any:
    """Return the value of a text in YAML; None if it is invalid."""
    try:
        return yaml.safe_load(text)
    # PyYAML raises ValueError for impossible dates and RecursionError for deep nesting.
    except (yaml.YAMLError, ValueError, RecursionError):
        return None


@dataclasses.dataclass(frozen=True)
class Provenance:
    """The arguments of an optimisation and the progress it made.

    Attributes
    ----------
    positions
        Number of positions.
    scenario
        Fields of the scenario that differ from Table I.
    version
        Version of this package.
    calibration
        Id of the calibration; empty without one.
    steps, evaluations
        Totals, including those of the runs that it resumed.
    value_m2
        The objective [m^2].
    reason
        Why the search stopped.
    """

    method: str
    objective: str
    seed: int
    sampling: str
    positions: int
    scenario: dict[str, Any]
    version: str = __version__
    calibration: str = ''
    steps: int = 0
    evaluations: int = 0
    value_m2: float = float('nan')
    reason: str = ''

    def to_text(self) -> str:
        """Return one line that describes a result, for `Codebook.provenance`."""
        fields = dataclasses.asdict(self)
        if not self.calibration:
            del fields['calibration']
        return encode(fields)

    def resumed(self, text: str) -> 'Provenance':
        """Return the provenance of an earlier result, to resume it.

        Raise ValueError unless it is the result of an optimisation with the same arguments.
        """
        earlier = Provenance.parse(text)
        if earlier is None:
            raise ValueError(
                f'resume: provenance {text!r}, expected that of an optimisation')
        for name in ('method', 'objective', 'seed', 'sampling', 'positions', 'scenario',
                     'calibration'):
            given, expected = getattr(self, name), getattr(earlier, name)
            if given != expected:
                raise ValueError(
                    f'{name}: {given!r}, expected {expected!r} as in the codebook to resume from')
        return earlier

    @classmethod
    def parse(cls, text: str) -> 'Provenance | None':
        """Parse the text that `to_text` returns; return None for any other text."""
        try:
            return cls(**decode(text))
        except (TypeError, ValueError, RecursionError):
            return None
