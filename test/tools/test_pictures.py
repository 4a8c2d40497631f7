"""Contents and readability of the pictures of a scene and of cycles."""

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.patches import Ellipse, PathPatch, Polygon
from matplotlib.text import Annotation, Text

from rhs_isac_ros.link import steer
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.network_state import SceneState
from rhs_isac_ros.monitoring.shapes import MIN_LEVEL_DB, axes_95
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.support.pictures import look, write_picture
from rhs_isac_ros.tools.pictures import compose_cycles, compose_scene

POSITIONS = np.array([[9.0, 2.0, 0.5], [12.0, -3.0, -0.4], [7.0, -1.0, 0.0]])
COVARIANCE_M2 = np.array([[0.6, 0.2, 0.05], [0.2, 0.3, 0.0], [0.05, 0.0, 0.1]])


def make_scene(scenario, n_users):
    scene, rng = SceneState(), np.random.default_rng(1)
    for user in range(1, n_users + 1):
        position = POSITIONS[user % 3]
        for step in range(5):
            scene.add(m.GroundTruth(cycle_id=user, user=user, position=position + 0.2 * step,
                velocity=np.zeros(3)), 0.0)
        for cycle_id in (user, 100 + user):
            scene.add(m.PositionEstimate(
                cycle_id=cycle_id, user=user, codebook_id='cb', position=position + 0.1,
                    covariance_m2=COVARIANCE_M2, crlb_m2=0.1, estimator='bayes', latency_s=0.01),
                    0.0)
    configuration = rng.uniform(size=(scenario.n_frames, scenario.n_elements))
    scene.add(m.RhsConfiguration(cycle_id=1, mode=m.Mode.POSITIONING, band=1, codebook_id='cb',
        analog=configuration), 0.0)
    beam = steer(scenario, POSITIONS[n_users % 3])
    scene.add(m.Beam(cycle_id=1, user=n_users, codebook_id='cb', band=0, analog=beam.analog,
        digital=beam.digital, expected_bps=1e6), 0.0)
    return scene


def region_of(axes):
    """Return the extents of the region in a view."""
    (region,) = [patch for patch in axes.patches if type(patch) is PathPatch]
    return region.get_path().get_extents()


def texts(figure, monkeypatch):
    """Return the texts that are drawn, with their boxes; ticks outside an axis are not drawn."""
    found, draw_text = [], Text.draw

    def record(text, renderer):
        if text.get_visible() and text.get_text().strip():
            found.append((text.get_text(), text.get_window_extent(renderer)))
        draw_text(text, renderer)
    with monkeypatch.context() as patch:
        patch.setattr(Text, 'draw', record)
        FigureCanvasAgg(figure).draw()
    return found


def test_no_text_is_cut_off_or_overlaps_another(monkeypatch):
    scenario = Scenario()
    figure = compose_scene(make_scene(scenario, 12), scenario)
    found = texts(figure, monkeypatch)
    assert {'$x$ [m]', '$y$ [m]', '$z$ [m]', 'user 8', 'and 4 more users', 'surface'} <= {
        text for text, _ in found}
    page = figure.bbox.padded(1)
    for text, box in found:
        assert page.contains(*box.min) and page.contains(*box.max), text
    for (one, box), (other, second) in itertools.combinations(found, 2):
        assert not box.padded(-1).overlaps(second.padded(-1)), (one, other)


@pytest.mark.slow
def test_both_views_show_region_users_and_ellipses_at_their_positions():
    scenario = Scenario()
    figure = compose_scene(make_scene(scenario, 3), scenario)
    views = {axes.get_ylabel(): axes for axes in figure.axes}
    low, high = scenario.roi_bounds_m
    for label, plane in (('$y$ [m]', [0, 1]), ('$z$ [m]', [0, 2])):
        axes = views[label]
        np.testing.assert_allclose(region_of(axes).get_points(), [low[plane], high[plane]])
        ellipses = [patch for patch in axes.patches if isinstance(patch, Ellipse)]
        centres = {tuple(np.round(patch.center, 9)) for patch in ellipses}
        assert centres == {tuple(np.round(position[plane] + 0.1, 9)) for position in POSITIONS}
        half_m, directions = axes_95(COVARIANCE_M2[np.ix_(plane, plane)])
        for patch in ellipses:
            assert (patch.width, patch.height) == pytest.approx(2 * half_m)
            assert np.tan(np.radians(patch.angle)) == pytest.approx(
                directions[1, 0] / directions[0, 0])
        dots = {tuple(np.round(line.get_xydata()[0], 9)) for line in axes.lines
                if line.get_markeredgecolor() == 'black' and line.get_marker() != 'None'}
        assert dots == {tuple(np.round(position[plane] + 0.8, 9)) for position in POSITIONS}
        assert axes.get_aspect() == 1.0
    surface = views['$z$ [cm]'].images[0].get_array()
    assert surface.shape == (10, 10)
    # No error is shown: the true position of user 3 belongs to another cycle.
    assert [text.get_text() for text in figure.texts] == ['cycle 103, user 3, codebook cb']


@pytest.mark.slow
def test_region_surface_and_lobe_are_where_the_surface_hangs():
    # At y = 12 m, looking along -y.
    scenario = Scenario(pose={'position_m': [1, 12, 2], 'quaternion': [0, 0, -1, 1]})
    scene, beam = make_scene(scenario, 3), steer(scenario, POSITIONS[0])
    scene.add(m.Beam(cycle_id=103, user=3, codebook_id='cb', band=0, analog=beam.analog,
                     digital=beam.digital, expected_bps=1e6), 0.0)
    above, side = compose_scene(scene, scenario).axes[:2]
    np.testing.assert_allclose(region_of(above).get_points(), [[-4, -3], [6, 7]], atol=1e-9)
    np.testing.assert_allclose(region_of(side).get_points(), [[-4, 1], [6, 3]], atol=1e-9)
    for axes in (above, side):
        (label,) = [text for text in axes.texts if text.get_text() == 'surface']
        (lobe,) = [patch for patch in axes.patches if type(patch) is Polygon]
        line = axes.lines[0].get_xydata()
        assert axes.viewLim.contains(*label.xy)
        np.testing.assert_allclose(label.xy, line[1])
        np.testing.assert_allclose(line.mean(axis=0), [1, 12] if axes is above else [1, 2])
        if axes is above:
            assert 1.0 < np.ptp(lobe.get_xy()[:, 1]) and lobe.get_xy()[:, 1].max() < 12.001


@pytest.mark.slow
def test_title_beam_and_lobe_are_of_one_user():
    """Even if the estimate of another user is more recent than the beam."""
    scenario = Scenario()
    scene = make_scene(scenario, 3)
    beam = steer(scenario, POSITIONS[2])
    scene.add(m.Beam(cycle_id=102, user=2, codebook_id='cb', band=0, analog=beam.analog,
                     digital=beam.digital, expected_bps=1e6), 0.0)
    figure = compose_scene(scene, scenario)
    assert [text.get_text() for text in figure.texts] == ['cycle 102, user 2, codebook cb']
    (polar,) = [axes for axes in figure.axes if axes.name == 'polar']
    assert polar.get_title() == 'data beam to user 2, band 0 [dB]'
    assert [text.get_text() for text in polar.get_legend().get_texts()] == [
        'over azimuth', 'over elevation']
    assert {line.get_color() for line in polar.lines} == {look(1).colour}
    # Matplotlib would draw lower levels on the opposite side.
    for line in polar.lines:
        assert line.get_ydata().max() == pytest.approx(0, abs=1e-9)
        assert line.get_ydata().min() == pytest.approx(MIN_LEVEL_DB)
    (above,) = [axes for axes in figure.axes if axes.get_ylabel() == '$y$ [m]']
    assert [to_hex(patch.get_facecolor()).upper() for patch in above.patches
            if type(patch) is Polygon] == [look(1).colour]


@pytest.mark.slow
def test_a_rectangular_surface_is_shown_from_the_front():
    """Twelve columns along y and three rows along z, over a flat region."""
    scenario = Scenario(elements_per_side=(12, 3), roi_size_m=(10.0, 10.0, 0.0))
    scene, configuration = make_scene(scenario, 1), np.linspace(0, 1, 36)[None]
    scene.add(m.RhsConfiguration(
        cycle_id=1, mode=m.Mode.TRANSMISSION, band=0, codebook_id='cb', analog=configuration), 0.0)
    (axes,) = [axes for axes in compose_scene(scene, scenario).axes if axes.images]
    (image,) = axes.images
    # Rows increase with z, and columns with y, which points to the right from the front.
    assert image.origin == 'lower'
    np.testing.assert_array_equal(image.get_array(), configuration.reshape(3, 12))
    left, right, bottom, top = image.get_extent()
    assert (right - left) / (top - bottom) == pytest.approx(4)
    assert (left, bottom) == (-right, -top) < (0, 0)


@pytest.mark.slow
def test_an_empty_scene_is_drawn(small, tmp_path):
    write_picture(tmp_path / 'scene.png', compose_scene(SceneState(), small.scenario))


@pytest.fixture(scope='module')
def panels(make_cycles):
    """The axes of the legend, the view and the errors of 20 cycles, after drawing."""
    figure = compose_cycles(make_cycles(20), Scenario())
    FigureCanvasAgg(figure).draw()
    return figure.axes


@pytest.mark.slow
def test_every_cycle_has_its_number_beside_its_true_position(panels, make_cycles):
    numbers = [text for text in panels[1].texts if isinstance(text, Annotation)
               and text.get_text().isdigit()]
    assert {text.get_text(): tuple(text.xy) for text in numbers} == {
        str(cycle.cycle_id): pytest.approx(cycle.truth.position[:2])
        for cycle in make_cycles(20)}


def test_a_line_joins_each_true_position_and_its_estimate(panels, make_cycles):
    # The surface is a line at x = 0.
    joined = [line.get_xydata().tolist() for line in panels[1].lines
              if len(line.get_xydata()) == 2 and line.get_xdata().any()]
    cycles = make_cycles(20)
    np.testing.assert_allclose(sorted(joined), sorted(
        [one.position[:2].tolist() for one in (cycle.truth, cycle.estimate)] for cycle in cycles))


def test_the_errors_and_their_bounds_are_in_the_order_of_the_cycles(panels):
    errors = panels[2]
    assert (errors.get_xlabel(), errors.get_ylabel(), errors.get_yscale()) == (
        'cycle', '[m]', 'log')
    for line, (first, level) in zip(errors.lines, ((2, 0.5), (2, 0.2), (3, 0.5), (3, 0.2)),
                                    strict=True):
        assert line.get_xdata().tolist() == list(range(first, first + 20, 2))
        assert line.get_ydata() == pytest.approx([level] * 10)


def test_an_ellipse_beyond_all_bounds_does_not_shrink_the_region(make_cycles):
    cycles = make_cycles(2)
    object.__setattr__(cycles[0].estimate, 'covariance_m2', 1e6 * np.eye(3))
    view = compose_cycles(cycles, Scenario()).axes[1]
    assert np.diff(view.get_xlim()) < 25


@pytest.mark.slow
def test_of_many_cycles_and_users_only_some_are_labelled(make_cycles):
    legend, view, _ = compose_cycles(make_cycles(150, n_users=9), Scenario()).axes
    assert [text.get_text() for text in legend.get_legend().get_texts()][-2:] == [
        'user 6', 'and 3 more users']
    assert len([text for text in view.texts if text.get_text().isdigit()]) == 50
