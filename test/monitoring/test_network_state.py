"""The state of a network, from messages of networks without ROS and from single ones."""

import math

import numpy as np
import pytest

from rhs_isac_ros.monitoring.cycle_log import RECEIVES
from rhs_isac_ros.monitoring.network_state import RESTING, Overview, SceneState
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.protocol import messages as m


def overview_of(net, until_s=np.inf):
    overview = Overview()
    for sent in net.log:
        if isinstance(sent.message, RECEIVES) and sent.time_s <= until_s:
            overview.add(sent.message, sent.time_s)
    return overview


def test_users_have_the_results_of_their_latest_cycle(network, codebooks):
    net = network(users=2, rest_s=0.5)
    net.run_cycles(4)
    overview = overview_of(net)
    assert {user: cycle.user for user, cycle in overview.users.items()} == {1: 1, 2: 2}
    assert {cycle.cycle_id for cycle in overview.users.values()} == {3, 4}
    for cycle in overview.users.values():
        assert cycle.error_m == np.linalg.norm(cycle.estimate.position - cycle.truth.position)
        assert cycle.sigma_m == pytest.approx(np.sqrt(np.trace(cycle.estimate.covariance_m2)))
    assert (overview.served, overview.given_up, overview.last_failure) == (4, 0, '')
    assert overview.codebook_id == codebooks[0].id
    assert (overview.phase, overview.cycle_id) == (RESTING, 4)


def test_the_numbers_of_users_and_nodes_are_bounded():
    overview = Overview()
    for number in range(1, 4098):
        overview.add(m.GroundTruth(
            cycle_id=1, user=number, position=np.ones(3), velocity=np.zeros(3)), 0.0)
        overview.add_report(f'node_{number}', Report(False, '', {}), 0.0)
    assert len(overview.users) == len(overview.nodes) == 4096


def test_phases_follow_each_other_and_have_their_start_times(network):
    net = network(rest_s=0.5)
    net.run_cycles(2)
    seen = {}
    overview = Overview()
    for sent in net.log:
        if isinstance(sent.message, RECEIVES):
            overview.add(sent.message, sent.time_s)
            seen.setdefault((overview.cycle_id, overview.phase), overview.phase_began_s)
    names = ['beaconing', 'positioning', 'estimating', 'transmitting', RESTING]
    assert list(seen) == [(cycle, name) for cycle in (1, 2) for name in names]
    starts = {(sent.message.cycle_id, sent.message.phase.name.lower()): sent.time_s
              for sent in net.log if isinstance(sent.message, m.ProtocolState)
              and not sent.message.outcome}
    assert starts.items() <= seen.items()


def test_the_rate_is_averaged_over_ten_seconds(example):
    overview = Overview()
    for cycle_id in range(1, 101):
        now_s = 0.5 * cycle_id
        overview.add(m.Beacon(cycle_id=cycle_id, attempt=0), now_s - 0.1)
        overview.add(example(m.ProtocolState, cycle_id=cycle_id, outcome='served'), now_s)
        if cycle_id == 4:
            assert overview.rate_hz(2.4) == pytest.approx(4 / 2.0)
    assert overview.rate_hz(50.2) == pytest.approx(2.0)
    assert overview.rate_hz(58.2) == pytest.approx(0.4)
    assert overview.rate_hz(99.0) == 0


def test_the_overview_does_not_grow_with_the_cycles(network):
    net = network()
    net.run_cycles(30)
    overview = overview_of(net)
    assert overview.served == 30
    assert len(overview.users) == 1
    assert (overview._log.complete, overview._log.ended) == ([], [])
    overview.rate_hz(1e9)
    assert not overview._served_s


# The scene


def truth(user, position, cycle_id=0):
    return m.GroundTruth(
        cycle_id=cycle_id, user=user, position=np.array(position, float), velocity=np.zeros(3))


def estimate(user, position, cycle_id):
    return m.PositionEstimate(
        cycle_id=cycle_id, user=user, codebook_id='cb', position=np.array(position, float),
        covariance_m2=np.eye(3), crlb_m2=0.1, estimator='bayes', latency_s=0.01)


def beam(user, cycle_id=1):
    return m.Beam(
        cycle_id=cycle_id, user=user, codebook_id='cb', band=0, analog=np.ones(4),
        digital=np.ones((2, 2), complex), expected_bps=1e6)


def test_the_scene_is_complete_once_every_user_has_an_estimate():
    scene = SceneState()
    for message in (m.RhsConfiguration(
        cycle_id=1, mode=m.Mode.POSITIONING, band=0, codebook_id='cb', analog=np.ones((3, 4))),
                    truth(1, [9, 0, 0]), truth(2, [8, 0, 0]), estimate(1, [9, 1, 0], 1)):
        scene.add(message, 1.0)
        assert not scene.complete
    assert not scene.drawable
    scene.add(beam(1), 1.0)
    assert scene.drawable and not scene.complete
    assert scene.without_estimate == [2]
    scene.add(estimate(2, [8, 1, 0], 2), 1.0)
    assert scene.complete
    # User and beam belong to the same cycle, although the other user has a later estimate.
    assert (scene.shown_user.user, scene.shown_beam.user) == (1, 1)
    scene.add(estimate(1, [9, 1, 0], 3), 1.0)
    assert (scene.shown_user.user, scene.shown_beam) == (1, None)
    assert not scene.complete
    scene.add(beam(1, 3), 1.0)
    assert scene.complete


def test_the_number_of_users_is_bounded():
    scene, places = SceneState(), np.ones((4097, 3))
    scene.add(m.GroundTruths(
        cycle_id=0, users=np.arange(1, 4098), position=places, velocity=0 * places), 1.0)
    for user in (5000, 5001, 1):
        scene.add(estimate(user, [9, 0, 0], 1), 2.0)
    assert list(scene.users) == [*range(1, 4097)]
    assert scene.users[1].estimate
    # The place of a user that has left is free for another.
    assert scene.discard_stale(1.5) == [*range(2, 4097)]
    scene.add(truth(5000, [9, 0, 0]), 2.0)
    assert list(scene.users) == [1, 5000]


def test_an_error_needs_the_true_position_of_its_cycle():
    scene = SceneState()
    scene.add(estimate(1, [9, 3, 4], 5), 0.0)
    assert math.isnan(scene.users[1].error_m)
    for message in (truth(1, [9, 0, 0], cycle_id=5), truth(1, [7, 0, 0])):
        scene.add(message, 0.0)
        assert scene.users[1].error_m == pytest.approx(5.0)
    scene.add(truth(1, [7, 0, 0], cycle_id=6), 0.0)
    assert math.isnan(scene.users[1].error_m)
    assert scene.users[1].truth.position[0] == 7


def test_paths_skip_small_steps_and_are_bounded():
    scene = SceneState()
    for step in (0.0, 0.01, 0.02, 0.5, 0.5):
        scene.add(truth(1, [9 + step, 0, 0]), 0.0)
    assert [place[0] for place in scene.users[1].true_path] == [9.0, 9.5]
    for cycle_id in range(1, 1001):
        scene.add(estimate(1, [cycle_id, 0, 0], cycle_id), 0.0)
    assert [place[0] for place in scene.users[1].estimated_path] == list(range(801, 1001))


def test_a_silent_user_is_discarded_with_its_beam():
    scene = SceneState()
    for user, time_s in ((1, 1.0), (2, 2.0)):
        scene.add(truth(user, [9, 0, 0]), time_s)
    scene.add(beam(1), 1.0)
    assert scene.discard_stale(1.0) == []
    assert scene.beam.user == 1
    scene.add(estimate(2, [9, 0, 0], 1), 3.0)
    assert scene.discard_stale(2.5) == [1]
    assert list(scene.users) == [2]
    assert scene.beam is None
    scene.add(beam(2), 3.0)
    scene.add(truth(1, [5, 0, 0]), 3.0)
    assert scene.discard_stale(2.5) == []
    assert scene.beam.user == 2
    scene.add(truth(2, [9, 0, 0]), 5.0)
    scene.add(truth(1, [5, 0, 0]), 5.0)
    assert scene.discard_stale(4.0) == []
    assert scene.beam is None
    assert len(scene.users[1].true_path) == 1
