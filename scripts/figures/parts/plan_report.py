"""The report of errors and bounds over one parameter: table, picture and numbers."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from parts.plan_curves import Curve

from rhs_isac_ros import __version__
from rhs_isac_ros.experiments import markdown_table
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.model.pictures import (
    COLUMN_IN,
    PAGE_IN,
    label_decades,
    look,
    new_panels,
    paper_style,
    write_picture,
)

# Labels and styles of the lines of the bounds, by their mean square.
BOUNDS = {'bound_m2': ('global bound', '--'), 'crlb_m2': ('root of the average CRLB', ':')}
# Standard errors of mean squares that are estimates.
ERRORS = {'mse_m2': 'mse_error_m2', 'bound_m2': 'bound_error_m2'}


def table(entries: Sequence[Mapping[str, Any]]) -> str:
    """Return a table with a row for each point."""
    names = [name for name in ('mse_m2', 'mse_error_m2', 'median_m2', 'crlb_m2', 'bound_m2')
             if name in entries[0]]
    heads = {'mse_m2': 'MSE [m²]', 'mse_error_m2': 'standard error', 'median_m2': 'median [m²]',
             'crlb_m2': 'CRLB [m²]', 'bound_m2': 'bound [m²]'}
    return markdown_table(
        ['plan', 'value', *(heads[name] for name in names)],
        [[entry['line'], f'{entry["value"]:g}', *(f'{entry[name]:.3g}' for name in names)]
         for entry in entries])


@paper_style('drawing the figure')
def picture(curves: Mapping[str, Curve], entries: Sequence[Mapping[str, Any]]) -> Any:
    """Draw a panel for each curve: root mean squared errors and the roots of the bounds.

    Bars are intervals of two standard errors.
    """
    from matplotlib.lines import Line2D
    width_in = COLUMN_IN if len(curves) == 1 else PAGE_IN
    figure, (panels,), above = new_panels(width_in, 3.0, 1, len(curves), sharey=True)
    for axes, (name, curve) in zip(panels, curves.items(), strict=True):
        _draw_curve(axes, curve, [entry for entry in entries if entry['curve'] == name])
    if any(curve.bounds for curve in curves.values()):
        panels[0].set_yscale('log')
        label_decades(panels[0].yaxis)
    else:
        panels[0].set_ylim(0, None)
    panels[0].set_ylabel('root mean squared error [m]')
    handles, labels = panels[0].get_legend_handles_labels()
    for key, (label, style) in BOUNDS.items():
        if key in entries[0]:
            handles.append(Line2D([], [], color='0.3', linestyle=style))
            labels.append(label)
    above.legend(handles, labels, loc='lower center', ncols=2 if len(curves) == 1 else 5,
                 title='bars: intervals of two standard errors')
    return figure


def _draw_curve(axes: Any, curve: Curve, entries: Sequence[Mapping[str, Any]]) -> None:
    lines = list(dict.fromkeys(entry['line'] for entry in entries))
    for index, (line, shift) in enumerate(
            zip(lines, 0.12 * (np.arange(len(lines)) - (len(lines) - 1) / 2), strict=True)):
        part = [entry for entry in entries if entry['line'] == line]
        # Shifted so that the bars do not overlap.
        places, own = np.arange(len(part)) + shift, look(index)
        axes.errorbar(places, *roots(part, 'mse_m2'), color=own.colour, marker=own.marker,
                      label=line)
        for key, (_, style) in BOUNDS.items():
            if key in part[0]:
                axes.errorbar(places + 0.05, *roots(part, key), linestyle=style, color=own.colour,
                              marker=own.marker, markersize=2.5, markerfacecolor='none')
    axes.set(xlabel=curve.label)
    axes.set_xticks(range(len(curve.values)),
                    [f'{value:.4g}'.replace('-', '−') for value in curve.values])
    axes.grid(axis='y')


def roots(
        entries: Sequence[Mapping[str, Any]], key: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Return roots of mean squares, and the distances to the ends of their intervals [2, n].

    Exact mean squares have no interval.
    """
    means = np.array([entry[key] for entry in entries])
    if key not in ERRORS:
        return np.sqrt(means), None
    spreads = np.array([entry[ERRORS[key]] for entry in entries])
    ends = np.sqrt(np.maximum([means - 2 * spreads, means + 2 * spreads], 0))
    middle: np.ndarray = np.sqrt(means)
    return middle, np.abs(ends - middle)


def write(name: str, curves: Mapping[str, Curve], entries: Sequence[Mapping[str, Any]],
          sentences: Sequence[str], output: Path, kind: str) -> None:
    """Print the report, and write it with the figure, of a format, and the numbers."""
    tables = [f'{curve.label}\n\n{table([e for e in entries if e["curve"] == key])}'
              for key, curve in curves.items()]
    report = '\n\n'.join([*tables, *sentences])
    drawn = f'{name}.{kind}'
    write_picture(output / drawn, picture(curves, entries))
    write_whole(output / f'{name}.json', json.dumps(
        {'version': __version__, 'points': entries}, indent=1) + '\n')
    write_whole(output / f'{name}.md', f'# {name}\n\n![{name}]({drawn})\n\n{report}\n')
    print(f'{report}\n\nwritten: {output}/{drawn}, {name}.md and {name}.json')
