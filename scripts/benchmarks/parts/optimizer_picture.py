"""The picture of the benchmark of the optimiser."""

from typing import Any

import numpy as np
from parts.optimizer_growth import GROWTH

from rhs_isac_ros.support.pictures import (
    PAGE_IN,
    label_decades,
    look,
    new_figure,
    paper_style,
)


@paper_style('--picture')
def draw(figures: dict) -> Any:
    """Draw the results of the parts (a) to (c) that were run."""
    parts = [(name, draw_part) for name, draw_part in (
        ('gradient_ms', draw_gradient), ('target', draw_target), ('growth', draw_growth))
        if name in figures]
    figure = new_figure(PAGE_IN, 2.4)
    for axes, (name, draw_part) in zip(
            figure.subplots(1, len(parts) or 1, squeeze=False)[0], parts, strict=False):
        draw_part(axes, figures[name])
    return figure


def draw_gradient(axes: Any, times_ms: dict) -> None:
    """Draw the times of value and gradient."""
    from matplotlib.colors import to_rgb

    own = look(0)
    axes.barh(list(times_ms), list(times_ms.values()), edgecolor=own.colour,
              facecolor=0.6 + 0.4 * np.array(to_rgb(own.colour)))
    axes.invert_yaxis()
    axes.set(title='(a) value and gradient', xlabel='time [ms]', xlim=(0, None))


def draw_target(axes: Any, rows: dict) -> None:
    """Draw the times to the target of the contenders that reach it."""
    names = [name for name, row in rows.items() if row['target_s']]
    own = look(0)
    # No bars, which have no beginning on a logarithmic axis.
    axes.plot([rows[name]['target_s'] for name in names], names, own.marker, color=own.colour)
    axes.grid(axis='y')
    axes.margins(y=0.2)
    axes.invert_yaxis()
    axes.set(title='(b) time to the target', xlabel='time [s]', xscale='log')
    if names:
        label_decades(axes.xaxis)


def draw_growth(axes: Any, growth: dict) -> None:
    """Draw the time of an evaluation over the sizes."""
    for index, (symbol, values) in enumerate(GROWTH.items()):
        own = look(index)
        times = [growth[f'{symbol} = {n}']['evaluation_ms'] for n in values]
        name, _, subscript = symbol.partition('_')
        axes.loglog(np.array(values) / values[0], times, color=own.colour, marker=own.marker,
                    linestyle=own.line,
                    label=rf'${name}_\mathrm{{{subscript}}}$' if subscript else f'${name}$')
    axes.set(title='(c) growth of an evaluation', xlabel='size, relative to the smallest',
             ylabel='time [ms]')
    label_decades(axes.xaxis)
    label_decades(axes.yaxis)
    axes.legend()
