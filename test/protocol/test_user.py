"""The user alone, in situations that are rare in a network."""

import math

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario, mobility
from rhs_isac_ros.model.geometry import reference_s
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import LogMessage, PeersChanged, Send, Timeout
from rhs_isac_ros.protocol.user import User, UserState

DOWN, UP = m.Direction.DOWNLINK, m.Direction.UPLINK
OFFERED, DELIVERED = m.Stage.OFFERED, m.Stage.DELIVERED
# The reference time of its cycles is that of the grant.
ONE_FRAME = Scenario(center_frequencies_hz=(2.5e9,), n_frames=1)


def beacon(cycle_id=7, attempt=0, **users):
    return m.Beacon(cycle_id=cycle_id, attempt=attempt, **users)


def grant(cycle_id=7, user=4):
    return m.Grant(cycle_id=cycle_id, user=user)


def request(user=4, band=0, n_frames=2):
    return m.PilotRequest(cycle_id=7, user=user, band=band, last_band=band, n_frames=n_frames)


def data(cycle_id=7, user=4, direction=DOWN, stage=DELIVERED):
    return m.Data(cycle_id=cycle_id, user=user, direction=direction, stage=stage,
                  duration_s=0.25, bits=123.0)


@pytest.fixture
def user():
    """User 4, connected, with timeouts of 2 s for a grant and 8 s after it."""
    way = mobility.Waypoints([(6.0, 0.0, 0.0), (8.0, 0.0, 0.0)], 0.5)
    made = User({4: way}, ONE_FRAME, step_s=2.0, beacon_s=math.inf)
    made.handle(PeersChanged(()), 0.0)
    return made


def answers(user, event, now_s):
    return [action.message for action in user.handle(event, now_s) if isinstance(action, Send)]


GRANTED = [(beacon(), 10.0), (grant(), 10.0)]
LISTENING, ACKNOWLEDGED = UserState.LISTENING, UserState.ACKNOWLEDGED


@pytest.mark.parametrize((
    'before', 'event', 'now_s', 'answer', 'state', 'deadline_s', 'counters'), [
    ([], beacon(), 10.0, [m.Ack], ACKNOWLEDGED, 12.0, {}),
    # Every further beacon is answered and restarts the timeout.
    ([(beacon(), 10.0)], beacon(7, 1), 11.5, [m.Ack], ACKNOWLEDGED, 13.5, {}),
    ([(beacon(), 10.0)], beacon(8, 1), 11.5, [m.Ack], ACKNOWLEDGED, 13.5, {}),
    ([(beacon(), 10.0)], grant(), 10.0, [m.GroundTruth], UserState.GRANTED, 18.0, {}),
    # A grant to another user ends the wait; other messages to another user are ignored.
    ([(beacon(), 10.0)], grant(user=5), 10.5, [], LISTENING, math.inf, {}),
    *(([(beacon(), 10.0)], other, 10.5, [], ACKNOWLEDGED, 12.0, {})
      for other in (grant(6, 5), request(user=5), data(6, 5))),
    *((GRANTED, other, 10.5, [], UserState.GRANTED, 18.0, {})
      for other in (grant(6, 5), request(user=5), data(6, 5))),
    # A pilot request that overtakes the grant implies it.
    ([(beacon(), 10.0)], request(), 10.5, [m.GroundTruth, m.Pilot], UserState.GRANTED, 18.5, {}),
    ([(beacon(), 10.0), (request(), 10.5)], grant(), 11.0, [], UserState.GRANTED, 18.5, {}),
    (GRANTED, request(band=1), 12.5, [m.Pilot], UserState.GRANTED, 20.5, {}),
    # The downlink is answered and ends the cycle; other data are ignored.
    (GRANTED, data(), 11.0, [m.Data], LISTENING, math.inf, {}),
    *((GRANTED, data(direction=way, stage=stage), 11.0, [], UserState.GRANTED, 18.0, {})
      for way, stage in ((DOWN, OFFERED), (UP, OFFERED), (UP, DELIVERED))),
    # Another beacon of a cycle may be in transit while the first ack is granted.
    (GRANTED, beacon(7, 1), 11.0, [], UserState.GRANTED, 18.0, {'stale_beacon': 1}),
    (GRANTED, beacon(8), 11.0, [m.Ack], ACKNOWLEDGED, 13.0, {'abandoned': 1}),
    ([*GRANTED, (data(), 11.0)], grant(), 11.5, [], LISTENING, math.inf, {'late_grant': 1}),
    ([*GRANTED, (data(), 11.0)], beacon(), 11.5, [], LISTENING, math.inf, {'stale_beacon': 1}),
    # A granted user waits through sounding of the last band, estimating and steering.
    ([(beacon(), 10.0)], Timeout(), 12.0, [], LISTENING, math.inf, {'not_granted': 1}),
    (GRANTED, Timeout(), 18.0, [], LISTENING, math.inf, {'bs_silent': 1})])
def test_a_user_answers_the_messages_of_its_cycle(
        user, before, event, now_s, answer, state, deadline_s, counters):
    for earlier, at_s in before:
        user.handle(earlier, at_s)
    sent = answers(user, event, now_s)
    assert [type(message) for message in sent] == answer
    assert {(message.cycle_id, message.user) for message in sent} <= {
        (getattr(event, 'cycle_id', 0), 4)}
    assert (user.state, user.next_deadline(), user.counters) == (state, deadline_s, counters)


def test_the_answers_have_the_position_the_pilots_and_the_data_of_the_cycle(user):
    assert [truth.cycle_id for truth in user.ground_truths(8.0).each()] == [0]
    user.handle(beacon(), 10.0)
    (truth,) = answers(user, grant(), 10.0)
    np.testing.assert_allclose(truth.position, (7, 0, 0))
    np.testing.assert_allclose(truth.velocity, (0.5, 0, 0))
    (pilots,) = answers(user, request(band=1, n_frames=3), 12.5)
    assert (pilots.band, pilots.symbols.tolist()) == (1, [1 + 0j] * 3)
    (uplink,) = answers(user, data(), 13.0)
    assert (uplink.direction, uplink.stage) == (UP, OFFERED)
    assert (uplink.duration_s, uplink.bits) == (0.25, 123.0)
    # A late beacon of the cycle keeps its position.
    user.handle(beacon(7, 1), 14.0)
    again, *_ = answers(user, request(), 14.5)
    assert again is truth


@pytest.mark.parametrize('state', UserState)
def test_a_disconnected_user_logs_it_and_sends_nothing(user, state):
    user.state = state
    assert user.handle(PeersChanged(('channel', 'bs')), 1.0) == [
        LogMessage('waiting for channel, bs', warning=True, key='peers', holds=True)]
    assert user.state is UserState.DISCONNECTED
    assert user.handle(PeersChanged((), 'odometry'), 1.0) == [
        LogMessage('waiting for odometry', warning=True, key='peers', holds=True)]
    assert user.handle(beacon(), 1.0) == []
    assert user.counters == {}
    assert user.handle(PeersChanged(()), 2.0) == [
        LogMessage('listening for beacons', key='peers', holds=False)]
    assert user.state is UserState.LISTENING


@pytest.mark.parametrize('state', [UserState.LISTENING, UserState.ACKNOWLEDGED, UserState.GRANTED])
def test_a_connected_user_keeps_its_state(user, state):
    user.state = state
    assert user.handle(PeersChanged(()), 1.0) == []
    assert user.state is state


def test_the_true_position_of_a_cycle_is_that_at_its_reference_time():
    scenario = Scenario(frame_duration_s=0.1)
    made = User({4: mobility.Waypoints([(6.0, 0.0, 0.0), (8.0, 0.0, 0.0)], 0.5)}, scenario,
                step_s=2.0, beacon_s=math.inf)
    made.handle(PeersChanged(()), 0.0)
    made.ground_truths(9.0)
    answers(made, beacon(), 10.0)
    (truth,) = answers(made, grant(), 10.0)
    np.testing.assert_allclose(truth.position, [6.0 + 0.5 * (1 + reference_s(scenario)), 0, 0])
    np.testing.assert_allclose(truth.velocity, [0.5, 0, 0])


@pytest.fixture
def users():
    """Users 4 to 6 of one node, connected."""
    made = User({user: mobility.Static((user, 0.0, 0.0)) for user in (4, 5, 6)},
                ONE_FRAME, step_s=0.5, beacon_s=1.5, instance=7)
    made.handle(PeersChanged(()), 0.0)
    return made


@pytest.mark.parametrize(('first', 'last', 'invited'), [
    (1, 9, [4, 5, 6]), (5, 5, [5]), (5, 9, [5, 6]), (1, 4, [4])])
def test_each_invited_user_of_a_node_answers(users, first, last, invited):
    acks = answers(users, beacon(first_user=first, last_user=last), 1.0)
    assert [(type(ack), ack.cycle_id, ack.user) for ack in acks] == [
        (m.Ack, 7, user) for user in invited]
    assert users.state is UserState.ACKNOWLEDGED


@pytest.mark.parametrize(('state', 'counters'), [
    (UserState.LISTENING, {}), (UserState.NO_BEACON, {}), (UserState.ACKNOWLEDGED, {}),
    (UserState.GRANTED, {'abandoned': 1})])
def test_a_beacon_to_other_users_is_not_answered_but_proves_an_active_base_station(
        users, state, counters):
    users.state = state
    assert answers(users, beacon(first_user=7, last_user=9), 1.0) == []
    assert users.state is UserState.LISTENING
    assert users.next_deadline() == 2.5
    assert users.counters == counters
    assert answers(users, grant(user=5), 1.5) == []
    assert users.counters == counters | {'wrong_cycle': 1}


@pytest.mark.parametrize('user', [4, 6])
def test_a_cycle_serves_the_user_of_the_node_that_is_granted_it(users, user):
    users.handle(beacon(first_user=1, last_user=9), 1.0)
    (truth,) = answers(users, grant(user=user), 1.1)
    assert (truth.user, *truth.position) == (user, user, 0, 0)
    assert {pilot.user for pilot in answers(users, request(user), 1.2)} == {user}
    for other in {4, 5, 6} - {user}:
        assert answers(users, request(other, band=1), 1.2) == []
        assert answers(users, data(user=other), 1.2) == []
    assert users.counters == {'wrong_user': 2}
    (uplink,) = answers(users, data(user=user), 1.3)
    assert uplink.user == user
    assert users.state is UserState.LISTENING


def test_the_numbers_that_another_node_has_are_logged_under_one_key(users):
    """The log of a node with a thousand users contains one line a minute about them."""
    found = [action for user in users.users for action in users.handle(
        m.Grant(cycle_id=7, user=user, user_instance=5), 0.0)]
    assert [one.text.partition(':')[0] for one in found] == [
        f'user {user}' for user in users.users]
    assert len({one.key for one in found}) == 1
    (text,) = users.status().values()
    assert 'two nodes have these numbers' in text


def test_the_true_positions_of_all_users_of_a_node(users):
    truths = users.ground_truths(3.0)
    assert truths.cycle_id == 0
    assert [(truth.user, *truth.position, *truth.velocity) for truth in truths.each()] == [
        (user, user, 0, 0, 0, 0, 0) for user in (4, 5, 6)]


def test_a_mobility_that_fails_has_the_effect_of_a_lost_grant():
    class Lost:
        def state(self, now_s):
            raise RuntimeError('no map')
    user = User({4: Lost()}, ONE_FRAME, step_s=2.0, beacon_s=math.inf)
    for event, now_s in ((PeersChanged(()), 0.0), (beacon(), 10.0)):
        user.handle(event, now_s)
    (logged,) = user.handle(grant(), 10.5)
    assert logged.text.startswith('plug-in: Lost.state: RuntimeError: no map\nTraceback')
    assert (user.state, user.counters) == (ACKNOWLEDGED, {'plugin_fault': 1})
    user.handle(Timeout(), 12.0)
    assert user.state == LISTENING
