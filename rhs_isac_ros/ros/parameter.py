"""What the declaration of a ROS parameter says, and how a value is checked against it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from rhs_isac_ros.model import plugins


class ParameterError(ValueError):
    """A parameter has a value that its node cannot use."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """Declaration of a parameter.

    Attributes
    ----------
    name
        Its name.
    default
        Value when none is given; its type is the parameter's.
    text
        What it is.
    unit
        Its unit, if it has one.
    low, high
        Range of a number, inclusive.
    choices
        The values that a string may have; empty if any.
    plugins
        Group of entry points whose names are choices too; empty if there is none.
    dynamic
        Whether it may change while the node runs; all others are read at the start.
    """

    name: str
    default: bool | int | float | str | list[float]
    text: str
    unit: str = ''
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    plugins: str = ''
    dynamic: bool = False

    @property
    def kind(self) -> str:
        """Its ROS type."""
        return {bool: 'bool', int: 'integer', float: 'double', str: 'string',
                list: 'double_array'}[type(self.default)]

    @property
    def range(self) -> str:
        """The values it may have within its type; empty if all."""
        if self.choices:
            return ', '.join(self.choices) + (' or a plug-in' if self.plugins else '')
        if self.low is None:
            return ''
        low, high = (format(limit, 'd' if type(self.default) is int else 'g')
                     for limit in (self.low, self.high))
        return f'{low} to {high} {self.unit}'.rstrip()

    @property
    def expected(self) -> str:
        """The values it may have, in words."""
        if self.choices:
            return f'one of {self.range}' + (f' of {self.plugins}' if self.plugins else '')
        words = {'bool': 'true or false', 'integer': 'an integer', 'string': 'a string',
                 'double': 'a number with a decimal point',
                 'double_array': 'a list of numbers, each with a decimal point'}[self.kind]
        return f'{words}, {self.range}' if self.range else words

    def check(self, value: Any) -> None:
        """Refuse a value that it may not have.

        Parameters
        ----------
        value
            The value.

        Raises
        ------
        ParameterError
            If the value has the wrong type, is out of range or none of the choices.
        """
        is_list = isinstance(self.default, list)
        right = isinstance(value, Sequence) and not isinstance(value, str) if is_list else (
            type(value) is type(self.default))
        if right and (is_list or isinstance(self.default, float)):
            # ROS checks no list, and is generous about the ends of a range.
            right = all(isinstance(n, float) and math.isfinite(n) and self.low <= n <= self.high
                        for n in (value if is_list else [value]))
        elif right and self.low is not None:
            right = self.low <= value <= self.high
        if not right or self.choices and not self.plugins and value not in self.choices:
            raise ParameterError(f'{self.name}: {value!r}, expected {self.expected}')
        if self.plugins and value not in self.choices:
            self._check_plugin(value)

    def _check_plugin(self, value: str) -> None:
        """Refuse what is no plug-in either. Only here they are listed: that takes time."""
        there = plugins.names(self.plugins)
        if value not in there:
            raise ParameterError(
                f'{self.name}: {value!r}, expected {self.expected}; '
                f'installed: {", ".join(there) or "none"}')
