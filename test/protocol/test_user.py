"""The user alone, in situations that are rare in a network."""

import math

import numpy as np
import pytest

from rhs_isac_ros.model import mobility
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import LogMessage, PeersChanged, Send, Timeout
from rhs_isac_ros.protocol.user import State, User

DOWN, UP = m.Direction.DOWNLINK, m.Direction.UPLINK
OFFERED, DELIVERED = m.Stage.OFFERED, m.Stage.DELIVERED


@pytest.fixture
def user():
    """User 4, connected, with timeouts of 2 s for a grant and 8 s after it."""
    way = mobility.Waypoints([(6.0, 0.0, 0.0), (8.0, 0.0, 0.0)], 0.5)
    made = User({4: way}, step_s=2.0, beacon_s=math.inf)
    made.handle(PeersChanged(()), 0.0)
    return made


def answers(user, event, now_s):
    return [action.message for action in user.handle(event, now_s) if isinstance(action, Send)]


def grant(user, cycle_id=7, now_s=10.0):
    user.handle(m.Beacon(cycle_id=cycle_id, attempt=0), now_s)
    return answers(user, m.Grant(cycle_id=cycle_id, user=4), now_s)


def test_a_beacon_is_answered(user):
    (ack,) = answers(user, m.Beacon(cycle_id=7, attempt=0), 10.0)
    assert (type(ack), ack.cycle_id, ack.user) == (m.Ack, 7, 4)
    assert user.state is State.ACKNOWLEDGED
    assert user.next_deadline() == 12.0


def test_a_late_beacon_or_grant_of_a_cycle_keeps_its_position(user):
    (truth,) = grant(user)
    user.handle(m.Data(
        cycle_id=7, user=4, direction=DOWN, stage=DELIVERED, duration_s=0.25, bits=123.0), 11.0)
    assert answers(user, m.Grant(cycle_id=7, user=4), 11.5) == []
    assert user.counters == {'late_grant': 1}
    assert answers(user, m.Beacon(cycle_id=7, attempt=0), 11.5) == []
    assert user.counters == {'late_grant': 1, 'stale_beacon': 1}
    user.handle(m.Beacon(cycle_id=7, attempt=1), 12.0)
    again, *_ = answers(user, m.PilotRequest(
        cycle_id=7, user=4, band=0, last_band=0, n_frames=2), 12.5)
    assert again is truth


@pytest.mark.parametrize('cycle_id', [7, 8])
def test_every_further_beacon_is_answered_and_restarts_the_timeout(user, cycle_id):
    user.handle(m.Beacon(cycle_id=7, attempt=0), 10.0)
    (ack,) = answers(user, m.Beacon(cycle_id=cycle_id, attempt=1), 11.5)
    assert ack.cycle_id == cycle_id
    assert user.next_deadline() == 13.5
    assert user.counters == {}


def test_a_grant_is_answered_with_the_present_position(user):
    assert [truth.cycle_id for truth in user.ground_truths(8.0).each()] == [0]
    (truth,) = grant(user)
    assert (type(truth), truth.cycle_id, truth.user) == (m.GroundTruth, 7, 4)
    np.testing.assert_allclose(truth.position, (7, 0, 0))
    np.testing.assert_allclose(truth.velocity, (0.5, 0, 0))
    assert user.next_deadline() == 18.0


def test_a_pilot_request_is_answered_in_each_frame_and_restarts_the_timeout(user):
    grant(user)
    pilots, = answers(user, m.PilotRequest(
        cycle_id=7, user=4, band=1, last_band=1, n_frames=3), 12.5)
    assert (pilots.cycle_id, pilots.user, pilots.band) == (7, 4, 1)
    assert pilots.symbols.tolist() == [1 + 0j] * 3
    assert user.next_deadline() == 20.5


def test_the_downlink_is_answered_with_equal_uplink_and_ends_the_cycle(user):
    grant(user)
    (data,) = answers(user, m.Data(
        cycle_id=7, user=4, direction=DOWN, stage=DELIVERED, duration_s=0.25, bits=123.0), 11.0)
    assert (data.cycle_id, data.user, data.direction, data.stage) == (7, 4, UP, OFFERED)
    assert (data.duration_s, data.bits) == (0.25, 123.0)
    assert user.state is State.LISTENING
    assert user.next_deadline() == math.inf


@pytest.mark.parametrize(('direction', 'stage'), [(DOWN, OFFERED), (UP, OFFERED), (UP, DELIVERED)])
def test_other_data_are_ignored(user, direction, stage):
    grant(user)
    assert user.handle(m.Data(
        cycle_id=7, user=4, direction=direction, stage=stage, duration_s=0.25,
        bits=123.0), 11.0) == []
    assert user.state is State.GRANTED
    assert user.counters == {}


def test_a_late_beacon_of_the_granted_cycle_is_only_counted(user):
    """Another beacon of a cycle may be in transit while the first ack is granted."""
    grant(user)
    assert user.handle(m.Beacon(cycle_id=7, attempt=1), 11.0) == []
    assert user.state is State.GRANTED
    assert user.next_deadline() == 18.0
    assert user.counters == {'stale_beacon': 1}


def test_a_beacon_of_another_cycle_ends_the_granted_one(user):
    grant(user)
    (ack,) = answers(user, m.Beacon(cycle_id=8, attempt=0), 11.0)
    assert ack.cycle_id == 8
    assert user.state is State.ACKNOWLEDGED
    assert user.counters == {'abandoned': 1}


def test_a_grant_to_another_user_ends_the_wait(user):
    user.handle(m.Beacon(cycle_id=7, attempt=0), 10.0)
    assert user.handle(m.Grant(cycle_id=7, user=5), 10.5) == []
    assert user.state is State.LISTENING
    assert user.counters == {}


@pytest.mark.parametrize('other', [
    m.Grant(cycle_id=6, user=5), m.PilotRequest(
        cycle_id=7, user=5, band=0, last_band=0, n_frames=2), m.Data(
        cycle_id=6, user=5, direction=DOWN, stage=DELIVERED, duration_s=0.25, bits=1.0)],
    ids=['grant of another cycle', 'request', 'data'])
def test_other_messages_to_another_user_are_ignored(user, other):
    for event, state in ((m.Beacon(
        cycle_id=7, attempt=0), State.ACKNOWLEDGED), (m.Grant(cycle_id=7, user=4), State.GRANTED)):
        user.handle(event, 10.0)
        assert user.handle(other, 10.5) == []
        assert user.state is state
    assert user.counters == {}


def test_a_pilot_request_that_overtakes_the_grant_implies_it(user):
    user.handle(m.Beacon(cycle_id=7, attempt=0), 10.0)
    truth, pilots = answers(user, m.PilotRequest(
        cycle_id=7, user=4, band=0, last_band=0, n_frames=2), 10.5)
    assert (type(truth), truth.cycle_id, truth.user) == (m.GroundTruth, 7, 4)
    assert (type(pilots), len(pilots.symbols)) == (m.Pilot, 2)
    assert user.state is State.GRANTED
    assert user.handle(m.Grant(cycle_id=7, user=4), 11.0) == []
    assert user.next_deadline() == 18.5
    assert user.counters == {}


@pytest.mark.parametrize(('granted', 'deadline_s', 'reason'), [
    # A granted user waits through sounding of the last band, estimating and steering.
    (False, 12.0, 'not_granted'), (True, 18.0, 'bs_silent')])
def test_a_timeout_leads_back_to_listening(user, granted, deadline_s, reason):
    user.handle(m.Beacon(cycle_id=7, attempt=0), 10.0)
    if granted:
        user.handle(m.Grant(cycle_id=7, user=4), 10.0)
    assert user.next_deadline() == deadline_s
    assert user.handle(Timeout(), deadline_s) == []
    assert user.state is State.LISTENING
    assert user.counters == {reason: 1}
    assert user.next_deadline() == math.inf


@pytest.mark.parametrize('state', State)
def test_a_disconnected_user_logs_it_and_sends_nothing(user, state):
    user.state = state
    assert user.handle(PeersChanged(('channel', 'bs')), 1.0) == [
        LogMessage('waiting for channel, bs', warning=True)]
    assert user.state is State.DISCONNECTED
    assert user.handle(m.Beacon(cycle_id=7, attempt=0), 1.0) == []
    assert user.handle(PeersChanged(()), 2.0) == [LogMessage('listening for beacons')]
    assert user.state is State.LISTENING


@pytest.mark.parametrize('state', [State.LISTENING, State.ACKNOWLEDGED, State.GRANTED])
def test_a_connected_user_keeps_its_state(user, state):
    user.state = state
    assert user.handle(PeersChanged(()), 1.0) == []
    assert user.state is state


@pytest.fixture
def users():
    """Users 4 to 6 of one node, connected."""
    made = User({user: mobility.Static((user, 0.0, 0.0)) for user in (4, 5, 6)},
                step_s=0.5, beacon_s=1.5)
    made.handle(PeersChanged(()), 0.0)
    return made


def invite(first, last, cycle_id=7, attempt=0):
    return m.Beacon(cycle_id=cycle_id, attempt=attempt, first_user=first, last_user=last)


@pytest.mark.parametrize(('first', 'last', 'invited'), [
    (1, 9, [4, 5, 6]), (5, 5, [5]), (5, 9, [5, 6]), (1, 4, [4])])
def test_each_invited_user_of_a_node_answers(users, first, last, invited):
    acks = answers(users, invite(first, last), 1.0)
    assert [(type(ack), ack.cycle_id, ack.user) for ack in acks] == [
        (m.Ack, 7, user) for user in invited]
    assert users.state is State.ACKNOWLEDGED


@pytest.mark.parametrize(('state', 'counters'), [
    (State.LISTENING, {}), (State.NO_BEACON, {}), (State.ACKNOWLEDGED, {}),
    (State.GRANTED, {'abandoned': 1})])
def test_a_beacon_to_other_users_is_not_answered_but_proves_an_active_base_station(
        users, state, counters):
    users.state = state
    assert answers(users, invite(7, 9), 1.0) == []
    assert users.state is State.LISTENING
    assert users.next_deadline() == 2.5
    assert users.counters == counters
    assert answers(users, m.Grant(cycle_id=7, user=5), 1.5) == []
    assert users.counters == counters | {'wrong_cycle': 1}


@pytest.mark.parametrize('user', [4, 6])
def test_a_cycle_serves_the_user_of_the_node_that_is_granted_it(users, user):
    users.handle(invite(1, 9), 1.0)
    (truth,) = answers(users, m.Grant(cycle_id=7, user=user), 1.1)
    assert (truth.user, *truth.position) == (user, user, 0, 0)
    pilots = answers(users, m.PilotRequest(
        cycle_id=7, user=user, band=0, last_band=0, n_frames=2), 1.2)
    assert {pilot.user for pilot in pilots} == {user}
    for other in ({4, 5, 6} - {user}):
        assert answers(
            users, m.PilotRequest(
        cycle_id=7, user=other, band=1, last_band=1, n_frames=2), 1.2) == []
        assert answers(users, m.Data(
            cycle_id=7, user=other, direction=DOWN, stage=DELIVERED, duration_s=0.25, bits=1.0),
            1.2) == []
    assert users.counters == {'wrong_user': 2}
    (data,) = answers(users, m.Data(
        cycle_id=7, user=user, direction=DOWN, stage=DELIVERED, duration_s=0.25, bits=1.0), 1.3)
    assert data.user == user
    assert users.state is State.LISTENING


def test_the_true_positions_of_all_users_of_a_node(users):
    truths = users.ground_truths(3.0)
    assert truths.cycle_id == 0
    assert [(truth.user, *truth.position, *truth.velocity) for truth in truths.each()] == [
        (user, user, 0, 0, 0, 0, 0) for user in (4, 5, 6)]
