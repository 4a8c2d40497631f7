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
_TYPE_CODES = {'uint8': 'B', 'uint16': 'H', 'uint32': 'I', 'uint64': 'Q'}
_STRINGS = ('', 'a', 'cb', '\u00e9\u4e2d', 'x' * 3000, '../../etc', '%s%n', '\x1b[2J', '\x00')
_ARRAY = re.compile(r'(.+)\[(\d+)\]$')
_SEQUENCE = re.compile(r'sequence<(.+?)(?:, \d+)?>$')
_LENGTHS = (0, 1, 2, 3, 7, 40, 100, 200, 5000)


def mutate(kind: type, originals: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """Return a random message of a ROS type, or one of the originals, if any, with a change.

    The change is that of a field, of bytes, or the loss of the last bytes. The first four bytes,
    the CDR header, are always intact: Fast DDS does not deliver a message without them.
    """
    if not originals or rng.random() < 0.3:
        return serialize_message(random_message(kind, rng))
    original = originals[rng.integers(len(originals))]
    draw = rng.random()
    if draw < 0.5:
        message = deserialize_message(original, kind)
        _change_field(message, rng)
        return serialize_message(message)
    if draw < 0.9:
        changed = bytearray(original)
        for _ in range(rng.integers(1, 9)):
            changed[rng.integers(4, len(changed)) if len(changed) > 4 else 0] = rng.integers(256)
        return bytes(changed)
    # Cut off whole words only: DDS pads a message to whole words with zeros, which may restore it.
    return original[:4 * rng.integers(1, len(original) // 4 + 1)]


def random_message(kind: type, rng: np.random.Generator) -> Any:
    """Create a ROS message whose fields have random values, some of them extreme."""
    message = kind()
    for name, field_type in kind.get_fields_and_field_types().items():
        setattr(message, name, _value(field_type, rng))
    return message


def _change_field(message: Any, rng: np.random.Generator) -> None:
    """Change one field of a message or of a nested message."""
    fields = message.get_fields_and_field_types()
    name = list(fields)[rng.integers(len(fields))]
    value = getattr(message, name)
    if hasattr(value, 'get_fields_and_field_types') and rng.random() < 0.8:
        _change_field(value, rng)
    elif isinstance(value, array.array) and len(value) and rng.random() < 0.5:
        value[rng.integers(len(value))] = _value(_entry_type(fields[name]), rng)
    else:
        setattr(message, name, _value(fields[name], rng))


def _entry_type(field_type: str) -> str:
    match = _SEQUENCE.match(field_type) or _ARRAY.match(field_type)
    return match[1]


def _value(field_type: str, rng: np.random.Generator) -> Any:
    """Create a value of a type whose name is as in `get_fields_and_field_types`."""
    if match := _ARRAY.match(field_type):
        return _values(match[1], int(match[2]), rng, fixed=True)
    if match := _SEQUENCE.match(field_type):
        length = _LENGTHS[rng.integers(len(_LENGTHS))]
        nested = '/' in match[1] or match[1] == 'string'
        return _values(match[1], min(length, 3) if nested else length, rng)
    if field_type in ('float', 'double'):
        return float(rng.normal()) if rng.random() < 0.5 else float(rng.choice(_FLOATS))
    if field_type == 'string':
        return str(_STRINGS[rng.integers(len(_STRINGS))])
    if field_type == 'boolean':
        return bool(rng.integers(2))
    if field_type == 'octet':
        return bytes([rng.integers(256)])
    if '/' in field_type:
        package, name = field_type.split('/')
        return random_message(getattr(importlib.import_module(f'{package}.msg'), name), rng)
    low, top = np.iinfo(field_type).min, np.iinfo(field_type).max
    values = (low, max(low, -1), 0, 1, 2, 3, 5, min(1000, top), top // 2, top // 2 + 1, top - 1,
              top)
    # Unlike this index, numpy.random.Generator.choice takes no integers of more than 63 bits.
    return values[rng.integers(len(values))]


def _values(entry_type: str, n: int, rng: np.random.Generator, fixed: bool = False) -> Any:
    if entry_type == 'double':
        numbers = rng.normal(size=n) if rng.random() < 0.7 else rng.choice(_FLOATS, size=n)
        return numbers if fixed else array.array('d', numbers.tobytes())
    values = [_value(entry_type, rng) for _ in range(n)]
    code = _TYPE_CODES.get(entry_type)
    return array.array(code, values) if code else values
