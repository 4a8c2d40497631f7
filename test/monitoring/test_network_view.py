"""The view of a network in memory: what it shows, on which path, and from which cycle on."""

import dataclasses
import re
import types

import numpy as np
import pytest

from rhs_isac_ros.model import Pose
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.monitoring import network_view
from rhs_isac_ros.monitoring.network_view import RECEIVES, NetworkView
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.monitoring.shapes import Clear, Number, Series, Text
from rhs_isac_ros.protocol import messages as m

N_CYCLES = 4


def messages_of(run):
    return [sent for sent in run.log if isinstance(sent.message, RECEIVES)]


@pytest.fixture
def watched(network, scenario):
    """A network of two users after some cycles, its view, and the entries of the view."""
    run = network(users=2)
    run.run_cycles(N_CYCLES)
    view = NetworkView(scenario)
    entries = [*view.begin()]
    for sent in messages_of(run):
        entries += view.add(sent.message, sent.time_s)
    return types.SimpleNamespace(run=run, view=view, entries=entries)


def on(entries, path):
    """Cycles and entities on a path, in order."""
    return [(entry.cycle, entry.entity) for entry in entries if entry.path == path]


def test_cycles_are_counted_from_one(watched):
    ids = [cycle for cycle, _, _ in watched.run.outcomes()]
    assert watched.view.n_cycles >= watched.view.n_ended == N_CYCLES
    logged = on(watched.entries, network_view.LOG)
    assert [cycle for cycle, _ in logged] == list(range(1, N_CYCLES + 1))
    for (_, text), cycle_id in zip(logged, ids, strict=True):
        assert re.fullmatch(rf'user [12]: error .* \(cycle {cycle_id}\)', text.text)


def test_the_log_names_doubts_about_a_position(watched, scenario):
    view = NetworkView(scenario)
    for sent in messages_of(watched.run):
        message = sent.message
        if isinstance(message, m.PositionEstimate):
            message = dataclasses.replace(
                message, outside_probability=0.004, blocked_probability=0.12)
        for _, text in on(view.add(message, sent.time_s), network_view.LOG):
            assert re.search(r'loss .* %, blocked 12 %, codebook cb\w{16} \(cycle', text.text)
    assert view.n_ended == N_CYCLES


def test_truth_and_estimate_are_those_of_the_messages(watched):
    for estimate in watched.run.sent(m.PositionEstimate):
        path = f'{network_view.WORLD}/user_{estimate.user}'
        assert any((entity.positions[0] == estimate.position).all()
                   for _, entity in on(watched.entries, f'{path}/estimate'))
        truths = [entity.positions[0] for _, entity in on(watched.entries, f'{path}/truth')]
        for truth in watched.run.sent(m.GroundTruth, user=estimate.user):
            assert any((shown == truth.position).all() for shown in truths)


def test_the_surface_is_placed_once_and_its_shapes_are_below_it(scenario):
    pose = Pose((1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 1.0))
    placed = NetworkView(dataclasses.replace(scenario, pose=pose)).begin()
    ((cycle, placement),) = on(placed, network_view.SURFACE)
    assert cycle == 0
    np.testing.assert_array_equal(placement.origin, pose.origin)
    np.testing.assert_array_equal(placement.rotation, pose.rotation)
    ((_, region),) = on(placed, f'{network_view.SURFACE}/region')
    np.testing.assert_array_equal(region.centres[0], scenario.roi_center_m)


def test_the_board_shows_each_configuration(watched, scenario):
    sent = watched.run.sent(m.RhsConfiguration)
    shown = on(watched.entries, f'{network_view.SURFACE}/board')
    assert len(shown) == len(sent)
    for (_, board), message in zip(shown, sent, strict=True):
        assert board.centres / board.centres.max() == pytest.approx(
            element_positions(scenario) / element_positions(scenario).max())
        assert board.colours[:, 0] == pytest.approx(message.analog.mean(axis=0))
    side = scenario.elements_per_side
    (_, picture), *_ = on(watched.entries, network_view.TRANSMISSION)
    analog = next(message.analog for message in sent if message.mode is m.Mode.TRANSMISSION)
    # The first element is at the bottom left.
    assert picture.pixels.shape == (side, side)
    assert picture.pixels[-1, 0] == round(255 * analog[0, 0])
    assert picture.pixels[0, -1] == round(255 * analog[0, -1])
    _, codebook = on(watched.entries, network_view.POSITIONING)[-1]
    assert codebook.pixels.shape == (
        scenario.n_bands * (side + 1) - 1, scenario.n_frames * (side + 1) - 1)


def test_charts_show_each_served_cycle(watched):
    errors = sorted(
        (entry.cycle, entry.entity.value) for entry in watched.entries
        if entry.path.startswith('error/user_') and isinstance(entry.entity, Number))
    assert [cycle for cycle, _ in errors] == list(range(1, N_CYCLES + 1))
    truths = {truth.cycle_id: truth.position for truth in watched.run.sent(m.GroundTruth)}
    expected = [np.linalg.norm(estimate.position - truths[estimate.cycle_id])
                for estimate in watched.run.sent(m.PositionEstimate)][:N_CYCLES]
    assert [value for _, value in errors] == pytest.approx(expected)
    *_, (cycle, mean) = on(watched.entries, 'error/root_mean_square')
    assert (cycle, mean.value) == (
        N_CYCLES, pytest.approx(np.sqrt(np.mean(np.square(expected)))))
    crlbs = [entity.value for _, entity in on(watched.entries, 'error/crlb')
             if isinstance(entity, Number)]
    assert crlbs == pytest.approx([
        np.sqrt(sent.crlb_m2) for sent in watched.run.sent(m.PositionEstimate)][:N_CYCLES])


def test_charts_have_milliseconds_and_megabits(watched):
    (state,) = watched.run.sent(m.ProtocolState, cycle_id=1, phase=m.Phase.BEACONING)
    (capacity,) = watched.run.sent(m.Capacity, cycle_id=1)
    values = {entry.path: entry.entity.value for entry in reversed(watched.entries)
              if isinstance(entry.entity, Number)}
    phases = ('beaconing', 'positioning', 'estimating', 'transmitting')
    assert sum(values[f'latency/{phase}'] for phase in phases) == pytest.approx(
        1e3 * state.elapsed_s)
    assert values['capacity/actual'] == pytest.approx(1e-6 * capacity.actual_bps)


def test_the_bars_of_the_modes_are_at_the_errors_of_their_ranges(watched):
    received = watched.run.sent(m.ReceivedSignals)[0]
    (truth,) = watched.run.sent(m.GroundTruth, cycle_id=received.cycle_id, user=received.user)
    sight = truth.position / np.linalg.norm(truth.position)
    probabilities = np.array([0.7, 0.299, 0.001])
    posterior = m.Posterior(
        cycle_id=received.cycle_id, user=received.user, codebook_id='cb',
        log_weights=np.log(probabilities), means=np.stack([
            truth.position, truth.position + 0.6 * sight, truth.position - 1.2 * sight]),
        covariances_m2=np.tile(np.eye(3), (3, 1, 1)), log_evidence=0.0,
        missing_probability=0.001, surface_position_m=np.zeros(3),
        surface_quaternion=np.array([0.0, 0.0, 0.0, 1.0]), surface_uncertainty=np.zeros((6, 6)))
    entries = watched.view.add(posterior, 0.0)
    ((cycle, bars),) = on(entries, f'{network_view.MODES}/found')
    assert cycle == 1
    assert np.array([bar[1, 0] for bar in bars.strips]) == pytest.approx([0, 0.6, -1.2])
    heights = np.array([-bar[1, 1] for bar in bars.strips])
    assert heights / heights.sum() == pytest.approx(probabilities)
    # In the scene, those of little probability are left out.
    ((_, balls),) = on(entries, f'{network_view.WORLD}/user_{received.user}/modes')
    assert balls.positions == pytest.approx(posterior.means[:2])
    assert balls.radii_m[0] > balls.radii_m[1]


def test_signals_without_a_position_end_what_was_shown_of_the_user(watched):
    received = watched.run.sent(m.ReceivedSignals)[-1]
    entries = watched.view.add(m.NoFix(
        cycle_id=received.cycle_id, user=received.user, codebook_id='cb', reason='noise'), 99.0)
    path = f'{network_view.WORLD}/user_{received.user}'
    for part in (f'{path}/estimate', f'{path}/modes', f'{network_view.MODES}/found'):
        assert all(isinstance(entity, Clear) for _, entity in on(entries, part))
        assert on(entries, part)


def test_a_track_continues(watched):
    path = f'{network_view.WORLD}/user_1/track'
    for step in range(3):
        entries = watched.view.add_track(
            1, np.array([9.0, step, 0.0]), np.eye(3), np.array([0.0, 1.0, 0.0]))
    ((cycle, lines),) = on(entries, path)
    assert cycle == watched.view.n_cycles
    places, velocity = lines.strips
    assert places == pytest.approx(np.array([[9, 0, 0], [9, 1, 0], [9, 2, 0]]))
    assert velocity == pytest.approx(np.array([[9, 2, 0], [9, 3, 0]]))


def test_a_cycle_that_is_given_up_is_a_warning_and_counted(network, scenario):
    run = network(users=1)
    run.run_cycles(1)
    run.remove('positioner', noticed=False)
    run.run_cycles(2)
    view = NetworkView(scenario)
    entries = [entry for sent in messages_of(run) for entry in view.add(sent.message, sent.time_s)]
    warnings = [entity for _, entity in on(entries, network_view.LOG) if entity.warning]
    counts = [entity.value for _, entity in on(entries, 'drops/given_up')
              if isinstance(entity, Number)]
    assert all(isinstance(entity, Text) for entity in warnings)
    assert counts == list(range(1, len(warnings) + 1)) != []


def test_dropped_messages_are_shown_for_all_nodes_and_for_those_with_any(scenario):
    view = NetworkView(scenario)
    entries = view.add_report('lab/bs', Report(True, '', {
        'dropped.wrong_cycle': '3', 'dropped.duplicate': '1', 'sent.Beacon': '7'}))
    entries += view.add_report('lab/user_1', Report(False, '', {}))
    values = {entry.path: entry.entity.value for entry in entries
              if isinstance(entry.entity, Number)}
    assert {path: value for path, value in values.items() if path not in (
        'drops/low', 'drops/high')} == {'drops/bs': 4, 'drops/all': 4}


def test_dots_at_the_limits_of_a_chart_are_shown_whole(watched):
    for chart in network_view.TITLES:
        values = {path: [entity.value for _, entity in on(watched.entries, path)
                         if isinstance(entity, Number)]
                  for path in {entry.path for entry in watched.entries}
                  if path.startswith(f'{chart}/')}
        if not values:
            continue
        low, high = values.pop(f'{chart}/low'), values.pop(f'{chart}/high')
        shown = [value for found in values.values() for value in found]
        margin = 0.05 * (max(shown) - min(shown))
        assert (min(low), max(high)) == pytest.approx((min(shown) - margin, max(shown) + margin))
        for path in f'{chart}/low', f'{chart}/high':
            _, style = on(watched.entries, path)[0]
            assert style.name == ''


def test_the_legend_has_a_line_for_each_series(watched):
    names, lines = {}, set()
    for entry in watched.entries:
        kind, _, path = entry.path.partition('/')
        if isinstance(entry.entity, Series) and entry.entity.name and kind != 'loss':
            names[entry.path] = entry.entity.name
        elif kind == network_view.LEGEND:
            (place,), (label,) = entry.entity.positions.tolist(), entry.entity.labels
            assert names.pop(path) == label
            assert 0 <= place[1] < network_view.LEGEND_LINES
            assert place[1] not in lines
            lines.add(place[1])
    assert not names
    assert len(lines) > 8


def test_only_the_first_users_have_a_series_and_a_place_in_the_scene(network, scenario, places):
    run = network({user: places[0] for user in range(1, 7)})
    run.run_cycles(7)
    view = NetworkView(scenario)
    entries = [entry for sent in messages_of(run) for entry in view.add(sent.message, sent.time_s)]
    assert len({entry.path for entry in entries if entry.path.startswith('error/user_')}) == 4
    for path, n in (('error/root_mean_square', 7), ('error/others', 2)):
        assert len([entity for _, entity in on(entries, path) if isinstance(entity, Number)]) == n
    shown = [user for user in range(1, 200) if view.add(m.GroundTruth(
        cycle_id=0, user=user, position=np.ones(3), velocity=np.zeros(3)), 0.0)]
    assert shown == [*range(1, 65)]
