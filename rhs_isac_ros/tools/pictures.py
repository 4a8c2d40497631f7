"""Pictures of a network: its cycles for ``demo``, its scene for ``snapshot``."""

import itertools
import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from rhs_isac_ros.link import BeamPattern
from rhs_isac_ros.model import Scenario, geometry
from rhs_isac_ros.monitoring import shapes
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.monitoring.network_state import SceneState, SceneUser
from rhs_isac_ros.monitoring.shapes import MIN_LEVEL_DB
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.support.pictures import PAGE_IN, label_decades, look, new_figure, paper_style
from rhs_isac_ros.support.texts import counted

# Height of the panel of errors, and of everything around the panels [in]; share of the width for
# the view from above.
_ERRORS_IN, _REST_IN, _VIEW_SHARE = 1.4, 1.9, 0.94
_SCENE_IN = 5.7
# Margin around region and surface [m]; maximum margin for ellipses, as a share of the region.
_MARGIN_M, _CYCLES_MAX_MARGIN, _SCENE_MAX_MARGIN = 0.8, 0.4, 0.25
# Relative height of the axes for the legend; the layout adds the height of the legend itself. A
# legend without axes would get no space from the layout before Matplotlib 3.7.
_LEGEND_ROW = 0.001
# Maximum number of cycles with a number in the view, and of users in each legend.
_MAX_NUMBERS, _CYCLES_MAX_LABELS, _SCENE_MAX_LABELS = 60, 6, 8
# Line width of the surface, which is too small to be visible to scale.
_SURFACE_WIDTH_POINTS = 5
_PATTERN_STEP_DEG = 1.0
_REGION: dict[str, Any] = {'facecolor': '0.95', 'edgecolor': '0.4', 'linestyle': '--'}


@paper_style()
def compose_cycles(cycles: Sequence[CompleteCycle], scenario: Scenario) -> Any:
    """Return a `matplotlib.figure.Figure` of one or more cycles."""
    low, high = _limits_m(scenario, [cycle.estimate for cycle in cycles], _CYCLES_MAX_MARGIN)
    # With this height and equal scales, the view fills the width.
    view_in = PAGE_IN * _VIEW_SHARE * (high[1] - low[1]) / (high[0] - low[0])
    figure = new_figure(PAGE_IN, view_in + _ERRORS_IN + _REST_IN)
    above, view, errors = figure.subplots(
        3, 1, height_ratios=(_LEGEND_ROW, view_in, _ERRORS_IN))
    above.axis('off')
    _draw_room(view, [0, 1], scenario)
    users = sorted({cycle.user for cycle in cycles})
    for user in users:
        own = [cycle for cycle in cycles if cycle.user == user]
        _draw_positions(view, user, own)
        _draw_errors(errors, user, own)
    for cycle in cycles[::math.ceil(len(cycles) / _MAX_NUMBERS)]:
        _number(view, cycle)
    view.set(aspect='equal', xlim=(low[0], high[0]), ylim=(low[1], high[1]),
             title=f'(a) {len(cycles)} cycles from above')
    errors.set(xlabel='cycle', ylabel='[m]', yscale='log',
               title='(b) position error and its bound, in the order of the cycles')
    errors.xaxis.get_major_locator().set_params(integer=True)
    label_decades(errors.yaxis)
    errors.grid()
    above.legend(loc='lower center', ncols=4, handles=[
        _patch('region of interest', **_REGION),
        _mark('true position, with its cycle', marker=look(0).marker),
        _mark('order of the cycles', linestyle=':', linewidth=0.7),
        _mark('estimate', marker='x'),
        _patch('95 % of the posterior', fill=False, edgecolor='0.6'),
        _mark('position error', marker=look(0).marker, linestyle='-'),
        _mark('√CRLB', marker='_', markersize=7, markeredgewidth=1.2),
        *(_mark(f'user {user}', marker=look(user - 1).marker, color=look(user - 1).colour,
                linestyle=look(user - 1).line) for user in users[:_CYCLES_MAX_LABELS]),
        *_further(users, _CYCLES_MAX_LABELS)])
    return figure


@paper_style()
def compose_scene(scene: SceneState, scenario: Scenario) -> Any:
    """Return a `matplotlib.figure.Figure` of a scene, parts of which may be unknown."""
    figure = new_figure(PAGE_IN, _SCENE_IN)
    limits_m = _limits_m(scenario, [user.estimate for user in scene.users.values()
                                    if user.estimate], _SCENE_MAX_MARGIN)
    # Both views have the same scale, so that their x axes are aligned.
    heights = np.diff(limits_m, axis=0)[0, 1:]
    grid = figure.add_gridspec(3, 2, width_ratios=(1.75, 1),
                               height_ratios=[*heights, _LEGEND_ROW * heights.sum()])
    beam = scene.shown_beam
    pattern = shapes.pattern(scenario, beam, _PATTERN_STEP_DEG) if beam else None
    for row, plane, title in ((0, [0, 1], 'from above'), (1, [0, 2], 'from the side')):
        axes = figure.add_subplot(grid[row, 0])
        _draw_room(axes, plane, scenario)
        if beam and pattern:
            _draw_lobe(axes, plane, scenario, pattern, beam.user)
        for user in scene.users.values():
            _draw_user(axes, plane, user)
        axes.set_title(title, loc='left')
        axes.set(aspect='equal', xlim=limits_m[:, 0], ylim=limits_m[:, plane[1]])
        axes.grid()
    right = grid[:2, 1].subgridspec(2, 1, height_ratios=(1.2, 1))
    _draw_surface(figure.add_subplot(right[0]), scene.configuration, scenario)
    _draw_pattern(figure.add_subplot(right[1], projection='polar'), beam, pattern)
    figure.suptitle(_scene_title(scene))
    below = figure.add_subplot(grid[2, :])
    below.axis('off')
    below.legend(handles=_scene_legend(scene), loc='upper center', ncols=6)
    return figure


def _limits_m(
        scenario: Scenario, estimates: Collection[m.PositionEstimate], max_margin: float
) -> np.ndarray:
    """Return the limits of a view of region, surface and ellipses, float64 [2, 3] [m]."""
    corners, board = _corners(scenario), scenario.pose.to_site(
        shapes.board(scenario, None).centres)
    region = np.stack([corners.min(axis=0), corners.max(axis=0)])
    means = np.reshape([estimate.position for estimate in estimates], (-1, 3))
    variances = np.reshape([estimate.covariance_m2.diagonal() for estimate in estimates], (-1, 3))
    # The extent of an ellipse along an axis depends only on the variance along this axis.
    halves = shapes.distance_95(2) * np.sqrt(np.maximum(variances, 0))
    margin = max_margin * (region[1] - region[0])
    low = np.maximum((means - halves).min(axis=0, initial=np.inf), region[0] - margin)
    high = np.minimum((means + halves).max(axis=0, initial=-np.inf), region[1] + margin)
    return np.stack([
        np.minimum(np.minimum(region[0], board.min(axis=0)) - _MARGIN_M, low),
        np.maximum(np.maximum(region[1], board.max(axis=0)) + _MARGIN_M, high)])


def _corners(scenario: Scenario) -> np.ndarray:
    """Return the corners of the region of interest, float64 [8, 3] [m]."""
    region = shapes.region(scenario)
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    return scenario.pose.to_site(region.centres + signs * region.half_sizes_m)


def _draw_room(axes: Any, plane: list[int], scenario: Scenario) -> None:
    """Draw the region and the middle line of the surface in a plane of two coordinates."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path
    from scipy.spatial import ConvexHull

    corners, board = _corners(scenario)[:, plane], shapes.board(scenario, None)
    outline = corners[ConvexHull(corners).vertices]
    axes.add_patch(PathPatch(
        Path(np.append(outline, outline[:1], axis=0), closed=True), **_REGION, zorder=0))
    top_m = (board.centres + board.half_sizes_m)[:, plane[1]].max()
    ends = np.outer([-top_m, top_m], np.eye(3)[plane[1]])
    low, high = scenario.pose.to_site(ends)[:, plane]
    axes.plot(*np.transpose([low, high]), color='black', linewidth=_SURFACE_WIDTH_POINTS,
              solid_capstyle='butt', zorder=4)
    axes.annotate('surface', high, xytext=(0, 8), textcoords='offset points', ha='center')
    axes.set(xlabel='$x$ [m]', ylabel=f'${"xyz"[plane[1]]}$ [m]')


def _draw_ellipse(
        axes: Any, plane: list[int], estimate: m.PositionEstimate, **style: Any) -> None:
    """Draw an estimate's 95 % ellipse, as of a Gaussian, in a plane of two coordinates."""
    from matplotlib.patches import Ellipse

    half_m, directions = shapes.axes_95(estimate.covariance_m2[np.ix_(plane, plane)])
    angle = math.degrees(math.atan2(directions[1, 0], directions[0, 0]))
    axes.add_patch(Ellipse(tuple(estimate.position[plane]), *(2 * half_m), angle=angle, **style))


def _draw_positions(view: Any, user: int, cycles: Sequence[CompleteCycle]) -> None:
    own = look(user - 1)
    truth = np.array([cycle.truth.position for cycle in cycles])
    mean = np.array([cycle.estimate.position for cycle in cycles])
    view.plot(truth[:, 0], truth[:, 1], color=own.colour, linewidth=0.7, linestyle=':', zorder=2)
    view.plot([truth[:, 0], mean[:, 0]], [truth[:, 1], mean[:, 1]], color=own.colour,
              linewidth=0.7, zorder=3)
    view.plot(truth[:, 0], truth[:, 1], own.marker, color=own.colour, zorder=4)
    view.plot(mean[:, 0], mean[:, 1], 'x', color=own.colour, zorder=4)
    for cycle in cycles:
        _draw_ellipse(view, [0, 1], cycle.estimate, fill=False, color=own.colour, alpha=0.4,
                      zorder=1)


def _number(view: Any, cycle: CompleteCycle) -> None:
    """Write the number of a cycle beside the true position, on the side away from the estimate."""
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


def _draw_lobe(
        axes: Any, plane: list[int], scenario: Scenario, pattern: BeamPattern, user: int) -> None:
    """Draw the cut of a lobe through its peak."""
    row, column = pattern.peak
    points = scenario.pose.to_site(shapes.lobe(pattern, user).points)
    colour = look(user - 1).colour
    cut = (points[row] if plane == [0, 1] else points[:, column])[:, plane].T
    axes.fill(*cut, facecolor=colour, alpha=0.13, zorder=1)
    axes.plot(*cut, color=colour, alpha=0.5, linewidth=0.8, zorder=1)


def _draw_user(axes: Any, plane: list[int], user: SceneUser) -> None:
    own, estimate = look(user.user - 1), user.estimate
    colour = own.colour
    true_path = np.array([point[plane] for point in user.true_path]).reshape(-1, 2)
    axes.plot(*true_path.T, color=colour, linewidth=0.9, alpha=0.8, zorder=3)
    if estimate:
        _draw_ellipse(axes, plane, estimate, facecolor=colour, alpha=0.25, zorder=2)
        _draw_ellipse(axes, plane, estimate, fill=False, edgecolor=colour, linewidth=0.9,
                      zorder=3)
        earlier = np.array([point[plane] for point in user.estimated_path][:-1]).reshape(-1, 2)
        axes.plot(*earlier.T, 'x', color=colour, markersize=2, alpha=0.5, zorder=3)
        axes.plot(*estimate.position[plane], 'x', color=colour, markersize=5.5,
                  markeredgewidth=1.4, zorder=5)
    if user.truth:
        axes.plot(*user.truth.position[plane], own.marker, color=colour, markersize=5,
                  markeredgecolor='black', markeredgewidth=0.6, zorder=6)


def _draw_surface(axes: Any, message: m.RhsConfiguration | None, scenario: Scenario) -> None:
    """Draw the configuration of the surface from the front: y to the right, z up."""
    shape = scenario.n_rows, scenario.n_columns
    half_y_cm, half_z_cm = 50 * geometry.surface_sides_m(scenario)
    tunings = np.full(shape, np.nan) if message is None else message.analog.mean(axis=0)
    if scenario.element_positions_m is None:
        image = axes.imshow(
            tunings.reshape(shape), origin='lower', vmin=0, vmax=1,
            extent=(-half_y_cm, half_y_cm, -half_z_cm, half_z_cm))
    else:
        image = axes.scatter(*(100 * geometry.element_positions(scenario)[:, 1:]).T, s=12,
                             c=tunings.ravel(), vmin=0, vmax=1)
        if scenario.element_normals is not None:
            axes.quiver(*(100 * geometry.element_positions(scenario)[:, 1:]).T,
                        *geometry.element_normals(scenario)[:, 1:].T, color='grey', width=0.004)
        axes.set(aspect='equal')
    axes.plot(*(100 * geometry.feed_positions(scenario)[:, 1:]).T, 'D', color='white',
              markeredgecolor='black', markersize=4)
    label, text = 'tuning', 'not known yet'
    if message is not None and scenario.board.declared:
        label += ' (circles: modulus)'
        axes.scatter(*(100 * geometry.element_positions(scenario)[:, 1:]).T, facecolors='none',
                     s=30 * shapes.moduli(scenario, message.analog, message.band)**2,
                     edgecolors='white', linewidths=0.7)
    axes.figure.colorbar(image, ax=axes, location='bottom', label=label, shrink=0.8,
                         ticks=(0, 0.5, 1))
    if message is not None:
        mean = f', mean of {len(message.analog)} frames' if len(message.analog) > 1 else ''
        text = f'{message.mode.name.lower()}, band {message.band}{mean}\ncycle {message.cycle_id}'
    axes.set_title(f'surface from the front\n{text}')
    axes.set(xlabel='$y$ [cm]', ylabel='$z$ [cm]')


def _draw_pattern(axes: Any, beam: m.Beam | None, pattern: BeamPattern | None) -> None:
    """Draw the cuts of the beam pattern through its peak, in decibels."""
    axes.set_theta_zero_location('N')
    axes.set(thetamin=-90, thetamax=90, rlim=(MIN_LEVEL_DB, 0))
    levels_db, angles_deg = np.linspace(MIN_LEVEL_DB, 0, 3), range(-90, 91, 45)
    axes.set_rgrids(levels_db, [f'{level:g}'.replace('-', '−') for level in levels_db])
    axes.tick_params(labelsize=7, pad=0)
    axes.set_thetagrids(angles_deg, [f'{angle}°'.replace('-', '−') for angle in angles_deg])
    if beam is None or pattern is None:
        axes.set_title('no data beam yet')
        return
    min_power = 10**(MIN_LEVEL_DB / 10)
    for name, (angles, power), style in (
            ('over azimuth', pattern.azimuth_cut(), '-'),
            ('over elevation', pattern.elevation_cut(), ':')):
        axes.plot(angles, 10 * np.log10(np.maximum(power, min_power)), style,
                  color=look(beam.user - 1).colour, linewidth=1.2, label=name)
    axes.set_title(f'data beam to user {beam.user}, band {beam.band} [dB]')
    axes.legend(loc='lower center', bbox_to_anchor=(0.5, -0.2), ncols=2,
                frameon=False)


def _scene_title(scene: SceneState) -> str:
    shown = scene.shown_user
    if shown is None or shown.estimate is None:
        return 'no estimate yet'
    error = f', error {shown.error_m:.2f} m' if not math.isnan(shown.error_m) else ''
    return (f'cycle {shown.estimate.cycle_id}, user {shown.user}{error}, codebook '
            f'{shown.estimate.codebook_id}')


def _scene_legend(scene: SceneState) -> list[Any]:
    users = sorted(scene.users)
    return [
        _patch('region of interest', **_REGION),
        _mark('true position', marker='o', markersize=5, markeredgecolor='black'),
        _mark('its path', linestyle='-'),
        _mark('estimate', marker='x', markersize=5.5, markeredgewidth=1.4),
        _mark('earlier estimates', marker='x', markersize=2),
        _patch('95 % of the posterior', facecolor='0.8', edgecolor='0.4'),
        _mark('feed', marker='D', markerfacecolor='white', markeredgecolor='black'),
        *([_patch(f'data beam, −{-MIN_LEVEL_DB:g} to 0 dB', facecolor='0.92')]
          if scene.shown_beam else []),
        *(_mark(f'user {user}', marker=look(user - 1).marker, color=look(user - 1).colour,
                markersize=5, markeredgecolor='black') for user in users[:_SCENE_MAX_LABELS]),
        *_further(users, _SCENE_MAX_LABELS)]


def _mark(label: str, **style: Any) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], **{'linestyle': '', 'color': '0.35', 'label': label, **style})


def _patch(label: str, **style: Any) -> Any:
    from matplotlib.patches import Patch

    return Patch(label=label, **style)


def _further(users: Sequence[int], n_shown: int) -> list[Any]:
    """Return a legend entry with the number of users that are not shown, if there are any."""
    n_others = len(users) - n_shown
    return [_mark(f'and {counted(n_others, "more user")}')] if n_others > 0 else []
