"""Random and mutated messages of any type, in CDR."""

import array
import importlib
import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

_FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-300, -1e300, math.nan, math.inf, -math.inf)
_WIDTHS = {'boolean': 1, 'octet': 8, 'char': 8, 'uint8': 8, 'uint16': 16, 'uint32': 32,
           'uint64': 64}
_SIGNED = {'int8': 8, 'int16': 16, 'int32': 32, 'int64': 64}
_TEXTS = ('', 'a', 'cb', '\u00e9\u4e2d', 'x' * 3000, '../../etc', '%s%n', '\x1b[2J', '\x00')
_ARRAY = re.compile(r'(.+)\[(\d+)\]$')
_SEQUENCE = re.compile(r'sequence<(.+?)(?:, \d+)?>$')
_LENGTHS = (0, 1, 2, 3, 7, 40, 100, 200, 5000)


def lie(kind: type, heard: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """Make a message that nobody meant.

    Parameters
    ----------
    kind
        Its ROS type.
    heard
        True messages of this type, in CDR; may be empty.
    rng
        Source of randomness.

    Returns
    -------
    bytes
        A random message, or a true one with a field changed, bytes changed, or its end missing.
        The first four bytes, which say how the rest is coded, are always there: without them Fast
        DDS delivers nothing.
    """
    if not heard or rng.random() < 0.3:
        return serialize_message(random_message(kind, rng))
    true = heard[rng.integers(len(heard))]
    way = rng.random()
    if way < 0.5:
        message = deserialize_message(true, kind)
        _change_field(message, rng)
        return serialize_message(message)
    if way < 0.9:
        changed = bytearray(true)
        for _ in range(rng.integers(1, 9)):
            changed[rng.integers(4, len(changed)) if len(changed) > 4 else 0] = rng.integers(256)
        return bytes(changed)
    # Whole words: DDS fills them up with zeros, which may make a message whole again.
    return true[:4 * rng.integers(1, len(true) // 4 + 1)]


def random_message(kind: type, rng: np.random.Generator) -> Any:
    """Fill a message with values that its types allow, the worst of them first.

    Parameters
    ----------
    kind
        Its ROS type.
    rng
        Source of randomness.

    Returns
    -------
    Any
        The message.
    """
    message = kind()
    for name, text in kind.get_fields_and_field_types().items():
        setattr(message, name, _value(text, rng))
    return message


def _change_field(message: Any, rng: np.random.Generator) -> None:
    """Change one field, perhaps one of a field's own."""
    fields = message.get_fields_and_field_types()
    name = list(fields)[rng.integers(len(fields))]
    inner = getattr(message, name)
    if hasattr(inner, 'get_fields_and_field_types') and rng.random() < 0.8:
        _change_field(inner, rng)
    elif isinstance(inner, array.array) and len(inner) and rng.random() < 0.5:
        inner[rng.integers(len(inner))] = _value(_element(fields[name]), rng)
    else:
        setattr(message, name, _value(fields[name], rng))


def _element(text: str) -> str:
    match = _SEQUENCE.match(text) or _ARRAY.match(text)
    return match[1]


def _value(text: str, rng: np.random.Generator) -> Any:
    """Make a value of a type, as `get_fields_and_field_types` names types."""
    if match := _ARRAY.match(text):
        return _values(match[1], int(match[2]), rng, fixed=True)
    if match := _SEQUENCE.match(text):
        length = _LENGTHS[rng.integers(len(_LENGTHS))]
        few = '/' in match[1] or match[1] == 'string'
        return _values(match[1], min(length, 3) if few else length, rng)
    if text in ('float', 'double'):
        return float(rng.normal()) if rng.random() < 0.5 else float(rng.choice(_FLOATS))
    if text == 'string':
        return str(_TEXTS[rng.integers(len(_TEXTS))])
    if text == 'boolean':
        return bool(rng.integers(2))
    if text == 'octet':
        return bytes([rng.integers(256)])
    if text in _WIDTHS:
        most = 2**_WIDTHS[text] - 1
        return int(rng.choice([0, 1, 2, 3, 5, min(1000, most), most // 2, most - 1, most],
                              ).item()) if most < 2**63 else _wide(rng, most)
    if text in _SIGNED:
        most = 2**(_SIGNED[text] - 1) - 1
        return int(rng.choice([0, 1, -1, most, -most - 1]).item())
    package, name = text.split('/')
    return random_message(getattr(importlib.import_module(f'{package}.msg'), name), rng)


def _wide(rng: np.random.Generator, most: int) -> int:
    return (0, 1, 2, 1000, most // 2, most // 2 + 1, most)[rng.integers(7)]


def _values(kind: str, n: int, rng: np.random.Generator, fixed: bool = False) -> Any:
    if kind == 'double':
        numbers = rng.normal(size=n) if rng.random() < 0.7 else rng.choice(_FLOATS, size=n)
        return numbers if fixed else array.array('d', numbers.tobytes())
    if kind in _WIDTHS and kind not in ('boolean', 'octet', 'char'):
        codes = {8: 'B', 16: 'H', 32: 'I', 64: 'Q'}
        return array.array(codes[_WIDTHS[kind]], [_value(kind, rng) for _ in range(n)])
    return [_value(kind, rng) for _ in range(n)]
