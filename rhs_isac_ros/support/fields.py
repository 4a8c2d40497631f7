"""Declarations of values: type, unit and range, with uniform texts about expected values.

Fields of scenarios and messages, settings of roles, ROS parameters and arguments of commands are
declared in this way.
"""

import dataclasses
import math
import operator
import re
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from rhs_isac_ros.support import plugins

# Decimal notation, without the leading zeros, bases, underscores and sexagesimal numbers of YAML.
DECIMAL = re.compile(
    r'[-+]?(?:0|[1-9][0-9]*)(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?|[-+]?\.[0-9]+(?:[eE][-+]?[0-9]+)?')

# Text for a number without a known or assumed value.
UNKNOWN = 'unknown'


def to_number(value: Any, kind: type) -> Any:
    """Convert a real number to int or float, and return any other value unchanged.

    An array with a single number counts as this number, as MATLAB has no other scalars, and so
    does a text in decimal notation for a float.
    """
    is_array = hasattr(value, 'dtype')
    if is_array and (value.dtype.kind not in 'fiu' or value.size != 1 or hasattr(value, 'mask')):
        return value
    if isinstance(value, bool | bytes) or (
            isinstance(value, str) and not (kind is float and DECIMAL.fullmatch(value))):
        return value
    try:
        value = value.item() if is_array else value
        return operator.index(value) if kind is int else float(value)
    except (TypeError, ValueError, OverflowError):
        return value


class ParameterError(ValueError):
    """A ROS parameter has a value that its node cannot use."""


@dataclasses.dataclass(frozen=True)
class Field:
    """Declaration of a value: its type, its unit, and its range or choices."""

    kind: type  #: ``bool``, ``int``, ``float``, ``str``, or ``list`` for a list of floats.
    text: str = ''  #: Description.
    unit: str = ''
    low: float = -math.inf  #: Range of numbers, inclusive.
    high: float = math.inf
    is_open: bool = False  #: Whether `low` itself is invalid.
    choices: tuple[str, ...] = ()  #: Valid strings; if empty, all are valid.
    has_unknown: bool = False  #: Whether infinity, also written 'unknown', is valid for a number.
    plugins: str = ''  #: Entry point group whose names are also valid; empty for none.

    WORDS: ClassVar[Mapping[type, str]] = {
        bool: 'true or false', int: 'an integer', float: 'a number', str: 'a string',
        list: 'a list of numbers'}

    @property
    def range(self) -> str:
        """Valid values as text; empty if the declaration does not limit them."""
        if self.choices:
            return ', '.join(self.choices) + (' or a plug-in' if self.plugins else '')
        # Large integers need all digits.
        low, high = (str(limit) if isinstance(limit, int) else f'{limit:g}'
                     for limit in (self.low, self.high))
        if self.high < math.inf:
            words = f'{low} to {high}'
        elif self.low > -math.inf:
            words = f'above {low}' if self.is_open else f'at least {low}'
        else:
            return ''
        return f'{words} {self.unit}'.rstrip() + self.has_unknown * f' or {UNKNOWN}'

    @property
    def expected(self) -> str:
        """Valid values as text, including the type."""
        if self.choices:
            return f'one of {self.range}' + (f' of {self.plugins}' if self.plugins else '')
        words = self.WORDS[self.kind]
        return f'{words}, {self.range}' if self.range else words

    def checked(self, name: str, value: Any) -> Any:
        """Return a number as the declared type; raise ValueError with `name` if it is invalid."""
        is_unknown = self.has_unknown and isinstance(value, str) and value == UNKNOWN
        value = math.inf if is_unknown else to_number(value, self.kind)
        if problem := self.problem(value):
            raise ValueError(f'{name}: {problem}')
        return value

    def problem(self, value: Any) -> str:
        """Describe an invalid value and what was expected; return '' for a valid value."""
        if not self._has_type(value):
            return f'{value!r}, expected {self.expected}'
        if self.choices:
            return self._choice_problem(value)
        numbers = value if self.kind is list else [value] if self.kind in (int, float) else []
        if all(self.low <= number <= self.high and abs(number) < math.inf
               and not (self.is_open and number == self.low)
               or self.has_unknown and number == math.inf for number in numbers):
            return ''
        return f'{value!r}, expected {self.range or "finite numbers"}'

    def _has_type(self, value: Any) -> bool:
        if self.kind is not list:
            return type(value) is self.kind
        return (isinstance(value, Sequence) and not isinstance(value, str)
                and all(isinstance(number, float) for number in value))

    def _choice_problem(self, value: str) -> str:
        # Listing the installed plug-ins takes time, and is not necessary for built-in choices.
        installed = plugins.names(self.plugins) if value not in self.choices else ()
        if value in (*self.choices, *installed) or self.plugins and plugins.is_reference(value):
            return ''
        listed = f'; installed: {", ".join(installed) or "none"}' if self.plugins else ''
        return f'{value!r}, expected {self.expected}{listed}'


def whole(name: str, value: Any, low: float = 0, high: float = math.inf) -> int:
    """Return an integer in a range; raise ValueError with `name` if it is not one."""
    return Field(int, low=low, high=high).checked(name, value)


def finite(name: str, value: Any, low: float = -math.inf) -> float:
    """Return a finite number, at least `low`, as a float; raise ValueError with `name` if not."""
    # At once, because roles check the time of every event.
    if type(value) is float and low <= value and abs(value) < math.inf:
        return value
    return Field(float, low=low).checked(name, value)
