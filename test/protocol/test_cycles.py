"""Whole cycles of all roles, without faults."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest
from in_memory_network import Fault, Network

from rhs_isac_ros.model import Pose, Scenario, mobility
from rhs_isac_ros.model.elementwise import Paper
from rhs_isac_ros.model.geometry import frames_s
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState
from rhs_isac_ros.protocol.settings import TRACK, PositionerSettings

# Messages of one cycle with two bands of two frames.
OF_A_CYCLE = [m.Beacon, m.Ack, m.Grant, m.RhsCommand, m.RhsCommand, m.RhsConfiguration,
              m.RhsConfiguration, m.PilotRequest, m.Pilot, m.Pilot, m.FeedSignals, m.FeedSignals,
              m.ReceivedSignals, m.PositionEstimate, m.Beam, m.RhsConfiguration,
              m.Data, m.Data, m.Data, m.Data]
BESIDES = (m.ProtocolState, m.GroundTruth, m.Capacity, m.CapacityStatistics)


def of_cycle(network, cycle_id):
    return [sent.message for sent in network.log if sent.message.cycle_id == cycle_id]


def test_the_messages_of_a_cycle_follow_the_order_of_the_protocol(network):
    net = network()
    net.run_cycles(3)
    for cycle_id in (1, 2, 3):
        sent = of_cycle(net, cycle_id)
        assert [type(s) for s in sent if not isinstance(s, BESIDES)] == OF_A_CYCLE
        besides = [s for s in sent if isinstance(s, BESIDES)]
        assert [type(s) for s in besides] == [
            m.ProtocolState, m.GroundTruth, m.ProtocolState, m.ProtocolState, m.ProtocolState,
            m.Capacity, m.CapacityStatistics]
        assert [s.phase for s in besides if isinstance(s, m.ProtocolState)] == [
            m.Phase.POSITIONING, m.Phase.ESTIMATING, m.Phase.TRANSMITTING, m.Phase.BEACONING]
    assert net.outcomes() == [(1, 1, 'served'), (2, 1, 'served'), (3, 1, 'served')]
    net.verify()


@pytest.fixture(scope='module')
def placed(scenario, codebooks):
    """Two networks that differ in the pose of the surface, and the second pose."""
    pose = Pose((3.0, 12.0, 1.5), (0.1, -0.2, -0.7, 0.6))
    nets = []
    for scenario_ in (scenario, dataclasses.replace(scenario, pose=pose)):
        walk = mobility.Waypoints([[8.0, -2.0, 0.5], [9.0, 2.0, 0.0]], 1.0)
        net = Network(
            scenario_, codebooks[0], {1: walk}, positioner=PositionerSettings(prior=TRACK),
            make=functools.partial(make_estimator, 'bayes', scenario_), plain_beams=False)
        net.run_cycles(2)
        nets.append(net)
    return *nets, pose


def test_the_pose_of_the_surface_moves_positions_and_changes_nothing_else(placed):
    one, other, pose = placed
    assert [type(sent.message) for sent in one.log] == [type(sent.message) for sent in other.log]
    for before, after in zip((sent.message for sent in one.log),
                             (sent.message for sent in other.log), strict=True):
        moves = {'position': pose.to_site, 'velocity': pose.vectors_to_site,
                 'covariance_m2': pose.covariances_to_site}
        for field in dataclasses.fields(before):
            expected, found = (getattr(message, field.name) for message in (before, after))
            if isinstance(expected, np.ndarray | float):
                if field.name in moves:
                    expected = moves[field.name](expected)
                np.testing.assert_allclose(
                    found, expected, rtol=1e-6, atol=1e-6 * np.nanmax(np.abs(expected)),
                    err_msg=f'{type(before).__name__}.{field.name}')
            elif field.name != 'scenario_id':
                assert found == expected


def test_a_track_is_in_the_frame_of_the_site(placed):
    one, other, pose = placed
    assert len(one.tracks) == len(other.tracks) == 2
    for before, after in zip(one.tracks, other.tracks, strict=True):
        # The estimate contains the errors of the pose already.
        expected = before.estimate.to_site(dataclasses.replace(pose, uncertainty=(0.0, 0.0)))
        for name in ('mean', 'covariance', 'velocity', 'velocity_covariance'):
            np.testing.assert_allclose(
                getattr(after.estimate, name), getattr(expected, name), rtol=1e-6, atol=1e-6)
        truths = [truth.position for truth in other.sent(m.GroundTruth)]
        assert any(np.linalg.norm(after.estimate.mean - truth) < 3 for truth in truths)


def test_data_beyond_the_true_capacity_are_lost(network):
    net = network(5, plain_beams=False)
    net.run_cycles(5)
    limited = []
    for report in net.sent(m.Capacity):
        ways = [(m.Direction.DOWNLINK, m.Stage.OFFERED), (m.Direction.DOWNLINK, m.Stage.DELIVERED),
                (m.Direction.UPLINK, m.Stage.OFFERED), (m.Direction.UPLINK, m.Stage.DELIVERED)]
        data = net.sent(m.Data, cycle_id=report.cycle_id)
        assert [(d.direction, d.stage) for d in data] == ways
        assert {d.user for d in data} == {report.user}
        assert {d.duration_s for d in data} == {1e-3}
        bits = [d.bits for d in data]
        assert bits[0] == int(report.expected_bps * 1e-3)
        assert bits[1] == min(bits[0], int(report.actual_bps * 1e-3))
        assert bits[2] == bits[3] == bits[1]
        limited.append(bits[1] < bits[0])
    assert any(limited)


def test_the_same_seed_gives_the_same_run(network):
    first, second = (network(3, policy='random', seed=3) for _ in range(2))
    for net in (first, second):
        net.run_cycles(8)
    assert first.outcomes() == second.outcomes()
    for a, b in zip(first.sent(m.ReceivedSignals), second.sent(m.ReceivedSignals), strict=True):
        np.testing.assert_array_equal(a.signals, b.signals)


def test_positions_outside_a_cycle_change_nothing(network, example):
    net, plain = (network(plain_beams=False) for _ in range(2))
    for state in (BsState.CONFIGURING, BsState.SOUNDING, BsState.STEERING, BsState.TRANSMITTING):
        net.run_to(state)
        for user in (1, 9):
            net.publish(example(m.GroundTruth, cycle_id=0, user=user))
    for other in (net, plain):
        other.run_cycles(1)
    assert net.outcomes() == plain.outcomes() == [(1, 1, 'served')]
    assert net.sent(m.Capacity)[0].actual_bps == plain.sent(m.Capacity)[0].actual_bps
    net.verify()


def test_the_position_is_estimated_without_the_true_one(network, places):
    """A false true position changes nothing but the reported losses."""
    honest, deceived = (network(plain_beams=False, **lie) for lie in ({}, {'transport': Fault(
        m.GroundTruth, 'transmission', 1e-3,
        alter=lambda truth: dataclasses.replace(truth, position=places[4]))}))
    for net in (honest, deceived):
        net.run_cycles(1)
    for kind, field in ((m.ReceivedSignals, 'signals'), (m.PositionEstimate, 'position'),
                        (m.Beam, 'analog'), (m.Beam, 'digital')):
        a, b = (getattr(net.sent(kind)[0], field) for net in (honest, deceived))
        np.testing.assert_array_equal(a, b)
    assert honest.sent(m.Capacity)[0].actual_bps != deceived.sent(m.Capacity)[0].actual_bps


def test_one_band_and_one_frame_are_enough(random_beams):
    scenario = Scenario(
        center_frequencies_hz=(2.5e9,), n_subbands=1, n_frames=1, n_feeds=1, elements_per_side=4)
    codebook = random_beams(scenario, np.random.default_rng(0))
    net = Network(scenario, codebook, {1: (9.0, 1.0, 0.3)})
    net.run_cycles(3)
    assert net.served() == [1, 1, 1]
    net.verify()


def test_a_board_may_take_longer_for_its_frames_than_all_steps(scenario, codebooks, places):
    slow = dataclasses.replace(scenario, frame_duration_s=1.0)
    net = Network(slow, codebooks[0], {1: places[1]}, step_timeout_s=0.1, retries=1,
                  transport=Fault(m.FeedSignals, 'bs', frames_s(slow)))
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert len(net.sent(m.PilotRequest)) == 2
    assert not any(net[name].counters for name in ('bs', 'user1'))


def test_a_cycle_of_table_1_finds_the_user(shipped, table1_estimator):
    """The paper's scenario with the shipped codebook and the default estimator."""
    scenario = Scenario()
    net = Network(
        scenario, shipped, {1: (9.0, 1.5, 0.4), 2: (6.0, -3.0, -0.5)},
        make=lambda codebook: table1_estimator, plain_beams=False)
    net.run_cycles(3)
    assert net.served() == [1, 2, 1]
    net.verify()
    for truth, estimate, report in zip(
            net.sent(m.GroundTruth), net.sent(m.PositionEstimate), net.sent(m.Capacity),
            strict=True):
        error = np.abs(estimate.position - truth.position)
        assert (error < 4 * np.sqrt(np.diag(estimate.covariance_m2))).all()
        assert 0 < estimate.crlb_m2 < 0.1
        assert estimate.estimator == 'bayes'
        assert report.expected_bps == pytest.approx(report.actual_bps, rel=0.05)
        assert 0 <= report.loss_percent < 1


def test_a_plug_in_that_fails_once_at_any_call_costs_at_most_one_cycle(random_beams):
    calls, fails_at = itertools.count(1), set()

    def call():
        if next(calls) in fails_at:
            raise RuntimeError('short circuit')

    class Own(Paper):
        kind = 'fragile'

        def coefficients(self, ports, tunings):
            call()
            return super().coefficients(ports, tunings)

    class Still:
        def state(self, now_s):
            call()
            return np.array([9.0, 1.0, 0.3]), np.zeros(3)
    scenario = Scenario(center_frequencies_hz=(2.5e9,), n_subbands=1, n_frames=2, n_feeds=1,
                        elements_per_side=4, board=Own)
    codebook = random_beams(scenario, np.random.default_rng(0))
    net = Network(scenario, codebook, {1: Still()})
    net.run_cycles(1)
    begin = next(calls)
    net.run_cycles(1)
    n_calls = next(calls) - begin
    assert n_calls > 3
    for number in range(1, n_calls):
        fails_at.add(next(calls) + number)
        net.run_cycles(2)
        faults = sum(count.get('plugin_fault', 0) for count in net.counters().values())
        assert (faults, net.ends()[-1]) == (number, 'served')
    texts = ''.join(text for name in ('user1', 'channel') for text in net.logged_texts(name))
    assert "raise RuntimeError('short circuit')" in texts
