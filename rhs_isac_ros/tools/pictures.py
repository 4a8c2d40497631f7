"""Pictures of a network: its cycles for ``demo``, its scene for ``snapshot``."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.link import Beam, BeamPattern, beam_pattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_interval_m, element_positions, feed_positions
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.monitoring.network_state import SceneState, UserState
from rhs_isac_ros.monitoring.shapes import MIN_LEVEL_DB, lobe_m
from rhs_isac_ros.protocol.messages import Beam as BeamMessage
from rhs_isac_ros.protocol.messages import Mode
from rhs_isac_ros.support.pictures import (
    PAGE_IN,
    label_decades,
    look,
    new_figure,
    paper_style,
    write_picture,
)

# Quantile of the chi-square distribution with two degrees of freedom at 95 %.
_CHI_SQUARE_95 = -2 * math.log(0.05)


def ellipse_95(covariance_m2: np.ndarray) -> tuple[float, float, float]:
    """Return the ellipse that contains 95 % of a Gaussian distribution in a plane.

    Parameters
    ----------
    covariance_m2
        Covariance, float64 [2, 2] [m^2].

    Returns
    -------
    tuple of float
        Lengths of the two axes, called width and height [m], and the angle from the first
        coordinate axis to the axis of the width [deg].
    """
    variances, directions = np.linalg.eigh(covariance_m2)
    width, height = (2 * np.sqrt(_CHI_SQUARE_95 * np.maximum(variances, 0))).tolist()
    return width, height, math.degrees(math.atan2(directions[1, 0], directions[0, 0]))


def limits_with_ellipses(
        limits_m: np.ndarray, bounds_m: np.ndarray, means_m: Sequence[np.ndarray],
        covariances_m2: Sequence[np.ndarray]) -> np.ndarray:
    """Extend the limits of a view so that it contains the ellipses of `ellipse_95`.

    Parameters
    ----------
    limits_m
        Lower and upper corner, float64 [2, n] [m].
    bounds_m
        Corners that an ellipse does not extend the view beyond, float64 [2, n] [m].
    means_m, covariances_m2
        Centres of the ellipses, float64 [n] [m] each, and covariances, float64 [n, n] [m^2] each.

    Returns
    -------
    np.ndarray
        Extended limits, float64 [2, n] [m].
    """
    n = limits_m.shape[1]
    means = np.reshape(means_m, (-1, n))
    variances = np.reshape([covariance.diagonal() for covariance in covariances_m2], (-1, n))
    # Half the extent of an ellipse depends on the variance along the axis alone.
    halves = np.sqrt(_CHI_SQUARE_95 * np.maximum(variances, 0))
    low = np.maximum((means - halves).min(axis=0, initial=np.inf), bounds_m[0])
    high = np.minimum((means + halves).max(axis=0, initial=-np.inf), bounds_m[1])
    return np.stack([np.minimum(limits_m[0], low), np.maximum(limits_m[1], high)])


# Height of the errors and of all that surrounds the panels [in], and the share of the width that
# the view from above has.
_ERRORS_IN, _REST_IN, _VIEW_SHARE = 1.4, 1.9, 0.94
# Space around the region and the surface [m]; ellipses may need more, up to a share of the region.
_CYCLES_MARGIN_M, _CYCLES_MAX_MARGIN = 0.8, 0.4
# Maximum numbers of cycles with a number in the view, and of users in the legend.
_MAX_NUMBERS, _CYCLES_MAX_LABELS = 60, 6


def prepare_drawing() -> None:
    """Import what `draw_cycles` needs, while there is nothing else to do."""
    # Not at the start of the program, which has more urgent imports.
    from matplotlib import figure, patches, style
    from matplotlib.backends import backend_agg

    del figure, patches, style, backend_agg


def draw_cycles(cycles: Sequence[CompleteCycle], scenario: Scenario, path: Path) -> None:
    """Draw at least one cycle, in the format that the suffix of `path` names.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_picture(path, compose_cycles(cycles, scenario))


@paper_style()
def compose_cycles(cycles: Sequence[CompleteCycle], scenario: Scenario) -> Any:
    """Return the `matplotlib.figure.Figure` of at least one cycle."""
    low, high = _cycle_limits_m(cycles, scenario)
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
    above.legend(handles=_cycle_legend(users), loc='lower center', ncols=4)
    return figure


def _cycle_limits_m(cycles: Sequence[CompleteCycle], scenario: Scenario) -> np.ndarray:
    """Return the corners of the view from above, float64 [2, 2] [m]."""
    region = scenario.roi_bounds_m[:, :2]
    surface = element_positions(scenario)[:, :2]
    limits = np.stack([np.minimum(region[0], surface.min(axis=0)) - _CYCLES_MARGIN_M,
                       np.maximum(region[1], surface.max(axis=0)) + _CYCLES_MARGIN_M])
    margin = _CYCLES_MAX_MARGIN * (region[1] - region[0])
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


def _cycle_legend(users: Sequence[int]) -> list[Any]:
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
    for user in users[:_CYCLES_MAX_LABELS]:
        own = look(user - 1)
        handles.append(mark(f'user {user}', marker=own.marker, color=own.colour,
                            linestyle=own.line))
    if len(users) > _CYCLES_MAX_LABELS:
        handles.append(mark(f'and {len(users) - _CYCLES_MAX_LABELS} more users'))
    return handles


_HEIGHT_IN = 5.7
# Space around the region and the surface [m]; ellipses may need more, up to a share of the region.
_MARGIN_M, _MAX_MARGIN = 0.8, 0.25
# Height of the row of the legend, apart from the legend, relative to the views.
_LEGEND_ROW = 0.001
# Line width of the surface: to scale, a surface of some decimetres would be too thin to see.
_SURFACE_WIDTH_POINTS = 6
# Maximum number of users in the legend.
_MAX_LABELS = 8
_PATTERN_STEP_DEG = 1.0


def draw_scene(scene: SceneState, scenario: Scenario, path: Path) -> None:
    """Draw a scene as far as it is known, in the format that the suffix of `path` names.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_picture(path, compose_scene(scene, scenario))


@paper_style()
def compose_scene(scene: SceneState, scenario: Scenario) -> Any:
    """Draw a scene as far as it is known, and return the `matplotlib.figure.Figure`."""
    figure = new_figure(PAGE_IN, _HEIGHT_IN)
    # Both views have the same scale, so that their x axes are aligned. The layout adds the height
    # of the legend to the last row.
    limits_m = _scene_limits_m(scene, scenario)
    heights = np.diff(limits_m, axis=0)[0, 1:]
    grid = figure.add_gridspec(3, 2, width_ratios=(1.75, 1),
                               height_ratios=[*heights, _LEGEND_ROW * heights.sum()])
    pattern = _pattern(scene.shown_beam, scenario)
    above, side = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    for axes, plane, name in ((above, [0, 1], 'from above'), (side, [0, 2], 'from the side')):
        _draw_view(axes, plane, scene, scenario, pattern)
        axes.set_title(name, loc='left')
        axes.set(xlim=limits_m[:, 0], ylim=limits_m[:, plane[1]])
    right = grid[:2, 1].subgridspec(2, 1, height_ratios=(1.2, 1))
    _draw_surface(figure.add_subplot(right[0]), scene, scenario)
    _draw_pattern(figure.add_subplot(right[1], projection='polar'), scene.shown_beam, pattern)
    figure.suptitle(_title(scene))
    # A legend of the figure gets room from the layout only since Matplotlib 3.7.
    below = figure.add_subplot(grid[2, :])
    below.axis('off')
    below.legend(handles=_scene_legend(scene), loc='upper center', ncols=6)
    return figure


def _title(scene: SceneState) -> str:
    shown = scene.shown_user
    if shown is None or shown.estimate is None:
        return 'no estimate yet'
    error = f', error {shown.error_m:.2f} m' if not math.isnan(shown.error_m) else ''
    return f'cycle {shown.estimate.cycle_id}, user {shown.user}{error}'


def _pattern(beam: BeamMessage | None, scenario: Scenario) -> BeamPattern | None:
    if beam is None:
        return None
    return beam_pattern(scenario, Beam(beam.analog, beam.digital, beam.band),
                        math.hypot(*scenario.roi_center_m), _PATTERN_STEP_DEG)


def _scene_limits_m(scene: SceneState, scenario: Scenario) -> np.ndarray:
    """Return the corners of the views, float64 [2, 3] [m], symmetric along y and z."""
    region = scenario.roi_bounds_m
    estimates = [user.estimate for user in scene.users.values() if user.estimate]
    margin = _MAX_MARGIN * (region[1] - region[0])
    limits = limits_with_ellipses(
        np.stack([np.minimum(region[0], 0) - _MARGIN_M, region[1] + _MARGIN_M]),
        region + np.stack([-margin, margin]), [estimate.position for estimate in estimates],
        [estimate.covariance_m2 for estimate in estimates])
    limits[1, 1:] = np.abs(limits[:, 1:]).max(axis=0)
    limits[0, 1:] = -limits[1, 1:]
    return limits


def _draw_view(
        axes: Any, plane: list[int], scene: SceneState, scenario: Scenario,
        pattern: BeamPattern | None) -> None:
    """Draw the scene projected onto the plane of two axes."""
    from matplotlib.patches import Rectangle

    low, high = (bound[plane] for bound in scenario.roi_bounds_m)
    axes.add_patch(Rectangle(low, *(high - low), facecolor='0.95', edgecolor='0.4',
                             linestyle='--', zorder=0))
    if pattern is not None and scene.shown_beam is not None:
        row, column = pattern.peak
        lobe = lobe_m(pattern)
        cut = lobe[row] if plane == [0, 1] else lobe[:, column]
        colour = look(scene.shown_beam.user - 1).colour
        axes.fill(*cut[:, plane].T, facecolor=colour, alpha=0.13, zorder=1)
        axes.plot(*cut[:, plane].T, color=colour, alpha=0.5, linewidth=0.8, zorder=1)
    sides = scenario.n_columns, scenario.n_rows
    half_m = element_interval_m(scenario) * sides[plane[1] - 1] / 2
    axes.plot([0, 0], [-half_m, half_m], color='black', linewidth=_SURFACE_WIDTH_POINTS,
              solid_capstyle='butt', zorder=4)
    axes.annotate('surface', (0, half_m), xytext=(0, 8), textcoords='offset points', ha='center')
    for user in scene.users.values():
        _draw_user(axes, plane, user)
    axes.set(xlabel='$x$ [m]', ylabel=f'${"xyz"[plane[1]]}$ [m]', aspect='equal')
    axes.grid()


def _draw_user(axes: Any, plane: list[int], user: UserState) -> None:
    from matplotlib.patches import Ellipse

    own, estimate = look(user.user - 1), user.estimate
    colour = own.colour
    true_path = np.array([point[plane] for point in user.true_path]).reshape(-1, 2)
    axes.plot(*true_path.T, color=colour, linewidth=0.9, alpha=0.8, zorder=3)
    if estimate:
        x, y = estimate.position[plane]
        width, height, angle = ellipse_95(estimate.covariance_m2[np.ix_(plane, plane)])
        axes.add_patch(Ellipse((x, y), width, height, angle=angle, facecolor=colour, alpha=0.25,
                               zorder=2))
        axes.add_patch(Ellipse((x, y), width, height, angle=angle, fill=False, edgecolor=colour,
                               linewidth=0.9, zorder=3))
        earlier = np.array([point[plane] for point in user.estimated_path][:-1]).reshape(-1, 2)
        axes.plot(*earlier.T, 'x', color=colour, markersize=2, alpha=0.5, zorder=3)
        axes.plot(x, y, 'x', color=colour, markersize=5.5, markeredgewidth=1.4, zorder=5)
    if user.truth:
        axes.plot(*user.truth.position[plane], own.marker, color=colour, markersize=5,
                  markeredgecolor='black', markeredgewidth=0.6, zorder=6)


def _draw_surface(axes: Any, scene: SceneState, scenario: Scenario) -> None:
    """Draw the configuration of the surface from the front: y to the right, z up."""
    shape, message = (scenario.n_rows, scenario.n_columns), scene.configuration
    half_z_cm, half_y_cm = (50 * element_interval_m(scenario) * n for n in shape)
    amplitudes = np.full(shape, np.nan) if message is None else message.analog.mean(axis=0)
    image = axes.imshow(
        amplitudes.reshape(shape), origin='lower', vmin=0, vmax=1,
        extent=(-half_y_cm, half_y_cm, -half_z_cm, half_z_cm))
    axes.plot(*(100 * feed_positions(scenario)[:, 1:]).T, 'D', color='white',
              markeredgecolor='black', markersize=4)
    axes.figure.colorbar(image, ax=axes, location='bottom', label='amplitude', shrink=0.8,
                         ticks=(0, 0.5, 1))
    text = 'not known yet'
    if message is not None:
        phase = 'positioning' if message.mode is Mode.POSITIONING else 'transmission'
        mean = f', mean of {len(message.analog)} frames' if len(message.analog) > 1 else ''
        text = f'{phase}, band {message.band}{mean}\ncycle {message.cycle_id}'
    axes.set_title(f'surface from the front\n{text}')
    axes.set(xlabel='$y$ [cm]', ylabel='$z$ [cm]')


def _draw_pattern(axes: Any, beam: BeamMessage | None, pattern: BeamPattern | None) -> None:
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


def _scene_legend(scene: SceneState) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def marker(symbol: str, label: str, **style: Any) -> Line2D:
        return Line2D([], [], linestyle='', marker=symbol, color='0.4', label=label, **style)
    handles: list[Any] = [
        Patch(facecolor='0.95', edgecolor='0.4', linestyle='--', label='region of interest'),
        marker('o', 'true position', markersize=5, markeredgecolor='black'),
        Line2D([], [], color='0.4', label='its path'),
        marker('x', 'estimate', markersize=5.5, markeredgewidth=1.4),
        marker('x', 'earlier estimates', markersize=2),
        Patch(facecolor='0.8', edgecolor='0.4', label='95 % of the posterior'),
        marker('D', 'feed', markerfacecolor='white', markeredgecolor='black')]
    if scene.shown_beam:
        handles.append(Patch(facecolor='0.92', label=f'data beam, −{-MIN_LEVEL_DB:g} to 0 dB'))
    users = sorted(scene.users)
    handles += [marker(look(user - 1).marker, f'user {user}', markersize=5,
                       markeredgecolor='black', markerfacecolor=look(user - 1).colour)
                for user in users[:_MAX_LABELS]]
    if len(users) > _MAX_LABELS:
        handles.append(Line2D([], [], linestyle='', label=f'and {len(users) - _MAX_LABELS} more'))
    return handles
