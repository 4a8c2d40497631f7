"""Declaration of scenario fields, and conversion and checks of their values."""

import dataclasses
import math
import numbers
from typing import Any

import numpy as np

from rhs_isac_ros.model import plugins
from rhs_isac_ros.model.gain_pattern import GainPattern, PatternError
from rhs_isac_ros.model.plugins import PluginError


class ScenarioError(ValueError):
    """A scenario field has a value that the model cannot use."""


def declare(
        default: Any, low: float, high: float, text: str, unit: str = '', source: str = '', *,
        label: str) -> Any:
    """Declare a scenario field.

    `low` and `high` are inclusive; `text` describes the field, and `source` is the publication
    from which its model is taken, if that is not the paper. `label` is the name on an axis, with
    the symbol as mathtext and without the unit.
    """
    meta = {'low': low, 'high': high, 'text': text, 'unit': unit, 'source': source,
            'label': label}
    return dataclasses.field(default=default, metadata=meta)


def checked(field: dataclasses.Field[Any], value: Any) -> Any:
    """Convert a field's value to its declared type.

    Raises
    ------
    ScenarioError
        If the type is wrong or the value is out of range.
    """
    name = field.name
    if name == 'feed_positions_m':
        return None if value is None else _vectors(field, value)
    if name in ('element_gain', 'user_gain'):
        return _gain(field, value)
    if name == 'impairments':
        return _strengths(field, value)
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


def _strengths(field: dataclasses.Field[Any], value: Any) -> tuple[tuple[str, float], ...]:
    try:
        pairs = sorted(dict(value).items())
    except (TypeError, ValueError):
        raise ScenarioError(
            f'{field.name}: {value!r}, expected a mapping of names to strengths') from None
    for name, _ in pairs:
        try:
            plugins.load(plugins.IMPAIRMENTS, name)
        except PluginError as error:
            raise ScenarioError(f'{field.name}: {error}') from None
    # No strength, no impairment.
    checked_pairs = ((name, _number(field, strength)) for name, strength in pairs)
    return tuple(pair for pair in checked_pairs if pair[1])


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
