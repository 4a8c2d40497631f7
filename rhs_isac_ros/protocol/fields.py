"""Declarations of the valid values of message fields, and their check."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

import numpy as np


class MessageError(ValueError):
    """A field of a message has an invalid value."""


def array(
        dims: str, kind: type = float, low: float = -math.inf, high: float = math.inf,
        nan_allowed: bool = False) -> Any:
    """Declare an array field.

    Parameters
    ----------
    dims
        Dimensions as numbers, or as symbols of `Scenario.sizes` or of `Message.own_sizes`.
    kind
        ``float``, ``complex`` or ``int``.
    low, high
        Range of the entries of a real array, inclusive.
    nan_allowed
        Whether entries may be NaN, for unknown values.
    """
    return dataclasses.field(
        metadata={'dims': tuple(dims.split()), 'kind': kind, 'low': low, 'high': high,
                  'nan_allowed': nan_allowed})


def index(symbol: str) -> Any:
    """Declare an index that is less than the size `symbol` of `Scenario.sizes`."""
    return dataclasses.field(metadata={'index_of': symbol})


def number(low: float, high: float, default: Any = dataclasses.MISSING) -> Any:
    """Declare a number with an inclusive range."""
    return dataclasses.field(default=default, metadata={'low': low, 'high': high})


def size(symbol: str) -> Any:
    """Declare a field that equals the size `symbol` of `Scenario.sizes`."""
    return dataclasses.field(metadata={'equals': symbol})


def optional_float() -> Any:
    """Declare a number that may be NaN, for an unknown value."""
    return dataclasses.field(metadata={'nan_allowed': True})


class Checkable(Protocol):
    """A dataclass with the fields declared here."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return sizes that depend on the content, by symbol."""
        ...


def check(message: Checkable, sizes: Mapping[str, int]) -> None:
    """Check the arrays, indices and numbers of a message.

    Parameters
    ----------
    sizes
        Sizes by symbol, as in `Scenario.sizes`.

    Raises
    ------
    MessageError
        If a shape differs, an index is too large, or a number is not finite or out of its range;
        the text names the message, the field, its value and the expected value.
    """
    own = message.own_sizes(sizes)
    sizes = {**sizes, **own} if own else sizes
    for name, meta in _fields(type(message)):
        value = getattr(message, name)
        problem = ''
        if 'dims' in meta:
            problem = _array_problem(value, meta, sizes)
        elif 'index_of' in meta and not 0 <= value < sizes[meta['index_of']]:
            end = sizes[meta['index_of']]
            problem = f'{value}, expected 0 to {end - 1} ({meta["index_of"]} = {end})'
        elif isinstance(value, float) and not math.isfinite(value) and 'nan_allowed' not in meta:
            problem = f'{value}, expected a finite number'
        elif 'equals' in meta and value != sizes[meta['equals']]:
            problem = f'{value}, expected {meta["equals"]} = {sizes[meta["equals"]]}'
        elif 'low' in meta and not meta['low'] <= value <= meta['high']:
            problem = f'{value}, expected {meta["low"]:g} to {meta["high"]:g}'
        if problem:
            raise MessageError(f'{type(message).__name__}.{name}: {problem}')


@functools.cache
def _fields(kind: type[Checkable]) -> tuple[tuple[str, Mapping[str, Any]], ...]:
    """Return name and declaration of every field whose values are restricted."""
    return tuple((field.name, field.metadata) for field in dataclasses.fields(kind)
                 if field.metadata or field.type is float)


def _array_problem(value: np.ndarray, meta: Mapping[str, Any], sizes: Mapping[str, int]) -> str:
    dims = meta['dims']
    expected = [sizes[d] if d in sizes else int(d) for d in dims]
    if list(value.shape) != expected:
        described = ', '.join(d if d.isdigit() else f'{d} = {e}'
                           for d, e in zip(dims, expected, strict=True))
        return f'shape {list(value.shape)}, expected [{described}]'
    finite = np.isfinite(value)
    if not finite.all() and not (meta['nan_allowed'] and (finite | np.isnan(value)).all()):
        return 'not finite, expected finite numbers'
    if meta['low'] > -math.inf and value.size and (
            value.min() < meta['low'] or value.max() > meta['high']):
        return (f'{value.min():g} to {value.max():g}, expected '
                f'{meta["low"]:g} to {meta["high"]:g}')
    return ''
