"""Whole cycles of all roles, without faults."""

import itertools
from pathlib import Path

import numpy as np
import pytest

import rhs_isac_ros
from rhs_isac_ros.link import Beam, capacity, choose_beam, expected_capacities, steer
from rhs_isac_ros.model import Scenario, mobility
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import State

pytestmark = pytest.mark.slow

PACKAGE = Path(rhs_isac_ros.__file__).parent
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


def test_without_faults_nothing_is_counted_or_logged(network):
    net = network()
    net.run_cycles(100)
    assert net.counters() == {}
    assert not any(logged.message.warning for logged in net.logs)


def test_bands_are_sounded_in_order(network, scenario, codebooks):
    net = network()
    net.run_cycles(1)
    assert [c.band for c in net.sent(m.RhsCommand)] == [0, 1]
    assert [(r.band, r.last_band, r.n_frames) for r in net.sent(m.PilotRequest)] == [(0, 1, 2)]
    assert [(p.band, len(p.symbols)) for p in net.sent(m.Pilot)] == [(0, 2), (1, 2)]
    reports = net.sent(m.RhsConfiguration, mode=m.Mode.POSITIONING)
    for band, report in enumerate(reports):
        np.testing.assert_array_equal(report.analog, codebooks[0].analog[band])
    (applied,) = net.sent(m.RhsConfiguration, mode=m.Mode.TRANSMISSION)
    (beam,) = net.sent(m.Beam)
    np.testing.assert_array_equal(applied.analog, [beam.analog])


def test_the_results_of_a_cycle_carry_its_number_user_and_codebook(network, codebooks):
    net = network(3)
    net.run_cycles(7)
    for kind in (m.ReceivedSignals, m.PositionEstimate, m.Beam, m.Capacity):
        results = net.sent(kind)
        assert [(r.cycle_id, r.user) for r in results] == [(c, u) for c, u, _ in net.outcomes()]
        assert {r.codebook_id for r in results} == {codebooks[0].id}
    net.verify()


def test_the_estimate_is_the_result_of_the_estimator(network, scenario):
    class Corner:
        name = 'corner'

        def estimate(self, received):
            seen.append(received)
            return Estimate(np.array([6.0, -2.0, 0.5]), np.diag([1.0, 2.0, 3.0]))

    seen = []
    net = network(make=lambda codebook: Corner())
    net.run_cycles(1)
    (estimate,), (signals,) = net.sent(m.PositionEstimate), net.sent(m.ReceivedSignals)
    assert (estimate.position == [6, -2, 0.5]).all()
    assert (estimate.covariance_m2 == np.diag([1, 2, 3])).all()
    assert estimate.estimator == 'corner'
    np.testing.assert_array_equal(seen[0], signals.signals.reshape(2, 6))
    (beam,) = net.sent(m.Beam)
    expected = choose_beam(scenario, estimate.position, estimate.covariance_m2).beam
    assert beam.band == expected.band
    np.testing.assert_array_equal(beam.analog, expected.analog)
    np.testing.assert_array_equal(beam.digital, expected.digital)


def test_the_capacities_are_those_of_the_beam(network, scenario, places):
    net = network()
    net.run_cycles(1)
    (sent,), (report,) = net.sent(m.Beam), net.sent(m.Capacity)
    (estimate,) = net.sent(m.PositionEstimate)
    beam = Beam(sent.analog, sent.digital, sent.band)
    assert report.band == sent.band
    assert report.expected_bps == sent.expected_bps == pytest.approx(
        expected_capacities(
            scenario, [beam], estimate.position, estimate.covariance_m2)[0])
    assert report.at_estimate_bps == pytest.approx(
        capacity(scenario, beam, estimate.position[None])[0])
    assert report.actual_bps == pytest.approx(capacity(scenario, beam, places[:1])[0])
    assert report.perfect_bps >= report.actual_bps
    assert report.perfect_bps >= capacity(scenario, steer(scenario, places[0]), places[:1])[0]
    assert report.loss_bps == report.perfect_bps - report.actual_bps
    assert report.loss_percent == pytest.approx(100 * report.loss_bps / report.perfect_bps)


def test_an_exact_estimate_has_no_capacity_loss(network, scenario):
    net = network({1: scenario.roi_center_m})
    net.run_cycles(1)
    (report,) = net.sent(m.Capacity)
    assert report.actual_bps == pytest.approx(report.at_estimate_bps)
    assert report.expected_bps < report.at_estimate_bps
    assert report.loss_bps == pytest.approx(0, abs=1e-6 * report.perfect_bps)


def test_data_beyond_the_true_capacity_are_lost(network):
    net = network(5)
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


@pytest.mark.parametrize('n_users', [1, 2, 5])
def test_round_robin_serves_every_user_once_per_round(network, n_users):
    net = network(n_users)
    # Until all users are registered, one may be served twice.
    net.run_cycles(4 * n_users)
    served = net.served()
    assert len(served) == 4 * n_users
    for start in range(1, len(served) - n_users + 1):
        assert set(served[start:start + n_users]) == set(range(1, n_users + 1))


def test_first_serves_the_first_user_to_answer(network):
    def prefer_2(message, recipient):
        late = isinstance(message, m.Ack) and message.user != 2
        return [(2e-3 if late else 1e-3, message)]

    net = network(3, policy='first', transport=prefer_2)
    net.run_cycles(6)
    assert net.served() == [2] * 6


def test_random_serves_every_user(network):
    net = network(3, policy='random')
    net.run_cycles(60)
    served = net.served()
    counts = [served.count(user) for user in (1, 2, 3)]
    assert sum(counts) == 60
    assert min(counts) >= 10
    rounds = [served[i:i + 3] for i in range(0, 60, 3)]
    assert any(len(set(r)) < 3 for r in rounds)


@pytest.mark.parametrize('policy', ['round_robin', 'first', 'random'])
def test_the_same_seed_gives_the_same_run(network, policy):
    first, second = network(3, policy=policy, seed=3), network(3, policy=policy, seed=3)
    for net in (first, second):
        net.run_cycles(8)
    assert first.outcomes() == second.outcomes()
    for a, b in zip(first.sent(m.ReceivedSignals), second.sent(m.ReceivedSignals), strict=True):
        np.testing.assert_array_equal(a.signals, b.signals)


def test_another_seed_gives_other_signals(network):
    first, second = network(seed=3), network(seed=4)
    for net in (first, second):
        net.run_cycles(1)
        net.verify()
    a, b = (net.sent(m.ReceivedSignals)[0].signals for net in (first, second))
    assert not np.isclose(a, b, rtol=1e-6).any()


def test_multipath_and_noise_differ_between_cycles(network):
    net = network()
    net.run_cycles(2)
    a, b = (signals.signals for signals in net.sent(m.ReceivedSignals))
    assert not np.isclose(a, b, rtol=1e-6).any()


@pytest.mark.parametrize('seed', range(6))
def test_signals_do_not_depend_on_the_order_of_messages(network, noisy, seed):
    """Multipath and noise are functions of seed, user and cycle only."""
    def by_cycle(net):
        net.run_cycles(8)
        net.verify()
        return {signals.cycle_id: signals.signals for signals in net.sent(m.ReceivedSignals)}

    calm = by_cycle(network())
    rough = by_cycle(network(transport=noisy(seed, jitter_s=0.02), ordered=False))
    assert len(calm) == 8
    assert len(rough) >= 4
    assert rough.keys() <= calm.keys()
    for cycle_id, signals in rough.items():
        np.testing.assert_array_equal(signals, calm[cycle_id])


def test_signals_of_a_cycle_do_not_depend_on_earlier_cycles(network):
    """Cycles with the same number have the same multipath and noise."""
    plain, rough = network(), network()
    rough.run_to(State.SOUNDING)
    rough.remove('user1')
    rough.run_cycles(1)
    rough.add('user1')
    for net in (plain, rough):
        net.run(lambda net=net: net.sent(m.ReceivedSignals, cycle_id=2))
    (a,), (b,) = (net.sent(m.ReceivedSignals, cycle_id=2) for net in (plain, rough))
    np.testing.assert_array_equal(a.signals, b.signals)


def test_the_position_of_a_moving_user_is_fixed_within_a_cycle(network, scenario):
    walk = mobility.RandomWalk(scenario, 50.0, np.random.default_rng(0))
    net = network({1: walk})
    net.run_cycles(10)
    truths = net.sent(m.GroundTruth)
    assert [truth.cycle_id for truth in truths] == list(range(1, 11))
    steps = [np.linalg.norm(b.position - a.position) for a, b in itertools.pairwise(truths)]
    assert min(steps) > 1.0
    net.verify()
    for truth, report, sent in zip(
            truths, net.sent(m.Capacity), net.sent(m.Beam), strict=True):
        beam = Beam(sent.analog, sent.digital, sent.band)
        actual = capacity(scenario, beam, truth.position[None])[0]
        assert report.actual_bps == pytest.approx(actual)


def test_positions_outside_a_cycle_change_nothing(network, example):
    net, plain = network(), network()
    for state in (State.CONFIGURING, State.SOUNDING, State.STEERING, State.TRANSMITTING):
        net.run_to(state)
        for user in (1, 9):
            net.publish(example(m.GroundTruth, cycle_id=0, user=user))
    for other in (net, plain):
        other.run_cycles(1)
    assert net.outcomes() == plain.outcomes() == [(1, 1, 'served')]
    assert net.sent(m.Capacity)[0].actual_bps == plain.sent(m.Capacity)[0].actual_bps
    net.verify()


@pytest.mark.parametrize('role', ['bs', 'positioner'])
def test_the_true_position_never_reaches_base_station_and_positioner(subscriptions, role):
    assert m.GroundTruth not in subscriptions[role]
    module = 'base_station' if role == 'bs' else role
    for file in (PACKAGE / 'protocol' / f'{module}.py', PACKAGE / 'nodes' / f'{role}.py'):
        text = file.read_text(encoding='utf-8')
        assert 'GroundTruth' not in text
        assert 'ground_truth' not in text


def test_the_position_is_estimated_without_the_true_one(network, places):
    """A false true position changes nothing but the reported losses."""
    def lie_to_transmission(message, recipient):
        if isinstance(message, m.GroundTruth) and recipient == 'transmission':
            return [(1e-3, m.GroundTruth(
                cycle_id=message.cycle_id, user=message.user, position=places[4],
                velocity=np.zeros(3)))]
        return [(1e-3, message)]

    honest, deceived = network(), network(transport=lie_to_transmission)
    for net in (honest, deceived):
        net.run_cycles(1)
    for kind, field in ((m.ReceivedSignals, 'signals'), (m.PositionEstimate, 'position'),
                        (m.Beam, 'analog'), (m.Beam, 'digital')):
        a, b = (getattr(net.sent(kind)[0], field) for net in (honest, deceived))
        np.testing.assert_array_equal(a, b)
    assert honest.sent(m.Capacity)[0].actual_bps != deceived.sent(m.Capacity)[0].actual_bps


def test_a_user_that_joins_later_is_served(network, places):
    net = network()
    net.run_cycles(3)
    net.add_user(2, places[1])
    net.run_cycles(6)
    assert net.served() == [1, 1, 1, 1, 2, 1, 2, 1, 2]
    net.verify()


def test_a_user_that_joins_an_empty_network_is_served(network, places):
    net = network(0)
    net.run(limit_s=5.0)
    assert net.outcomes() == []
    assert net['bs'].counters['unanswered'] == 50
    assert {b.cycle_id for b in net.sent(m.Beacon)} == {1}
    assert [b.attempt for b in net.sent(m.Beacon)] == list(range(51))
    net.add_user(1, places[0])
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert [b.attempt for b in net.sent(m.Beacon, cycle_id=2)] == [0]


@pytest.mark.parametrize('signs', [(-1, -1, -1), (1, 1, 1), (-1, 1, 0), (1, -1, 1)])
def test_a_user_at_a_corner_of_the_region_is_served(network, scenario, signs):
    low, high = scenario.roi_bounds_m
    net = network({1: (low + high) / 2 + np.array(signs) * (high - low) / 2})
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert net.counters() == {}
    net.verify()


def test_the_pause_between_cycles_may_be_zero(network):
    net = network(2, rest_s=0.0)
    net.run_cycles(7)
    assert net.served() == [1, 2, 1, 2, 1, 2, 1]


def test_a_beacon_follows_the_pause(network):
    net = network(rest_s=2.5)
    net.run_cycles(2)
    beacons = [sent.time_s for sent in net.log if isinstance(sent.message, m.Beacon)]
    ends = [sent.time_s for sent in net.log
            if isinstance(sent.message, m.ProtocolState) and sent.message.outcome]
    assert beacons[1] - ends[0] == pytest.approx(2.5)


def test_one_band_and_one_frame_are_enough(network_class, random_beams):
    scenario = Scenario(
        center_frequencies_hz=(2.5e9,), n_subbands=1, n_frames=1, n_feeds=1, elements_per_side=4)
    codebook = random_beams(scenario, np.random.default_rng(0))
    net = network_class(scenario, codebook, {1: (9.0, 1.0, 0.3)})
    net.run_cycles(3)
    assert net.served() == [1, 1, 1]
    net.verify()


def test_a_cycle_of_table_1_finds_the_user(network_class, shipped, table1_estimator):
    """The paper's scenario with the shipped codebook and the default estimator."""
    scenario = Scenario()
    net = network_class(
        scenario, shipped, {1: (9.0, 1.5, 0.4), 2: (6.0, -3.0, -0.5)},
        make=lambda codebook: table1_estimator)
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


def test_64_users_are_each_served_once_per_round(network, places):
    net = network({user: places[0] for user in range(1, 65)}, rest_s=0.0)
    net.run_cycles(1 + 64 + 4)
    # The first ack ends the wait in the first cycle: no other user is registered yet.
    assert net.counters() == {'bs': {'late_ack': 63}}
    served = net.served()[1:]
    assert sorted(served[:64]) == list(range(1, 65))
    assert served[64:] == served[:4]
