"""ROS messages as text, laid out as by ``ros2 topic echo``."""

import array
import dataclasses
import re
import sys
from typing import Any

import numpy as np
import yaml


@dataclasses.dataclass(frozen=True)
class Layout:
    """What of a message is written.

    Attributes
    ----------
    longest
        Entries of an array, or characters of a string, after which dots follow; None: all.
    arrays, strings
        Whether they are written; only type and length otherwise.
    flow
        Whether collections stand on one line.
    """

    longest: int | None = None
    arrays: bool = True
    strings: bool = True
    flow: bool = False


def as_yaml(message: Any, layout: Layout) -> str:
    """Write a message as YAML.

    Parameters
    ----------
    message
        A ROS message.
    layout
        What to write.

    Returns
    -------
    str
        The text, with an end of line.
    """
    return yaml.dump(_mapping(message, layout), sort_keys=False, allow_unicode=True,
                     width=sys.maxsize, default_flow_style=layout.flow)


def as_csv(message: Any, layout: Layout) -> str:
    """Write all fields of a message, and of those within it, with commas between.

    Parameters
    ----------
    message
        A ROS message.
    layout
        What to write.

    Returns
    -------
    str
        One line, without its end.
    """
    return ','.join(str(leaf) for leaf in _leaves(_mapping(message, layout)))


def _mapping(message: Any, layout: Layout) -> dict[str, Any]:
    types = message.get_fields_and_field_types()
    return {name: _plain(getattr(message, name), kind, layout) for name, kind in types.items()}


def _plain(value: Any, kind: str, layout: Layout) -> Any:
    """Return a value made of what YAML knows."""
    longest = layout.longest
    match value:
        case bytes():
            return _cut(''.join(map(chr, value)), longest)
        case str():
            return _cut(value, longest) if layout.strings else f'<string length: <{len(value)}>>'
        case list() | tuple() | array.array() | np.ndarray():
            if kind and not layout.arrays:
                return _outline(kind, len(value))
            entries = [_plain(entry, '', layout) for entry in value[:longest]]
            return entries + ['...'] * (len(value) > len(entries))
        case np.generic():
            return value.item()
        case bool() | int() | float():
            return value
    return _mapping(value, layout)


def _cut(text: str, longest: int | None) -> str:
    return text if longest is None or len(text) <= longest else f'{text[:longest]}...'


def _outline(kind: str, length: int) -> str:
    """Return type and length of an array, from the type as a message tells it."""
    sequence = re.fullmatch(r'sequence<(.+?)(?:, (\d+))?>', kind)
    entry, bound = sequence.groups() if sequence else re.fullmatch(r'(.+)\[(\d+)\]', kind).groups()
    entry = entry.replace('/', '/msg/')
    bound = f'[{bound}]' if bound else ''
    return (f'<sequence type: {entry}{bound}, length: {length}>' if sequence
            else f'<array type: {entry}{bound}>')


def _leaves(value: Any) -> list[Any]:
    if isinstance(value, dict | list):
        entries = value.values() if isinstance(value, dict) else value
        # An empty array still has its place.
        return [leaf for entry in entries for leaf in _leaves(entry)] or ['']
    return [value]
