"""Declaring what the fields of a message hold, and checking it."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


class MessageError(ValueError):
    """A message holds something that no valid message holds."""


def array(
        dims: str, kind: type = float, low: float = -math.inf, high: float = math.inf,
        may_lack: bool = False) -> Any:
    """Declare an array field.

    Parameters
    ----------
    dims
        Dimensions as numbers, or as symbols of `Scenario.sizes` or of `Message.own_sizes`.
    kind
        ``float`` or ``complex``.
    low, high
        Range of the entries, for real arrays.
    may_lack
        Whether entries may be NaN, for `not known`.

    Returns
    -------
    dataclasses.Field
        The field.
    """
    return dataclasses.field(
        metadata={'dims': tuple(dims.split()), 'kind': kind, 'low': low, 'high': high,
                  'may_lack': may_lack})


def index(symbol: str) -> Any:
    """Declare a field that counts from 0 to below a size.

    Parameters
    ----------
    symbol
        The size, a symbol of `Scenario.sizes`.

    Returns
    -------
    dataclasses.Field
        The field.
    """
    return dataclasses.field(metadata={'below': symbol})


def number(low: float, high: float) -> Any:
    """Declare a number with a range.

    Parameters
    ----------
    low, high
        Range, inclusive.

    Returns
    -------
    dataclasses.Field
        The field.
    """
    return dataclasses.field(metadata={'least': low, 'most': high})


def size(symbol: str) -> Any:
    """Declare a field that repeats a size.

    Parameters
    ----------
    symbol
        The size, a symbol of `Scenario.sizes`.

    Returns
    -------
    dataclasses.Field
        The field.
    """
    return dataclasses.field(metadata={'equals': symbol})


def open_float() -> Any:
    """Declare a number that may be NaN, for `not known`.

    Returns
    -------
    dataclasses.Field
        The field.
    """
    return dataclasses.field(metadata={'open': True})


def check(message: Any, sizes: Mapping[str, int]) -> None:
    """Check a message's arrays, indices and numbers.

    Parameters
    ----------
    message
        A message, a dataclass with such fields and a method `own_sizes`.
    sizes
        Sizes by symbol, as `Scenario.sizes` gives them.

    Raises
    ------
    MessageError
        If a shape differs, an index is too high, or a number is not finite or out of its range;
        the text names message, field, value and what was expected.
    """
    own = message.own_sizes(sizes)
    sizes = {**sizes, **own} if own else sizes
    for name, meta in _fields(type(message)):
        value = getattr(message, name)
        problem = ''
        if 'dims' in meta:
            problem = _array_problem(value, meta, sizes)
        elif 'below' in meta and not 0 <= value < sizes[meta['below']]:
            end = sizes[meta['below']]
            problem = f'{value}, expected 0 to {end - 1} ({meta["below"]} = {end})'
        elif isinstance(value, float) and not math.isfinite(value) and 'open' not in meta:
            problem = f'{value}, expected a finite number'
        elif 'equals' in meta and value != sizes[meta['equals']]:
            problem = f'{value}, expected {meta["equals"]} = {sizes[meta["equals"]]}'
        elif 'least' in meta and not meta['least'] <= value <= meta['most']:
            problem = f'{value}, expected {meta["least"]:g} to {meta["most"]:g}'
        if problem:
            raise MessageError(f'{type(message).__name__}.{name}: {problem}')


@functools.cache
def _fields(kind: type) -> tuple[tuple[str, Mapping[str, Any]], ...]:
    """Name and declaration of every field."""
    return tuple((field.name, field.metadata) for field in dataclasses.fields(kind))


def _array_problem(value: np.ndarray, meta: Mapping[str, Any], sizes: Mapping[str, int]) -> str:
    dims = meta['dims']
    expected = [sizes[d] if d in sizes else int(d) for d in dims]
    if list(value.shape) != expected:
        wanted = ', '.join(d if d.isdigit() else f'{d} = {e}'
                           for d, e in zip(dims, expected, strict=True))
        return f'shape {list(value.shape)}, expected [{wanted}]'
    if not (np.isfinite(value) | (meta['may_lack'] & np.isnan(value))).all():
        return 'not finite, expected finite numbers'
    if meta['low'] > -math.inf and value.size and (
            value.min() < meta['low'] or value.max() > meta['high']):
        return (f'{value.min():g} to {value.max():g}, expected '
                f'{meta["low"]:g} to {meta["high"]:g}')
    return ''
