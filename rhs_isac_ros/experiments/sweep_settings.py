"""The settings of a sweep, and its measures: statistics over positions, with their intervals."""

import dataclasses
import difflib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.experiments.resampling import Interval, replicate, share_percent
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.scenario import as_plain, checked
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.files import parse_yaml
from rhs_isac_ros.support.threads import one_blas_thread

# Finite substitute for infinity, larger than any finite result.
_INFINITE = 1e300


class Measure(NamedTuple):
    """A statistic of one quantity over the positions."""

    quantity: str
    label: str  #: Axis label without the unit.
    unit: str
    quantile: float | None = None  #: From 0 to 1; None for the mean.
    root: bool = False  #: Whether to take the square root of the statistic.
    share: bool = False  #: Whether the quantity is 0 or 1, and the measure is the share of 1 [%].


MEASURES: Mapping[str, Measure] = {
    'crlb': Measure('crlb_m2', 'average CRLB', 'm²'),
    'crlb_median': Measure('crlb_m2', 'median CRLB', 'm²', 0.5),
    'crlb_p95': Measure('crlb_m2', 'CRLB, 95th percentile', 'm²', 0.95),
    'root_crlb': Measure('crlb_m2', 'root of the average CRLB', 'm', root=True),
    'global_bound': Measure('bound_m2', 'global bound', 'm²'),
    'root_global_bound': Measure('bound_m2', 'root of the global bound', 'm', root=True),
    'mse': Measure('squared_error_m2', 'mean squared error', 'm²'),
    'rmse': Measure('squared_error_m2', 'root mean squared error', 'm', root=True),
    'error_median': Measure('squared_error_m2', 'median error', 'm', 0.5, root=True),
    'error_p95': Measure('squared_error_m2', 'error, 95th percentile', 'm', 0.95, root=True),
    'coverage': Measure('inside', 'coverage of the 95 % region', '%', share=True),
    'fixes': Measure('fix', 'positions with a fix', '%', share=True),
    'capacity': Measure('capacity_bps', 'capacity', 'bit/s'),
    'capacity_perfect': Measure('perfect_bps', 'capacity, position known', 'bit/s'),
    'capacity_loss': Measure('loss_bps', 'capacity loss', 'bit/s'),
    'capacity_loss_median': Measure('loss_bps', 'median capacity loss', 'bit/s', 0.5),
    'capacity_loss_p95': Measure('loss_bps', 'capacity loss, 95th percentile', 'bit/s', 0.95),
}


@one_blas_thread
def measured(measure: Measure, results: np.ndarray) -> Interval:
    """Return a measure of results, float64 [codebooks, positions], with its interval.

    The interval comes from a bootstrap over codebooks and positions. A share has Wilson's interval
    if there is one codebook, or if all results are equal: the bootstrap interval would then have
    no width. A NaN result makes value and ends NaN; an infinite mean makes only the ends NaN.
    """
    if np.isnan(results).any():
        return Interval(np.nan, np.nan, np.nan)
    if measure.share and (len(results) == 1 or np.ptp(results) == 0):
        # Codebooks share their positions and therefore do not count as additional samples.
        return share_percent(int(results[0].sum()), len(results[0]))
    if measure.quantile is None and np.isinf(results).any():
        return Interval(np.inf, np.nan, np.nan)
    finite = np.minimum(results, _INFINITE)
    (replicates,) = replicate(finite, 0, () if measure.quantile is None else [measure.quantile])
    ends = np.array(replicates.interval())
    if measure.quantile is None:
        # The replicates have single precision, which has fewer digits than the table.
        ends[0] = results.mean()
    ends = np.where(ends > _INFINITE / 2, np.inf, ends)
    if measure.root:
        ends = np.sqrt(np.maximum(ends, 0.0))
    if measure.share:
        ends = 100 * np.clip(ends, 0.0, 1.0)
    return Interval(*ends.tolist())


def parse_measures(text: str) -> list[list[str]]:
    """Parse ``NAME,...``, where ``+`` joins measures of one unit that share a panel.

    Raises ValueError if a measure is unknown or repeated, or units in a panel differ.
    """
    panels = [panel.split('+') for panel in text.split(',')]
    names = names_of(panels)
    for name in names:
        if name not in MEASURES:
            raise ValueError(f'{name!r}, expected one of {", ".join(MEASURES)}')
        if names.count(name) > 1:
            raise ValueError(f'{name} more than once, expected different measures')
    for panel in panels:
        for name in panel:
            if MEASURES[name].unit != MEASURES[panel[0]].unit:
                raise ValueError(
                    f'{name} [{MEASURES[name].unit}] joined to {panel[0]}, expected a measure in '
                    f'{MEASURES[panel[0]].unit}')
    return panels


def names_of(panels: Iterable[Iterable[str]]) -> list[str]:
    """Return the names of the measures of all panels."""
    return [name for panel in panels for name in panel]


# Names that can be varied like fields of the scenario.
CODEBOOK, ESTIMATOR = 'codebook', 'estimator'
FIELDS = {field.name: field for field in dataclasses.fields(Scenario)}
NAMES = (*FIELDS, CODEBOOK, ESTIMATOR)


class Axis(NamedTuple):
    """Values of a field, or of several fields that vary together, as one tuple per step.

    Pictures are labelled with the first field.
    """

    fields: tuple[str, ...]
    values: tuple[tuple[Any, ...], ...]

    def along(self, other: 'Axis') -> 'Axis':
        """Return an axis that also varies the fields of another axis of the same length."""
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
        """Return the axis, in ascending order if the values of its first field are numbers."""
        if all(isinstance(first, int | float) for first, *_ in self.values):
            return Axis(self.fields, tuple(sorted(self.values, key=lambda values: values[0])))
        return self


class Setting(NamedTuple):
    """One combination of values, and the scenario with these values.

    `varied` contains the values by name; `codebook` is a kind of codebook, or a file.
    """

    varied: Mapping[str, Any]
    scenario: Scenario
    codebook: str
    estimator: str


def parse_axis(text: str) -> Axis:
    """Parse ``FIELD=VALUE,...``, with values as in a scenario file, or raise ValueError."""
    name, equals, listed = text.partition('=')
    _known(name)
    try:
        values = parse_yaml(f'[{listed}]')
    except ValueError:
        values = None
    if not equals or not isinstance(values, list) or not values:
        raise ValueError(f'{text!r}, expected FIELD=VALUE,... with values as in a scenario file')
    values = [checked(FIELDS[name], value) if name in FIELDS else str(value) for value in values]
    return Axis((name,), tuple((value,) for value in values))


def _known(name: str) -> str:
    """Return the name of a field, or raise ValueError."""
    if name not in NAMES:
        close = difflib.get_close_matches(name, NAMES) or NAMES
        raise ValueError(f'{name}: unknown field, expected one of {", ".join(close)}')
    return name


def settings_of(
        base: Scenario, axes: Sequence[Axis], codebook: str, estimator: Any) -> list[Setting]:
    """List all combinations; the last axis varies fastest.

    `codebook` and `estimator`, a name or a class, apply unless an axis varies them. Raises
    ValueError if a field is unknown or varied twice, or values contradict each other.
    """
    names = [_known(name) for axis in axes for name in axis.fields]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'{name}: varied more than once, expected different fields')
    settings = []
    for values in itertools.product(*(axis.ordered().values for axis in axes)):
        varied = dict(zip(names, itertools.chain(*values), strict=True))
        scenario = dataclasses.replace(
            base, **{name: value for name, value in varied.items() if name in FIELDS})
        settings.append(Setting(varied, scenario, varied.get(CODEBOOK, codebook),
                                plugins.name_of(varied.get(ESTIMATOR, estimator))))
    return settings


def plain(value: Any) -> str:
    """Return the value of a field as text in the syntax of scenario files."""
    value = as_plain(value)
    return value if isinstance(value, str) else json.dumps(value)
