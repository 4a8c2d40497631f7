"""The settings of a sweep: the product of values of scenario fields."""

import dataclasses
import difflib
import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import yaml

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.gain_pattern import GainPattern
from rhs_isac_ros.model.scenario import checked

# What can be varied besides the fields of the scenario.
CODEBOOK, ESTIMATOR = 'codebook', 'estimator'
FIELDS = {field.name: field for field in dataclasses.fields(Scenario)}
NAMES = (*FIELDS, CODEBOOK, ESTIMATOR)


class Axis(NamedTuple):
    """Values of a field, or of several fields that vary together.

    Attributes
    ----------
    fields
        Names of the fields; pictures show the first one.
    values
        Values of these fields, a tuple for each step.
    """

    fields: tuple[str, ...]
    values: tuple[tuple[Any, ...], ...]

    def along(self, other: 'Axis') -> 'Axis':
        """Return an axis on which further fields vary together with these.

        Raises
        ------
        ValueError
            If the number of values differs.
        """
        if len(other.values) != len(self.values):
            raise ValueError(
                f'{other.fields[0]}: {len(other.values)} values, expected {len(self.values)} as '
                f'for {self.fields[0]}')
        return Axis(self.fields + other.fields, tuple(
            own + further for own, further in zip(self.values, other.values, strict=True)))

    def distinct(self) -> 'Axis':
        """Return this axis, or raise ValueError if a value of the first field occurs twice."""
        values = [first for first, *_ in self.values]
        for value in values:
            if values.count(value) > 1:
                raise ValueError(f'{self.fields[0]}: {plain(value)} more than once, expected '
                                 'different values')
        return self

    def ordered(self) -> 'Axis':
        """Return the axis in ascending order of the first field if its values are numbers."""
        if all(isinstance(first, int | float) for first, *_ in self.values):
            return Axis(self.fields, tuple(sorted(self.values, key=lambda values: values[0])))
        return self


class Setting(NamedTuple):
    """One combination of values.

    Attributes
    ----------
    varied
        Values of the varied fields by name.
    scenario
        Scenario with these values.
    codebook
        Kind or file of the codebook.
    estimator
        Name of the estimator.
    """

    varied: Mapping[str, Any]
    scenario: Scenario
    codebook: str
    estimator: str


def parse_axis(text: str) -> Axis:
    """Parse ``FIELD=VALUE,...``, with values as in a scenario file.

    Raises
    ------
    ValueError
        If the field is unknown, or a value is invalid.
    """
    name, equals, listed = text.partition('=')
    if name not in NAMES:
        close = difflib.get_close_matches(name, NAMES) or NAMES
        raise ValueError(f'{name}: unknown field, expected one of {", ".join(close)}')
    try:
        values = yaml.safe_load(f'[{listed}]')
    except (ValueError, yaml.YAMLError):
        values = None
    if not equals or not isinstance(values, list) or not values:
        raise ValueError(f'{text!r}, expected FIELD=VALUE,... with values as in a scenario file')
    values = [checked(FIELDS[name], value) if name in FIELDS else str(value) for value in values]
    return Axis((name,), tuple((value,) for value in values))


def settings_of(
        base: Scenario, axes: Sequence[Axis], codebook: str, estimator: str) -> list[Setting]:
    """List all combinations; codebook and estimator are those given unless an axis varies them.

    The last axis varies fastest.

    Raises
    ------
    ScenarioError
        If values contradict each other.
    ValueError
        If a field is on two axes.
    """
    names = [name for axis in axes for name in axis.fields]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'{name}: varied more than once, expected different fields')
    settings = []
    for values in itertools.product(*(axis.ordered().values for axis in axes)):
        varied = dict(zip(names, itertools.chain(*values), strict=True))
        scenario = dataclasses.replace(
            base, **{name: value for name, value in varied.items() if name in FIELDS})
        settings.append(Setting(varied, scenario, varied.get(CODEBOOK, codebook),
                                varied.get(ESTIMATOR, estimator)))
    return settings


def plain(value: Any) -> str:
    """Return a value of a field as text, as scenario files hold it."""
    if isinstance(value, GainPattern | str):
        return str(value)
    return json.dumps(value)
