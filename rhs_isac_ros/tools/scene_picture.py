"""The scene of a network as a picture: from above, from the side, board and beam."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.link import Beam, BeamPattern, beam_pattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.model.geometry import element_interval_m, element_positions, feed_positions
from rhs_isac_ros.monitoring.scene_state import SceneState, UserState
from rhs_isac_ros.protocol.messages import Beam as BeamMessage
from rhs_isac_ros.protocol.messages import Mode
from rhs_isac_ros.ros.markers import MIN_LEVEL_DB, lobe_m
from rhs_isac_ros.tools.ellipses import ellipse_95

_INCHES = (14.0, 9.6)
_DPI = 120
_MARGIN_M = 0.8
# A board of some decimetres is drawn no thinner than this line [points].
_BOARD_POINTS = 6
_MOST_NAMED = 8
_STEP_DEG = 2.0


def draw(sightings: SceneState, scenario: Scenario, path: Path) -> None:
    """Draw a scene and write it as a PNG file.

    Parameters
    ----------
    sightings
        The scene; what it lacks is left out.
    scenario
        The scenario.
    path
        The file.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    figure = compose(sightings, scenario)
    write_whole(path, lambda stream: figure.savefig(stream, dpi=_DPI, format='png'))


def compose(sightings: SceneState, scenario: Scenario) -> Any:
    """Draw a scene.

    Parameters
    ----------
    sightings
        The scene; what it lacks is left out.
    scenario
        The scenario.

    Returns
    -------
    matplotlib.figure.Figure
        The drawing.
    """
    # Here: a slow import. Without pyplot, no window system is asked for.
    from matplotlib.figure import Figure

    figure = Figure(figsize=_INCHES, layout='constrained')
    # Both views in one scale, so that they stand on top of each other.
    grid = figure.add_gridspec(2, 2, width_ratios=(1.9, 1),
                               height_ratios=[_reach_m(scenario, axis) for axis in (1, 2)])
    found = _pattern(sightings.beam, scenario)
    above, aside = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    _view(above, (0, 1), sightings, scenario, found)
    _view(aside, (0, 2), sightings, scenario, found)
    above.set_title('from above', loc='left')
    aside.set_title('from the side', loc='left')
    right = grid[:, 1].subgridspec(2, 1, height_ratios=(1.5, 1))
    _board(figure.add_subplot(right[0]), sightings, scenario)
    _polar(figure.add_subplot(right[1], projection='polar'), sightings.beam, found)
    figure.suptitle(_title(sightings), fontsize='x-large')
    figure.legend(handles=_legend(sightings), loc='outside lower center', ncols=6)
    return figure


def _title(sightings: SceneState) -> str:
    newest = sightings.newest
    if newest is None:
        return 'no estimate yet'
    error = f', error {newest.error_m:.2f} m' if not math.isnan(newest.error_m) else ''
    return f'cycle {newest.estimate.cycle_id}, user {newest.user}{error}'


def _pattern(beam: BeamMessage | None, scenario: Scenario) -> BeamPattern | None:
    if beam is None:
        return None
    return beam_pattern(scenario, Beam(beam.analog, beam.digital, beam.band),
                   math.hypot(*scenario.roi_center_m), _STEP_DEG)


def _colour(user: int) -> str:
    return f'C{(user - 1) % 10}'


def _reach_m(scenario: Scenario, axis: int) -> float:
    """How far a view goes to both sides [m]."""
    return float(np.abs(scenario.roi_bounds_m)[:, axis].max()) + _MARGIN_M


def _view(
        axes: Any, plane: tuple[int, int], sightings: SceneState, scenario: Scenario,
        found: BeamPattern | None) -> None:
    """Draw the scene as projected along the axis that is not of the plane."""
    from matplotlib.patches import Rectangle

    plane = list(plane)
    low, high = (bound[plane] for bound in scenario.roi_bounds_m)
    axes.add_patch(Rectangle(low, *(high - low), facecolor='0.95', edgecolor='0.4',
                             linestyle='--', zorder=0))
    if found is not None:
        row, column = found.peak
        body = lobe_m(found)
        cut = body[row] if plane == [0, 1] else body[:, column]
        colour = _colour(sightings.beam.user)
        axes.fill(*cut[:, plane].T, facecolor=colour, alpha=0.13, zorder=1)
        axes.plot(*cut[:, plane].T, color=colour, alpha=0.5, linewidth=0.8, zorder=1)
    half_m = element_interval_m(scenario) * scenario.elements_per_side / 2
    axes.plot([0, 0], [-half_m, half_m], color='black', linewidth=_BOARD_POINTS,
              solid_capstyle='butt', zorder=4)
    axes.annotate('board', (0, half_m), xytext=(0, 8), textcoords='offset points', ha='center')
    for sighting in sightings.users.values():
        _user(axes, plane, sighting)
    axes.set(xlabel='x [m]', ylabel=f'{"xyz"[plane[1]]} [m]', aspect='equal')
    axes.set_xlim(min(-_MARGIN_M, low[0] - _MARGIN_M), high[0] + _MARGIN_M)
    reach_m = _reach_m(scenario, plane[1])
    axes.set_ylim(-reach_m, reach_m)
    axes.grid(color='0.9', linewidth=0.6)
    axes.set_axisbelow(True)


def _user(axes: Any, plane: list[int], sighting: UserState) -> None:
    from matplotlib.patches import Ellipse

    colour, estimate = _colour(sighting.user), sighting.estimate
    way = np.array([place[plane] for place in sighting.true_path]).reshape(-1, 2)
    axes.plot(*way.T, color=colour, linewidth=1.2, alpha=0.8, zorder=3)
    if estimate:
        place = estimate.position[plane]
        width, height, angle = ellipse_95(estimate.covariance_m2[np.ix_(plane, plane)])
        axes.add_patch(Ellipse(place, width, height, angle=angle, facecolor=colour, alpha=0.25,
                               zorder=2))
        axes.add_patch(Ellipse(place, width, height, angle=angle, fill=False, edgecolor=colour,
                               linewidth=1.5, zorder=3))
        earlier = np.array([place[plane] for place in sighting.path][:-1]).reshape(-1, 2)
        axes.plot(*earlier.T, 'x', color=colour, markersize=4, alpha=0.4, zorder=3)
        axes.plot(*place, 'x', color=colour, markersize=10, markeredgewidth=2.5, zorder=5)
    if sighting.truth:
        axes.plot(*sighting.truth.position[plane], 'o', color=colour, markersize=9,
                  markeredgecolor='black', zorder=6)


def _board(axes: Any, sightings: SceneState, scenario: Scenario) -> None:
    """Draw the surface as a user sees it: y to the right, z up."""
    side, places = scenario.elements_per_side, 100 * element_positions(scenario)
    half_cm = 50 * element_interval_m(scenario) * side
    message = sightings.configuration
    shown = np.full(len(places), np.nan) if message is None else np.mean(message.analog, axis=0)
    image = axes.imshow(
        shown.reshape(side, side), origin='lower', cmap='viridis', vmin=0, vmax=1,
        extent=(-half_cm, half_cm, -half_cm, half_cm))
    axes.plot(*(100 * feed_positions(scenario)[:, 1:]).T, 'D', color='white',
              markeredgecolor='black', markersize=7)
    axes.figure.colorbar(image, ax=axes, location='bottom', label='amplitude', shrink=0.8)
    what = 'not known yet'
    if message is not None:
        phase = 'positioning' if message.mode is Mode.POSITIONING else 'transmission'
        mean = f', mean of {len(message.analog)} frames' if len(message.analog) > 1 else ''
        what = f'{phase}, band {message.band}{mean}'
    axes.set_title(f'board from the front\n{what}', fontsize='medium')
    axes.set(xlabel='y [cm]', ylabel='z [cm]')


def _polar(axes: Any, beam: BeamMessage | None, found: BeamPattern | None) -> None:
    """Draw the cuts through the strongest direction, in decibels."""
    axes.set_theta_zero_location('N')
    axes.set(thetamin=-90, thetamax=90, rlim=(MIN_LEVEL_DB, 0),
             rticks=np.linspace(MIN_LEVEL_DB, 0, 5))
    axes.tick_params(labelsize='small')
    if found is None:
        axes.set_title('no data beam yet', fontsize='medium')
        return
    floor = 10**(MIN_LEVEL_DB / 10)
    for name, (angles, power), style in (
            ('over azimuth', found.azimuth_cut(), '-'),
            ('over elevation', found.elevation_cut(), ':')):
        axes.plot(angles, 10 * np.log10(np.maximum(power, floor)), style,
                  color=_colour(beam.user), linewidth=2, label=name)
    axes.set_title(f'data beam to user {beam.user}, band {beam.band} [dB]', fontsize='medium')
    axes.legend(loc='lower center', bbox_to_anchor=(0.5, -0.02), ncols=2, fontsize='small',
                frameon=False)


def _legend(sightings: SceneState) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def mark(marker: str, label: str, **style: Any) -> Line2D:
        return Line2D([], [], linestyle='', marker=marker, color='0.4', label=label, **style)
    handles = [
        Patch(facecolor='0.95', edgecolor='0.4', linestyle='--', label='region of interest'),
        mark('o', 'true position', markersize=9, markeredgecolor='black'),
        Line2D([], [], color='0.4', label='its path'),
        mark('x', 'estimate', markersize=10, markeredgewidth=2.5),
        mark('x', 'earlier estimates', markersize=4),
        Patch(facecolor='0.8', edgecolor='0.4', label='95 % of the posterior'),
        mark('D', 'feed', markerfacecolor='white', markeredgecolor='black')]
    if sightings.beam:
        handles.append(Patch(facecolor='0.92', label=f'data beam, {MIN_LEVEL_DB:g} to 0 dB'))
    users = sorted(sightings.users)
    handles += [Patch(color=_colour(user), label=f'user {user}') for user in users[:_MOST_NAMED]]
    if len(users) > _MOST_NAMED:
        handles.append(Line2D([], [], linestyle='', label=f'and {len(users) - _MOST_NAMED} more'))
    return handles
