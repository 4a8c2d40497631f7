"""Picture of the demonstration: the cycles from above, and their errors in order."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.model.pictures import (
    PAGE_IN,
    label_decades,
    look,
    new_figure,
    paper_style,
    write_picture,
)
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.tools.ellipses import ellipse_95, limits_with_ellipses

# Height of the errors and of all that surrounds the panels [in], and the share of the width that
# the view from above has.
_ERRORS_IN, _REST_IN, _VIEW_SHARE = 1.4, 1.9, 0.94
# Space around the region and the surface [m]; ellipses may need more, up to a share of the region.
_MARGIN_M, _MAX_MARGIN = 0.8, 0.4
# Maximum numbers of cycles with a number in the view, and of users in the legend.
_MAX_NUMBERS, _MAX_LABELS = 60, 6


def prepare_drawing() -> None:
    """Import what `draw` needs, while there is nothing else to do."""
    # Not at the start of the program, which has more urgent imports.
    from matplotlib import figure, patches, style
    from matplotlib.backends import backend_agg

    del figure, patches, style, backend_agg


def draw(cycles: Sequence[CompleteCycle], scenario: Scenario, path: Path) -> None:
    """Draw at least one cycle, in the format that the suffix of `path` names.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_picture(path, compose(cycles, scenario))


@paper_style()
def compose(cycles: Sequence[CompleteCycle], scenario: Scenario) -> Any:
    """Return the `matplotlib.figure.Figure` of at least one cycle."""
    low, high = _limits_m(cycles, scenario)
    # So that the view with its equal scales fills the width.
    view_in = PAGE_IN * _VIEW_SHARE * (high[1] - low[1]) / (high[0] - low[0])
    figure = new_figure(PAGE_IN, view_in + _ERRORS_IN + _REST_IN)
    # The first row has the height of the legend, which the layout adds.
    above, view, errors = figure.subplots(
        3, 1, height_ratios=(0.001, view_in, _ERRORS_IN))
    above.axis('off')
    _draw_scenario(view, scenario)
    users = sorted({cycle.user for cycle in cycles})
    for user in users:
        own = [cycle for cycle in cycles if cycle.user == user]
        _draw_positions(view, user, own)
        _draw_errors(errors, user, own)
    for cycle in cycles[::math.ceil(len(cycles) / _MAX_NUMBERS)]:
        _number(view, cycle)
    view.set(xlabel='$x$ [m]', ylabel='$y$ [m]', aspect='equal', xlim=(low[0], high[0]),
             ylim=(low[1], high[1]), title=f'(a) {len(cycles)} cycles from above')
    errors.set(xlabel='cycle', ylabel='[m]', yscale='log',
               title='(b) position error and its bound, in the order of the cycles')
    errors.xaxis.get_major_locator().set_params(integer=True)
    label_decades(errors.yaxis)
    errors.grid()
    above.legend(handles=_legend(users), loc='lower center', ncols=4)
    return figure


def _limits_m(cycles: Sequence[CompleteCycle], scenario: Scenario) -> np.ndarray:
    """Return the corners of the view from above, float64 [2, 2] [m]."""
    region = scenario.roi_bounds_m[:, :2]
    surface = element_positions(scenario)[:, :2]
    limits = np.stack([np.minimum(region[0], surface.min(axis=0)) - _MARGIN_M,
                       np.maximum(region[1], surface.max(axis=0)) + _MARGIN_M])
    margin = _MAX_MARGIN * (region[1] - region[0])
    return limits_with_ellipses(
        limits, region + np.stack([-margin, margin]),
        [cycle.estimate.position[:2] for cycle in cycles],
        [cycle.estimate.covariance_m2[:2, :2] for cycle in cycles])


def _draw_scenario(view: Any, scenario: Scenario) -> None:
    from matplotlib.patches import Rectangle

    low, high = scenario.roi_bounds_m[:, :2]
    view.add_patch(Rectangle(low, *(high - low), facecolor='0.96', edgecolor='0.4',
                             linestyle='--', zorder=0))
    y = element_positions(scenario)[:, 1]
    view.plot([0, 0], [y.min(), y.max()], linewidth=4, color='black', solid_capstyle='butt')
    view.annotate('surface', (0, y.max()), xytext=(0, 4),
                  textcoords='offset points', ha='center')


def _draw_positions(view: Any, user: int, cycles: Sequence[CompleteCycle]) -> None:
    from matplotlib.patches import Ellipse

    own = look(user - 1)
    truth = np.array([cycle.truth.position for cycle in cycles])
    mean = np.array([cycle.estimate.position for cycle in cycles])
    view.plot(truth[:, 0], truth[:, 1], color=own.colour, linewidth=0.7, linestyle=':', zorder=2)
    view.plot([truth[:, 0], mean[:, 0]], [truth[:, 1], mean[:, 1]], color=own.colour,
              linewidth=0.7, zorder=3)
    view.plot(truth[:, 0], truth[:, 1], own.marker, color=own.colour, zorder=4)
    view.plot(mean[:, 0], mean[:, 1], 'x', color=own.colour, zorder=4)
    for cycle in cycles:
        width, height, angle = ellipse_95(cycle.estimate.covariance_m2[:2, :2])
        view.add_patch(Ellipse(tuple(cycle.estimate.position[:2]), width, height, angle=angle,
                               fill=False, color=own.colour, alpha=0.4, zorder=1))


def _number(view: Any, cycle: CompleteCycle) -> None:
    """Write the number of a cycle beside the true position, on the side without estimate."""
    from matplotlib.patheffects import withStroke

    right = cycle.estimate.position[0] < cycle.truth.position[0]
    view.annotate(
        str(cycle.cycle_id), tuple(cycle.truth.position[:2]), xytext=(4 if right else -4, 0),
        textcoords='offset points', ha='left' if right else 'right', va='center',
        fontsize=7, zorder=5, path_effects=[withStroke(linewidth=1.5, foreground='white')])


def _draw_errors(axes: Any, user: int, cycles: Sequence[CompleteCycle]) -> None:
    own, numbers = look(user - 1), [cycle.cycle_id for cycle in cycles]
    axes.plot(numbers, [cycle.error_m for cycle in cycles], own.marker, color=own.colour,
              linestyle=own.line)
    axes.plot(numbers, [math.sqrt(cycle.estimate.crlb_m2) for cycle in cycles], '_',
              color=own.colour, markersize=7, markeredgewidth=1.2)


def _legend(users: Sequence[int]) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def mark(label: str, **style: Any) -> Line2D:
        return Line2D([], [], **{'linestyle': '', 'color': '0.3', 'label': label, **style})
    handles: list[Any] = [
        Patch(facecolor='0.96', edgecolor='0.4', linestyle='--', label='region of interest'),
        mark('true position, with its cycle', marker=look(0).marker),
        mark('order of the cycles', linestyle=':', linewidth=0.7),
        mark('estimate', marker='x'),
        Patch(fill=False, edgecolor='0.6', label='95 % of the posterior'),
        mark('position error', marker=look(0).marker, linestyle='-'),
        mark('√CRLB', marker='_', markersize=7, markeredgewidth=1.2)]
    for user in users[:_MAX_LABELS]:
        own = look(user - 1)
        handles.append(mark(f'user {user}', marker=own.marker, color=own.colour,
                            linestyle=own.line))
    if len(users) > _MAX_LABELS:
        handles.append(mark(f'and {len(users) - _MAX_LABELS} more users'))
    return handles
