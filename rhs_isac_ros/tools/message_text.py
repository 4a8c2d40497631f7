"""ROS messages as text, in the layout of ``ros2 topic echo``."""

import array
import dataclasses
import re
import sys
from typing import Any

import numpy as np
import yaml


@dataclasses.dataclass(frozen=True)
class Layout:
    """Options of the text.

    Attributes
    ----------
    max_length
        Maximum number of entries of an array or characters of a string; the rest is replaced by
        dots. None: unlimited.
    arrays, strings
        Whether their values are written; otherwise only type and length.
    flow
        Whether collections are written on one line.
    """

    max_length: int | None = None
    arrays: bool = True
    strings: bool = True
    flow: bool = False


def as_yaml(message: Any, layout: Layout) -> str:
    """Return a ROS message as YAML, ending with a newline."""
    return yaml.dump(_mapping(message, layout), sort_keys=False, allow_unicode=True,
                     width=sys.maxsize, default_flow_style=layout.flow)


def as_csv(message: Any, layout: Layout) -> str:
    """Return all fields of a ROS message and of nested messages, separated by commas."""
    return ','.join(str(leaf) for leaf in _leaves(_mapping(message, layout)))


def _mapping(message: Any, layout: Layout) -> dict[str, Any]:
    types = message.get_fields_and_field_types()
    return {name: _plain(getattr(message, name), kind, layout) for name, kind in types.items()}


def _plain(value: Any, kind: str, layout: Layout) -> Any:
    """Convert a value to types that YAML supports."""
    max_length = layout.max_length
    match value:
        case bytes():
            return _truncate(''.join(map(chr, value)), max_length)
        case str():
            return (_truncate(value, max_length) if layout.strings
                    else f'<string length: <{len(value)}>>')
        case list() | tuple() | array.array() | np.ndarray():
            if kind and not layout.arrays:
                return _array_summary(kind, len(value))
            entries = [_plain(entry, '', layout) for entry in value[:max_length]]
            return entries + ['...'] * (len(value) > len(entries))
        case np.generic():
            return value.item()
        case bool() | int() | float():
            return value
    return _mapping(value, layout)


def _truncate(text: str, max_length: int | None) -> str:
    if max_length is None or len(text) <= max_length:
        return text
    return f'{text[:max_length]}...'


def _array_summary(kind: str, length: int) -> str:
    """Return type and length of an array, from the type as the message class names it."""
    if sequence := re.fullmatch(r'sequence<(.+?)(?:, (\d+))?>', kind):
        entry, bound = sequence.groups()
    else:
        entry, _, bound = kind.removesuffix(']').rpartition('[')
    entry = entry.replace('/', '/msg/')
    bound = f'[{bound}]' if bound else ''
    return (f'<sequence type: {entry}{bound}, length: {length}>' if sequence
            else f'<array type: {entry}{bound}>')


def _leaves(value: Any) -> list[Any]:
    if isinstance(value, dict | list):
        entries = value.values() if isinstance(value, dict) else value
        # An empty array takes one column.
        return [leaf for entry in entries for leaf in _leaves(entry)] or ['']
    return [value]
