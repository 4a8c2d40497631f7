"""Picture of the demonstration: the view from above, and the order of the cycles."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.text import Annotation

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.tools.pictures import compose_cycles, draw_cycles

COVARIANCE_M2 = np.array([[0.6, 0.2, 0.05], [0.2, 0.3, 0.0], [0.05, 0.0, 0.1]])


def make_cycles(n, n_users=2, first=2):
    """Return cycles of users in turn, of which each walks through the region."""
    cycles = []
    for k in range(n):
        cycle_id, user = first + k, 1 + k % n_users
        truth = np.array([6.0 + 8 * k / n, 3.0 - user % 5, 0.5])
        cycles.append(CompleteCycle(
            cycle_id, user,
            truth=m.GroundTruth(cycle_id=cycle_id, user=user, position=truth,
                                velocity=np.zeros(3)),
            signals=m.ReceivedSignals(cycle_id=cycle_id, user=user, codebook_id='cb',
                                      signals=np.zeros((2, 8, 4), complex)),
            estimate=m.PositionEstimate(
                cycle_id=cycle_id, user=user, codebook_id='cb', position=truth + [0.3, 0.4, 0],
                covariance_m2=COVARIANCE_M2, crlb_m2=0.04, estimator='bayes', latency_s=0.01),
            capacity=m.Capacity(cycle_id=cycle_id, user=user, codebook_id='cb', band=0,
                                expected_bps=1e6, at_estimate_bps=1e6, actual_bps=1e6,
                                perfect_bps=1e6, loss_bps=0.0, loss_percent=0.0)))
    return cycles


@pytest.fixture(scope='module')
def panels():
    """The axes of the legend, the view and the errors of 20 cycles, after drawing."""
    figure = compose_cycles(make_cycles(20), Scenario())
    FigureCanvasAgg(figure).draw()
    return figure.axes


def test_every_cycle_has_its_number_beside_its_true_position(panels):
    numbers = [text for text in panels[1].texts if isinstance(text, Annotation)
               and text.get_text().isdigit()]
    assert {text.get_text(): tuple(text.xy) for text in numbers} == {
        str(cycle.cycle_id): pytest.approx(cycle.truth.position[:2])
        for cycle in make_cycles(20)}


def test_the_errors_and_their_bounds_are_in_the_order_of_the_cycles(panels):
    errors = panels[2]
    assert (errors.get_xlabel(), errors.get_ylabel(), errors.get_yscale()) == (
        'cycle', '[m]', 'log')
    for line, (first, level) in zip(errors.lines, ((2, 0.5), (2, 0.2), (3, 0.5), (3, 0.2)),
                                    strict=True):
        assert line.get_xdata().tolist() == list(range(first, first + 20, 2))
        assert line.get_ydata() == pytest.approx([level] * 10)


def test_the_view_fills_the_page_and_shows_region_and_ellipses_whole(panels):
    view, errors = panels[1:]
    assert view.get_aspect() == 1.0
    # No blank bands: as wide as the panel below, which has no aspect.
    assert view.get_position().width > 0.9 * errors.get_position().width
    (region,) = [patch for patch in view.patches if type(patch) is Rectangle]
    low, high = Scenario().roi_bounds_m[:, :2]
    assert region.get_xy() == pytest.approx(tuple(low))
    ellipses = [patch for patch in view.patches if isinstance(patch, Ellipse)]
    assert len(ellipses) == 20
    (left, right), (bottom, top) = view.get_xlim(), view.get_ylim()
    assert left < 0 and right > high[0] and bottom < low[1] and top > high[1]
    page = view.bbox.padded(1)
    for patch in ellipses:
        box = patch.get_path().transformed(patch.get_transform()).get_extents()
        assert page.contains(*box.min) and page.contains(*box.max)


def test_the_legend_has_every_mark_and_user(panels):
    assert [text.get_text() for text in panels[0].get_legend().get_texts()] == [
        'region of interest', 'true position, with its cycle', 'order of the cycles',
        'estimate', '95 % of the posterior', 'position error', '√CRLB', 'user 1', 'user 2']


def test_an_ellipse_beyond_all_bounds_does_not_shrink_the_region():
    cycles = make_cycles(2)
    object.__setattr__(cycles[0].estimate, 'covariance_m2', 1e6 * np.eye(3))
    view = compose_cycles(cycles, Scenario()).axes[1]
    assert np.diff(view.get_xlim()) < 25


def test_of_many_cycles_and_users_only_some_are_labelled():
    legend, view, _ = compose_cycles(make_cycles(150, n_users=9), Scenario()).axes
    assert [text.get_text() for text in legend.get_legend().get_texts()][-2:] == [
        'user 6', 'and 3 more users']
    assert len([text for text in view.texts if text.get_text().isdigit()]) == 50


def test_a_single_cycle_is_drawn(tmp_path):
    draw_cycles(make_cycles(1), Scenario(), tmp_path / 'demo.svg')
    assert (tmp_path / 'demo.svg').read_bytes().startswith(b'<?xml')
