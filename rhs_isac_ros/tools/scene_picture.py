"""Picture of the scene of a network: from above, from the side, surface and beam."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.link import Beam, BeamPattern, beam_pattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_interval_m, feed_positions
from rhs_isac_ros.model.pictures import PAGE_IN, look, new_figure, paper_style, write_picture
from rhs_isac_ros.monitoring.entities import MIN_LEVEL_DB, lobe_m
from rhs_isac_ros.monitoring.scene_state import SceneState, UserState
from rhs_isac_ros.protocol.messages import Beam as BeamMessage
from rhs_isac_ros.protocol.messages import Mode
from rhs_isac_ros.tools.ellipses import ellipse_95, limits_with_ellipses

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


def draw(scene: SceneState, scenario: Scenario, path: Path) -> None:
    """Draw a scene as far as it is known, in the format that the suffix of `path` names.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_picture(path, compose(scene, scenario))


@paper_style()
def compose(scene: SceneState, scenario: Scenario) -> Any:
    """Draw a scene as far as it is known, and return the `matplotlib.figure.Figure`."""
    figure = new_figure(PAGE_IN, _HEIGHT_IN)
    # Both views have the same scale, so that their x axes are aligned. The layout adds the height
    # of the legend to the last row.
    limits_m = _limits_m(scene, scenario)
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
    below.legend(handles=_legend(scene), loc='upper center', ncols=6)
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


def _limits_m(scene: SceneState, scenario: Scenario) -> np.ndarray:
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


def _legend(scene: SceneState) -> list[Any]:
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
