"""The picture of a sweep: panels of measures, with an interval at each point."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.experiments.sweep import Point
from rhs_isac_ros.experiments.sweep_settings import FIELDS, MEASURES, Axis, plain
from rhs_isac_ros.model.board import Board
from rhs_isac_ros.model.external import External
from rhs_isac_ros.support import pictures

# Heights of a row of panels, of the legend, and of an additional line of labels.
_PANEL_IN, _LEGEND_IN, _LINE_IN = 2.2, 0.4, 0.13
# Largest ratio of positive values on a linear scale, and units to which this limit applies. Values
# in other units always have a linear scale.
_WIDE = 8.0
_LOGARITHMIC = ('m', 'm²')
# Below this ratio of largest to smallest value, a logarithmic axis has labels within decades.
_FEW_DECADES = 200
# Horizontal offset between lines, relative to the range of x, which keeps intervals apart.
_SHIFT = 0.01
# With more numbers than this on the x axis, the ticks are not placed at these numbers.
_MAX_TICKS = 8


class _Line(NamedTuple):
    """A line of a panel: its points and its style."""

    points: Sequence[Point]
    label: str
    look: pictures.Look
    fill: str
    shift: float


@pictures.paper_style('drawing the sweep')
def draw(axes: Sequence[Axis], points: Sequence[Point],
         panels: Sequence[Sequence[str]]) -> Any:
    """Draw points, and return the `matplotlib.figure.Figure`.

    The first axis is the x axis of the panels. The second has one line per value, and each
    combination of the others' values has a row of panels. `panels` lists the measures per column.
    """
    first, *others = [axis.ordered() for axis in axes]
    lines, rows = others[:1], others[1:]
    combinations = list(dict.fromkeys(_key(point, rows) for point in points))
    joined = [names for names in panels if len(names) > 1]
    n_lines = max(_text(first, values[0]).count(', ') for values in first.values)
    figure, grid, above = pictures.new_panels(
        pictures.COLUMN_IN if len(panels) == 1 else pictures.PAGE_IN * max(len(panels) / 3, 1),
        _PANEL_IN * len(combinations) + _LEGEND_IN * bool(lines or joined) + _LINE_IN * n_lines,
        len(combinations), len(panels), sharex=True)
    for panel, top in zip(grid[1:].flat, np.tile(grid[0], len(combinations) - 1), strict=True):
        panel.sharey(top)
    for row, combination in zip(grid, combinations, strict=True):
        inside = [point for point in points if _key(point, rows) == combination]
        for panel, names in zip(row, panels, strict=True):
            draw_panel(panel, first, lines, inside, names)
            if rows:
                panel.set_title(', '.join(
                    f'{_label(axis)}: {_text(axis, value)}'
                    for axis, value in zip(rows, combination, strict=True)))
    for panel in grid[:-1].flat:
        panel.set_xlabel('')
    if lines or joined:
        add_legend(above, grid[0], lines, joined)
    return figure


def draw_panel(panel: Any, first: Axis, others: Sequence[Axis], points: Sequence[Point],
               names: Sequence[str]) -> None:
    """Draw measures of one unit against the first axis; values of `others` have separate lines."""
    values = [entry[0] for entry in first.values]
    numeric = all(isinstance(value, int | float) for value in values)
    places = np.array(values if numeric else range(len(values)), float)
    if numeric:
        _set_scale(panel, values)
    results = [point.interval.value for point in points if point.measure in names]
    finite = [value for value in results if np.isfinite(value)]
    factor, unit = _scale(MEASURES[names[0]].unit, finite)
    logarithmic = unit in _LOGARITHMIC and finite and 0 < min(finite) * _WIDE < max(finite)
    if logarithmic:
        panel.set_yscale('log')
    for line in _lines(others, points, names):
        # Infinite values and NaN cannot be drawn.
        own = [point for point in line.points if np.isfinite(point.interval.value)]
        ranks = [values.index(point.setting.varied[first.fields[0]]) for point in own]
        _draw_line(panel, _shifted(panel, places, line.shift)[ranks], factor
                   * np.array([point.interval for point in own]).reshape(-1, 3), line)
    if logarithmic and max(finite) < _FEW_DECADES * min(finite):
        pictures.label_decades(panel.yaxis)
    if not numeric or len(values) <= _MAX_TICKS:
        # Lists of numbers would not fit side by side.
        panel.set_xticks(places, [_text(first, value).replace(', ', '\n') for value in values])
        panel.set_xticks([], minor=True)
    label = MEASURES[names[0]].label if len(names) == 1 else 'error or bound'
    panel.set(xlabel=_label(first), ylabel=f'{label} [{unit}]')
    panel.grid(True)


def add_legend(place: Any, panels: Sequence[Any], lines: Sequence[Axis],
               joined: Sequence[Sequence[str]] = ()) -> None:
    """Draw one legend for all panels, which have the same lines, in the Matplotlib axes `place`.

    `lines` contains the axes of the sweep whose values the lines distinguish. `joined` lists the
    measures of each panel with several measures.
    """
    found: dict[str, Any] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    if lines:
        for names in joined:
            found |= _styles(names)
    title = ''.join(f'{_label(axis)}; ' for axis in lines)
    wide = place.figure.get_figwidth() > pictures.COLUMN_IN
    place.legend(found.values(), found, loc='lower center', ncols=4 if wide else 2,
                 title=f'{title}bars: 95 % intervals')


def shown(name: str, value: Any) -> str:
    """Return a value of a field as a short text for a legend or an axis."""
    if isinstance(value, External):
        return Path(value.origin).name or value.digest
    if name == 'center_frequencies_hz':
        return ', '.join(f'{entry / 1e9:.4g}' for entry in value) + ' GHz'
    if isinstance(value, float | int):
        return f'{value:g}'
    if isinstance(value, Board):
        return plain(value)
    return plain(value).rpartition('/')[2].removesuffix('.yaml')


def _text(axis: Axis, value: Any) -> str:
    text = shown(axis.fields[0], value)
    return text.replace('-', '−') if isinstance(value, float | int) else text


def is_geometric(values: Sequence[float]) -> bool:
    """Return whether three or more positive values have more even ratios than differences."""
    if len(values) < 3 or min(values) <= 0:
        return False
    steps, ratios = np.diff(values), np.diff(np.log(values))
    spread, spread_of_ratios = (float(parts.std() / parts.mean()) for parts in (steps, ratios))
    return spread_of_ratios < spread


def _set_scale(panel: Any, values: Sequence[float]) -> None:
    """Make the x axis logarithmic if its values, without a leading 0, satisfy `is_geometric`."""
    if is_geometric(values):
        panel.set_xscale('log')
    elif values[0] == 0 and is_geometric(values[1:]):
        panel.set_xscale('symlog', linthresh=values[1], linscale=0.3)


def _scale(unit: str, values: Sequence[float]) -> tuple[float, str]:
    """Return a factor for the values of a panel, and the unit of the scaled values."""
    largest = max(map(abs, values), default=0)
    for size, prefix in ((1e6, 'M'), (1e3, 'k')):
        if unit == 'bit/s' and largest >= size:
            return 1 / size, prefix + unit
    return 1.0, unit


def _lines(others: Sequence[Axis], points: Sequence[Point], names: Sequence[str]) -> list[_Line]:
    """Return the lines of a panel, one for each measure and combination of values of `others`.

    Values differ in colour and marker, and measures in line style. Only the first measure has
    filled markers. If there is one measure, values also differ in line style. Without `others`,
    measures also differ in colour and marker.
    """
    keys = list(dict.fromkeys(_key(point, others) for point in points))
    lines = []
    for rank, key in enumerate(keys):
        for number, name in enumerate(names):
            own = [point for point in points
                   if _key(point, others) == key and point.measure == name]
            style = pictures.look(rank if others else number)
            if len(names) > 1:
                style = style._replace(line=pictures.LOOKS[number].line)
            label = ', '.join(map(_text, others, key)) if others else MEASURES[name].label
            place = rank * len(names) + number - (len(keys) * len(names) - 1) / 2
            lines.append(_Line(own, label, style, 'white' if number else style.colour,
                               _SHIFT * place))
    return lines


def _shifted(panel: Any, places: np.ndarray, shift: float) -> np.ndarray:
    """Shift x values by a fraction of the range that they span on the axis of a panel."""
    scale = panel.xaxis.get_transform()
    drawn = scale.transform(places)
    return scale.inverted().transform(drawn + shift * np.ptp(drawn))


def _draw_line(panel: Any, x: np.ndarray, intervals: np.ndarray, line: _Line) -> None:
    value, low, high = intervals.T
    sides = np.nan_to_num(np.maximum([value - low, high - value], 0), posinf=0.0)
    bars = panel.errorbar(
        x, value, sides, color=line.look.colour, linestyle=line.look.line, marker=line.look.marker,
        markerfacecolor=line.fill, label=line.label)
    for bar in bars.lines[2]:
        bar.set_linewidth(0.8)
    # An interval with an infinite upper end becomes an arrow to the edge of the panel.
    for place in np.flatnonzero(np.isposinf(high)):
        panel.annotate('', (x[place], 1), (x[place], value[place]),
                       xycoords=panel.get_xaxis_transform(), textcoords='data',
                       arrowprops={'arrowstyle': '->', 'color': line.look.colour,
                                   'linewidth': 0.8, 'shrinkA': 0, 'shrinkB': 0})


def _styles(names: Sequence[str]) -> dict[str, Any]:
    """Return legend handles for the measures of a panel, keyed by label."""
    from matplotlib.lines import Line2D
    handles = {}
    for number, name in enumerate(names):
        style: Any = pictures.LOOKS[number].line
        handles[MEASURES[name].label] = Line2D(
            [], [], color='0.4', linestyle=style, marker='o',
            markerfacecolor='white' if number else '0.4')
    return handles


def _key(point: Point, axes: Sequence[Axis]) -> tuple[Any, ...]:
    return tuple(point.setting.varied[axis.fields[0]] for axis in axes)


def _label(axis: Axis) -> str:
    """Return the label of an axis, with the unit of its field unless the values contain it."""
    name = axis.fields[0]
    if name not in FIELDS:
        return name
    label, unit = FIELDS[name].metadata['label'], FIELDS[name].metadata['declared'].unit
    return f'{label} [{unit}]' if unit and name != 'center_frequencies_hz' else str(label)
