"""The declaration of a ROS parameter and the check of its values."""

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
    default
        Value when none is given; its type is the type of the parameter.
    text
        Description, one sentence.
    low, high
        Range of a number, inclusive.
    choices
        Valid strings; empty: any.
    plugins
        Entry point group whose names are valid too; empty: none.
    dynamic
        Whether the parameter may change while the node runs; all others are read at the start.
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
        """ROS type of the parameter."""
        return {bool: 'bool', int: 'integer', float: 'double', str: 'string',
                list: 'double_array'}[type(self.default)]

    @property
    def range(self) -> str:
        """Valid values as text; empty if every value of the type is valid."""
        if self.choices:
            return ', '.join(self.choices) + (' or a plug-in' if self.plugins else '')
        if self.low is None:
            return ''
        low, high = (format(limit, 'd' if type(self.default) is int else 'g')
                     for limit in (self.low, self.high))
        return f'{low} to {high} {self.unit}'.rstrip()

    @property
    def expected(self) -> str:
        """Valid values as text, including the type."""
        if self.choices:
            return f'one of {self.range}' + (f' of {self.plugins}' if self.plugins else '')
        words = {'bool': 'true or false', 'integer': 'an integer', 'string': 'a string',
                 'double': 'a number with a decimal point',
                 'double_array': 'a list of numbers, each with a decimal point'}[self.kind]
        return f'{words}, {self.range}' if self.range else words

    def check(self, value: Any) -> None:
        """Check a value against the declaration.

        Raises
        ------
        ParameterError
            If the value has the wrong type, is out of range or is not one of the choices.
        """
        if not self._has_type(value) or not self._is_in_range(value):
            raise ParameterError(f'{self.name}: {value!r}, expected {self.expected}')
        if self.choices and value not in self.choices:
            if not self.plugins:
                raise ParameterError(f'{self.name}: {value!r}, expected {self.expected}')
            self._check_plugin(value)

    def _has_type(self, value: Any) -> bool:
        if not isinstance(self.default, list):
            return type(value) is type(self.default)
        return (isinstance(value, Sequence) and not isinstance(value, str)
                and all(isinstance(number, float) for number in value))

    def _is_in_range(self, value: Any) -> bool:
        # ROS does not check lists and tolerates small deviations at the ends of a range.
        numbers = value if isinstance(self.default, list) else [value]
        if self.low is None or self.high is None:
            return True
        return all(math.isfinite(number) and self.low <= number <= self.high
                   for number in numbers)

    def _check_plugin(self, value: str) -> None:
        # Listing the installed plug-ins takes time; the built-in choices do not need it.
        installed = plugins.names(self.plugins)
        if value not in installed:
            raise ParameterError(
                f'{self.name}: {value!r}, expected {self.expected}; '
                f'installed: {", ".join(installed) or "none"}')
