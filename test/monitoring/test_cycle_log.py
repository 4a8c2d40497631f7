"""Records of cycles, assembled from the messages of networks without ROS."""

import itertools
import math

import pytest

from rhs_isac_ros.monitoring.cycle_log import RECEIVES, CycleLog
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState


def log_of(*networks, without=()):
    log = CycleLog()
    for sent in itertools.chain.from_iterable(network.log for network in networks):
        if isinstance(sent.message, RECEIVES) and not isinstance(sent.message, without):
            log.add(sent.message, sent.time_s)
    return log


def test_a_served_cycle_is_complete(network, scenario, places):
    net = network()
    net.run_cycles(3)
    log = log_of(net)
    assert log.given_up == []
    assert [record.cycle_id for record in log.complete] == [1, 2, 3]
    for record in log.complete:
        assert record.user == 1
        for part in (record.truth, record.signals, record.estimate, record.capacity):
            assert (part.cycle_id, part.user) == (record.cycle_id, 1)
        assert record.error_m == pytest.approx(math.dist(scenario.roi_center_m, places[0]))
    assert [(record.cycle_id, record.outcome) for record in log.ended] == [
        (1, 'served'), (2, 'served'), (3, 'served')]


def test_durations_match_the_messages_of_the_phases(network):
    net = network(rest_s=0.5)
    net.run_cycles(2)
    record = log_of(net).complete[1]
    late = CycleLog()
    for sent in net.log:
        if isinstance(sent.message, RECEIVES):
            # The observer receives all messages of a busy machine together.
            late.add(sent.message, 99.0)
    assert late.complete[1].durations_s() == record.durations_s()
    times = {type(s.message): s.time_s for s in reversed(net.log) if s.message.cycle_id == 2}
    durations = record.durations_s()
    assert list(durations) == [
        m.Phase.BEACONING, m.Phase.POSITIONING, m.Phase.ESTIMATING, m.Phase.TRANSMITTING]
    assert durations[m.Phase.BEACONING] == pytest.approx(times[m.Grant] - times[m.Beacon])
    positioning_s = times[m.ReceivedSignals] - times[m.Grant]
    assert durations[m.Phase.POSITIONING] == pytest.approx(positioning_s)
    estimating_s = times[m.Data] - times[m.ReceivedSignals]
    assert durations[m.Phase.ESTIMATING] == pytest.approx(estimating_s)
    assert sum(durations.values()) == pytest.approx(record.duration_s)
    assert record.duration_s == pytest.approx(record.ended_s - record.began_s)


def test_a_cycle_begins_with_the_last_beacon_before_its_grant(network, places):
    net = network(0)
    net.run(limit_s=3.05)
    net.add_user(1, places[0])
    net.run_cycles(1)
    (record,) = log_of(net).complete
    assert record.began_s == pytest.approx(3.1)
    assert record.durations_s()[m.Phase.BEACONING] < 0.01


def test_a_cycle_that_is_given_up_has_a_reason_and_no_result(network):
    net = network()
    net.run_to(BsState.SOUNDING)
    net.remove('positioner', noticed=False)
    net.run_cycles(1)
    log = log_of(net)
    (record,) = log.given_up
    assert log.complete == []
    assert (record.user, record.outcome) == (1, 'positioner_silent')
    assert log.ended == log.failed == [record]
    assert record.completed() is None
    assert record.truth is not None
    assert record.estimate is record.capacity is None
    assert record.durations_s()[m.Phase.ESTIMATING] == pytest.approx(1.0)


def test_a_cycle_without_a_position_is_given_up_but_has_not_failed(example):
    log = CycleLog()
    log.add(m.Beacon(cycle_id=7, attempt=1), 0.0)
    log.add(example(m.ProtocolState, cycle_id=7, outcome='no_fix'), 1.0)
    (record,) = log.given_up
    assert (record.cycle_id, record.outcome) == (7, 'no_fix')
    assert log.failed == log.complete == []


def test_cycles_that_ended_after_a_time_are_removed(network):
    net = network()
    net.run_cycles(3)
    log = log_of(net)
    first, second, _ = log.complete
    log.cut(second.ended_s)
    assert log.complete == [first, second]
    assert [record.cycle_id for record in log.ended] == [1, 2]


def test_the_order_of_topics_does_not_matter(network):
    net = network(2)
    net.run_cycles(3)
    expected = {r.cycle_id: vars(r) for r in log_of(net).complete}
    assert expected.keys() == {1, 2, 3}
    for kinds in itertools.permutations(set(RECEIVES) - {m.Beacon}):
        log = CycleLog()
        for kind in (m.Beacon, *kinds):
            for sent in net.log:
                if isinstance(sent.message, kind):
                    log.add(sent.message, sent.time_s)
        assert {r.cycle_id: vars(r) for r in log.complete} == expected
        assert log.given_up == []


@pytest.mark.parametrize('state', [BsState.CONFIGURING, BsState.ESTIMATING, BsState.TRANSMITTING])
def test_an_interrupted_cycle_is_not_mixed_with_the_next_one_of_its_number(network, state):
    before = network()
    before.run_to(state)
    again_s = before.now_s
    net = network(begin_s=again_s)
    net.run_cycles(1)
    (record,) = log_of(before, net).complete
    assert record.cycle_id == 1
    assert record.began_s >= again_s
    assert all(duration >= 0 for duration in record.durations_s().values())
    assert record.truth is net.sent(m.GroundTruth)[-1]
    assert record.estimate is net.sent(m.PositionEstimate)[-1]


def test_messages_outside_a_known_cycle_create_no_record(example):
    log = CycleLog()
    for kind in (m.GroundTruth, m.PositionEstimate, m.Capacity):
        log.add(example(kind, cycle_id=0), 1.0)
        log.add(example(kind, cycle_id=7), 1.0)
    log.add(example(m.ProtocolState, cycle_id=7, outcome='served'), 1.0)
    log.add(example(m.ProtocolState, cycle_id=7, outcome='user_gone'), 1.0)
    assert log.complete == log.ended == []


def test_old_cycles_without_an_end_are_discarded(example):
    log = CycleLog()
    for cycle_id in range(1, 101):
        log.add(example(m.Beacon, cycle_id=cycle_id), float(cycle_id))
    for cycle_id in (1, 50, 99, 100):
        log.add(example(m.ProtocolState, cycle_id=cycle_id, outcome='user_gone'), 200.0)
    assert [record.cycle_id for record in log.given_up] == [99, 100]
