"""Every fault has a transition, a counter and a way back to beaconing."""

import collections
import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import mobility
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol import user as user_role
from rhs_isac_ros.protocol.base_station_states import State
from rhs_isac_ros.protocol.events import PeersChanged

POSITIONING, TRANSMISSION = m.Mode.POSITIONING, m.Mode.TRANSMISSION
DOWN = {'direction': m.Direction.DOWNLINK}
UP = {'direction': m.Direction.UPLINK}
OFFERED, DELIVERED = {'stage': m.Stage.OFFERED}, {'stage': m.Stage.DELIVERED}

# The result if the first message of a class does not reach one of its recipients: the outcome of
# the cycle, and other counters by role. The user detects it by the next beacon or by a time-out.
LOST = [
    (m.Beacon, {}, 'user1', 'served', {'bs': {'unanswered': 1}}),
    (m.Ack, {}, 'bs', 'served', {'bs': {'unanswered': 1}}),
    (m.Grant, {}, 'user1', 'served', {}),
    (m.Grant, {}, 'rhs_controller', 'served', {}),
    (m.GroundTruth, {}, 'channel', 'user_gone', {}),
    (m.GroundTruth, {}, 'transmission', 'served', {}),
    (m.RhsCommand, {}, 'rhs_controller', 'rhs_silent', {}),
    (m.RhsConfiguration, {'mode': POSITIONING}, 'bs', 'rhs_silent', {}),
    (m.RhsConfiguration, {'mode': POSITIONING}, 'channel', 'user_gone', {}),
    (m.RhsConfiguration, {'mode': POSITIONING}, 'transmission', 'served', {}),
    (m.RhsConfiguration, {'mode': POSITIONING, 'band': 1}, 'bs', 'rhs_silent', {}),
    (m.PilotRequest, {}, 'user1', 'user_gone', {}),
    (m.PilotRequest, {'band': 1}, 'user1', 'user_gone', {}),
    (m.Pilot, {}, 'channel', 'user_gone', {}),
    (m.Pilot, {'band': 1, 'frame': 1}, 'channel', 'user_gone', {}),
    (m.FeedSignals, {}, 'bs', 'user_gone', {}),
    (m.FeedSignals, {'band': 1, 'frame': 1}, 'bs', 'user_gone', {}),
    (m.ReceivedSignals, {}, 'positioner', 'positioner_silent', {}),
    (m.PositionEstimate, {}, 'bs', 'served', {}),
    (m.PositionEstimate, {}, 'transmission', 'transmission_silent', {}),
    (m.Beam, {}, 'bs', 'transmission_silent', {}),
    (m.Beam, {}, 'rhs_controller', 'transmission_silent', {}),
    (m.Beam, {}, 'channel', 'data_lost', {}),
    (m.RhsConfiguration, {'mode': TRANSMISSION}, 'bs', 'transmission_silent', {}),
    (m.RhsConfiguration, {'mode': TRANSMISSION}, 'channel', 'data_lost', {}),
    (m.RhsConfiguration, {'mode': TRANSMISSION}, 'transmission', 'served', {}),
    (m.Data, DOWN | OFFERED, 'channel', 'data_lost', {}),
    (m.Data, DOWN | DELIVERED, 'user1', 'data_lost', {}),
    (m.Data, DOWN | DELIVERED, 'bs', 'served', {}),
    (m.Data, UP | OFFERED, 'channel', 'data_lost', {}),
    (m.Data, UP | DELIVERED, 'bs', 'data_lost', {}),
    (m.Data, UP | DELIVERED, 'user1', 'served', {}),
]
IDS = [f'{kind.__name__}-{"-".join(map(str, fields.values()))}-{recipient}'
       for kind, fields, recipient, _, _ in LOST]


def matches(message, kind, fields):
    return isinstance(message, kind) and all(
        getattr(message, name) == value for name, value in fields.items())


class LosesFirst:
    """Loses the first message of a class to one recipient, or to all."""

    def __init__(self, kind, fields, recipient=''):
        self.kind, self.fields, self.recipient = kind, fields, recipient
        self.lost = None

    def __call__(self, message, recipient):
        if matches(message, self.kind, self.fields) and recipient.startswith(self.recipient):
            self.lost = self.lost or message
            if message is self.lost:
                return []
        return [(1e-3, message)]


class Adds:
    """Sends an altered copy after, or before, the first message of a class to a recipient."""

    def __init__(self, kind, fields, recipient, alter, before=False):
        self.kind, self.fields, self.recipient = kind, fields, recipient
        self.alter, self.before, self.done = alter, before, False

    def __call__(self, message, recipient):
        arriving = [(1e-3, message)]
        if not self.done and recipient == self.recipient and matches(
                message, self.kind, self.fields):
            self.done = True
            arriving.insert(0 if self.before else 1, (1e-3, self.alter(message)))
        return arriving


def counted(network, role, without=()):
    counts = dict(network.counters().get(role, {}))
    return {reason: n for reason, n in counts.items() if reason not in without}


@pytest.mark.parametrize(('kind', 'fields', 'recipient', 'outcome', 'besides'), LOST, ids=IDS)
def test_one_lost_message_ends_one_cycle_at_most(
        network, kind, fields, recipient, outcome, besides):
    net = network(transport=LosesFirst(kind, fields, recipient))
    net.run_cycles(1)
    assert net.transport.lost is not None
    assert net.outcomes() == [(1, 1, outcome)]
    reason = {} if outcome == 'served' else {outcome: 1}
    assert counted(net, 'bs') == reason | besides.get('bs', {})
    assert net.counters().keys() <= {'bs', 'user1'}
    net.run_cycles(3)
    assert [o for _, _, o in net.outcomes()[1:]] == ['served'] * 3
    assert counted(net, 'user1', ('abandoned', 'bs_silent', 'not_granted')) == besides.get(
        'user1', {})
    net.verify()


@pytest.mark.parametrize(('kind', 'fields', 'recipient'), [row[:3] for row in LOST], ids=IDS)
def test_one_lost_message_ends_no_cycle_with_retries(network, kind, fields, recipient):
    lost = []

    def loses_once(message, to):
        # A repeated message may be the same object.
        if not lost and to == recipient and matches(message, kind, fields):
            lost.append(message)
            return []
        return [(1e-3, message)]
    net = network(transport=loses_once, retries=3)
    net.run_cycles(4)
    assert lost
    assert [outcome for _, _, outcome in net.outcomes()] == ['served'] * 4
    assert net.counters().get('bs', {}).keys() <= {
        'unanswered', 'duplicate', 'wrong_band', *(f'retry_{step}' for step in (
            'rhs', 'band', 'position', 'beam', 'data'))}
    net.verify()


@pytest.mark.parametrize(('retries', 'outcome'), [(1, 'user_gone'), (2, 'served')])
def test_a_step_is_repeated_at_most_as_often_as_configured(network, retries, outcome):
    heard = []

    def deaf(message, recipient):
        if isinstance(message, m.PilotRequest) and message.band == 1:
            heard.append(message)
            return [] if len(heard) < 3 else [(1e-3, message)]
        return [(1e-3, message)]
    net = network(transport=deaf, retries=retries)
    begin_s = net.now_s
    net.run_cycles(1)
    assert net.outcomes() == [(1, 1, outcome)]
    assert net.counters()['bs']['retry_band'] == retries
    if outcome != 'served':
        # All attempts within the time of one step.
        assert 1.0 < net.now_s - begin_s < 1.2
    net.verify()


def test_a_repeated_request_keeps_the_frames_received(network):
    """The first attempt loses the first frame of each band, the second one the second."""
    requests = []

    def loses(message, recipient):
        if isinstance(message, m.FeedSignals):
            if message.frame == requests.count(message.band) - 1:
                return []
        if isinstance(message, m.PilotRequest) and recipient == 'user1':
            requests.append(message.band)
        return [(1e-3, message)]
    net = network(transport=loses, retries=3)
    net.run_cycles(1)
    assert net.outcomes() == [(1, 1, 'served')]
    assert net.counters()['bs'] == {'retry_band': 2}
    net.verify()


def test_every_subscription_is_among_the_lost_messages(subscriptions):
    lost = {(kind, recipient.rstrip('1')) for kind, _, recipient, _, _ in LOST}
    # NoFix does not occur in a served cycle; its loss has a separate test.
    lost.add((m.NoFix, 'bs'))
    assert lost == {(kind, role) for role, kinds in subscriptions.items() for kind in kinds}


@pytest.mark.parametrize('kind', [
    m.Beacon, m.Ack, m.Grant, m.GroundTruth, m.RhsCommand, m.RhsConfiguration, m.PilotRequest,
    m.Pilot, m.FeedSignals, m.ReceivedSignals, m.PositionEstimate, m.Beam, m.Data],
    ids=lambda kind: kind.__name__)
def test_a_message_lost_for_everybody_ends_one_cycle_at_most(network, kind):
    net = network(2, transport=LosesFirst(kind, {}))
    net.run_cycles(5)
    outcomes = [outcome for _, _, outcome in net.outcomes()]
    assert outcomes.count('served') >= 4
    assert set(net.served()) == {1, 2}
    net.verify()


def test_a_lost_cycle_is_published(network):
    net = network(transport=LosesFirst(m.ReceivedSignals, {}))
    net.run_cycles(1)
    warnings = [s.message.text for s in net.logs if s.role == 'bs' and s.message.warning]
    assert warnings == ['cycle 1: user 1 given up: positioner_silent']
    (last,) = net.sent(m.ProtocolState, phase=m.Phase.BEACONING)
    assert (last.cycle_id, last.user, last.outcome) == (1, 1, 'positioner_silent')
    assert net['bs'].state is State.RESTING
    net.run_to(State.BEACONING)
    assert net.sent(m.Beacon)[-1].cycle_id == 2


def test_a_lost_truth_leaves_the_capacities_unknown(network):
    net = network(transport=LosesFirst(m.GroundTruth, {}, 'transmission'))
    net.run_cycles(2)
    first, second = net.sent(m.Capacity)
    assert first.expected_bps > 0
    assert np.isnan([first.actual_bps, first.perfect_bps, first.loss_bps,
                     first.loss_percent]).all()
    assert second.actual_bps > 0


def test_a_missing_grant_is_counted(network):
    net = network()
    net.run_to(user_role.State.ACKNOWLEDGED, 'user1')
    net.remove('bs', noticed=False)
    net.run_to(user_role.State.LISTENING, 'user1')
    assert net['user1'].counters == {'not_granted': 1}


def test_a_silent_base_station_is_counted(network):
    net = network()
    net.run_to(user_role.State.GRANTED, 'user1')
    net.remove('bs', noticed=False)
    net.run_to(user_role.State.LISTENING, 'user1')
    assert net['user1'].counters == {'bs_silent': 1}


def replace(**changes):
    def alter(message):
        shift = changes.get('cycle_id', 0)
        arrays = {f.name: 0.5 * getattr(message, f.name) for f in dataclasses.fields(message)
                  if f.name in ('signals', 'analog', 'digital', 'position')}
        fixed = {'cycle_id': message.cycle_id + shift}
        return dataclasses.replace(message, **changes | fixed | arrays)
    return alter


# Messages that do not belong to the cycle and are dropped and counted; cycle_id is relative.
WRONG = [
    (m.Ack, {}, 'bs', {'cycle_id': -1}, 'wrong_cycle'),
    (m.Ack, {}, 'bs', {'cycle_id': 1}, 'wrong_cycle'),
    (m.Ack, {}, 'bs', {}, 'duplicate'),
    (m.Ack, {}, 'bs', {'user': 2}, 'late_ack'),
    (m.FeedSignals, {}, 'bs', {'cycle_id': -1}, 'wrong_cycle'),
    (m.FeedSignals, {}, 'bs', {'cycle_id': 1}, 'wrong_cycle'),
    (m.FeedSignals, {}, 'bs', {'user': 2}, 'wrong_user'),
    (m.FeedSignals, {}, 'bs', {'band': 1}, 'wrong_band'),
    (m.FeedSignals, {'band': 1}, 'bs', {'band': 0}, 'wrong_band'),
    (m.FeedSignals, {}, 'bs', {}, 'duplicate'),
    (m.FeedSignals, {'frame': 1}, 'bs', {}, 'wrong_band'),
    (m.FeedSignals, {'band': 1, 'frame': 1}, 'bs', {}, 'duplicate'),
    (m.RhsConfiguration, {}, 'bs', {'cycle_id': 1}, 'wrong_cycle'),
    (m.RhsConfiguration, {}, 'bs', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.RhsConfiguration, {}, 'bs', {'band': 1}, 'wrong_band'),
    (m.RhsConfiguration, {}, 'bs', {}, ''),
    (m.RhsConfiguration, {'mode': TRANSMISSION}, 'bs', {'cycle_id': -1}, 'wrong_cycle'),
    (m.RhsConfiguration, {'mode': TRANSMISSION}, 'bs', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.RhsConfiguration, {'mode': TRANSMISSION}, 'bs', {}, 'duplicate'),
    (m.PositionEstimate, {}, 'bs', {'cycle_id': -1}, 'wrong_cycle'),
    (m.PositionEstimate, {}, 'bs', {'user': 2}, 'wrong_user'),
    (m.PositionEstimate, {}, 'bs', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.Beam, {}, 'bs', {'cycle_id': -1}, 'wrong_cycle'),
    (m.Beam, {}, 'bs', {'user': 2}, 'wrong_user'),
    (m.Beam, {}, 'bs', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.Data, UP | DELIVERED, 'bs', {'cycle_id': -1}, 'wrong_cycle'),
    (m.Data, UP | DELIVERED, 'bs', {'user': 2}, 'wrong_user'),
    (m.Grant, {}, 'user1', {'cycle_id': -1}, 'wrong_cycle'),
    (m.Grant, {}, 'user1', {}, ''),
    (m.Grant, {}, 'user1', {'user': 2, 'cycle_id': -1}, ''),
    (m.PilotRequest, {}, 'user1', {'cycle_id': -1}, 'wrong_cycle'),
    (m.PilotRequest, {}, 'user1', {'user': 2}, ''),
    (m.Data, DOWN | DELIVERED, 'user1', {'cycle_id': -1}, 'wrong_cycle'),
    (m.Data, DOWN | DELIVERED, 'user1', {'user': 2}, ''),
    (m.RhsCommand, {}, 'rhs_controller', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.Beam, {}, 'rhs_controller', {'cycle_id': -1}, 'wrong_cycle'),
    (m.Beam, {}, 'rhs_controller', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.Beam, {}, 'rhs_controller', {'user': 2}, 'wrong_user'),
    (m.RhsConfiguration, {}, 'channel', {'cycle_id': -1}, ''),
    (m.RhsConfiguration, {'mode': TRANSMISSION}, 'channel', {'cycle_id': 1}, ''),
    (m.Pilot, {}, 'channel', {'cycle_id': -1}, 'stale'),
    (m.Pilot, {}, 'channel', {'user': 2}, 'wrong_user'),
    (m.Beam, {}, 'channel', {'cycle_id': -1}, ''),
    (m.Beam, {}, 'channel', {'user': 2}, ''),
    (m.Data, DOWN | OFFERED, 'channel', {'cycle_id': -1}, 'stale'),
    (m.Data, UP | OFFERED, 'channel', {'user': 2}, 'wrong_user'),
    (m.ReceivedSignals, {}, 'positioner', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.PositionEstimate, {}, 'transmission', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.RhsConfiguration, {'mode': TRANSMISSION}, 'transmission', {'cycle_id': -1},
     'wrong_cycle'),
]
# Copies that are valid by themselves are sent after the original only.
WRONG_CASES = [(*case, before) for case in WRONG for before in (False, True)
               if not before or case[3] and case[4] != 'late_ack']
WRONG_IDS = ['-'.join([kind.__name__, *map(str, fields.values()), recipient,
                       *(f'{k}={v}' for k, v in changes.items()),
                       'before' if before else 'after'])
             for kind, fields, recipient, changes, _, before in WRONG_CASES]


@pytest.mark.parametrize(
    ('kind', 'fields', 'recipient', 'changes', 'counter', 'before'), WRONG_CASES, ids=WRONG_IDS)
def test_altered_messages_are_dropped_and_counted(
        network, places, kind, fields, recipient, changes, counter, before):
    """The cycle continues as if the altered copy had not arrived."""
    net = network(
        transport=Adds(kind, fields, recipient, replace(**changes), before), seed=5)
    plain = network(seed=5)
    for other in (net, plain):
        other.run_cycles(2)
    assert net.transport.done
    assert net.outcomes() == plain.outcomes() == [(1, 1, 'served'), (2, 1, 'served')]
    net.run(limit_s=0.05)
    assert net.counters() == ({recipient: {counter: 1}} if counter else {})
    net.verify()
    for kind, field in ((m.ReceivedSignals, 'signals'), (m.PositionEstimate, 'position'),
                        (m.Beam, 'analog'), (m.Capacity, 'actual_bps'), (m.Data, 'bits')):
        for a, b in zip(net.sent(kind), plain.sent(kind), strict=True):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    for kind in (m.Grant, m.RhsCommand, m.RhsConfiguration, m.Pilot, m.FeedSignals, m.Data):
        assert len(net.sent(kind)) == len(plain.sent(kind))


def test_a_duplicate_beacon_is_answered_once(network):
    net = network(transport=Adds(m.Beacon, {}, 'user1', replace()))
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert net.counters() == {'user1': {'stale_beacon': 1}}
    net.verify()


@pytest.mark.parametrize(('late_s', 'counter'), [(2.5e-3, 'duplicate'), (0.05, 'stale_command')])
def test_a_duplicate_command_is_answered_again_unless_it_is_stale(network, late_s, counter):
    def doubles(message, recipient):
        again = recipient == 'rhs_controller' and matches(message, m.RhsCommand, {'band': 1})
        return [(1e-3, message), *([(late_s, message)] if again else [])]

    net = network(transport=doubles)
    net.run_cycles(2)
    net.run(limit_s=0.06)
    assert net.served()[:2] == [1, 1]
    assert net['rhs_controller'].counters.keys() == {counter}
    net.verify()


@pytest.mark.parametrize('late_s', [0.03, 0.11])
def test_a_late_duplicate_grant_changes_no_position(network, scenario, late_s):
    """The user has finished the cycle, and the channel has begun the next one."""
    def doubles(message, recipient):
        again = [(late_s, message)] if isinstance(message, m.Grant) else []
        return [(1e-3, message), *again]

    walk = mobility.RandomWalk(scenario, 50.0, np.random.default_rng(0))
    net = network({1: walk}, transport=doubles, ordered=False)
    net.run_cycles(4)
    assert net.served() == [1] * 4
    assert [truth.cycle_id for truth in net.sent(m.GroundTruth)] == [1, 2, 3, 4]
    assert set(net['user1'].counters) <= {'late_grant', 'wrong_cycle'}
    assert net['user1'].counters
    net.verify()


def test_a_late_user_is_waited_for_in_the_next_cycle(network):
    """The first ack ends the beaconing of the first cycle; later acks register their users."""
    net = network(2)
    net.run_cycles(1)
    assert net.served() == [1]
    assert net['bs'].counters == {'late_ack': 1}
    net.run_cycles(4)
    assert net.served() == [1, 2, 1, 2, 1]
    assert net['bs'].counters == {'late_ack': 1}


def test_an_unknown_codebook_is_logged_once_by_the_rhs_controller(network, example):
    net = network()
    net.run_cycles(1)
    for _ in range(3):
        net.publish(example(m.RhsCommand, cycle_id=2, codebook_id='strange'))
    net.run_cycles(1)
    complaints = [text for text in net.logged('rhs_controller') if 'strange' in text]
    assert len(complaints) == 1
    assert net['rhs_controller'].counters == {'wrong_codebook': 3}


@pytest.mark.parametrize('kind', [m.Pilot, m.Beam, m.RhsConfiguration], ids=lambda k: k.__name__)
def test_messages_of_incomplete_cycles_do_not_accumulate(network, example, kind):
    net = network()
    net.run_cycles(1)
    for n in range(300):
        net.publish(example(kind, cycle_id=1000 + n))
    net.run_cycles(3)
    assert net.served() == [1] * 4
    assert net['channel'].counters['overflow'] >= 300 - 256


def beacon_to_grant_s(network, cycle_id):
    times = {type(s.message): s.time_s for s in network.log
             if s.message.cycle_id == cycle_id and isinstance(s.message, m.Beacon | m.Grant)}
    return times[m.Grant] - times[m.Beacon]


def test_a_user_lost_while_positioning_is_not_waited_for(network):
    net = network(2)
    net.run_cycles(2)
    net.run_to(State.SOUNDING)
    assert net.sent(m.Grant)[-1].user == 1
    net.remove('user1')
    net.run_cycles(3)
    assert net.outcomes()[2:] == [(3, 1, 'user_gone'), (4, 2, 'served'), (5, 2, 'served')]
    assert net['bs'].counters['user_gone'] == 1
    assert beacon_to_grant_s(net, 4) < 0.01
    net.add('user1')
    net.run_cycles(3)
    assert net.served()[-3:].count(1) >= 1
    net.verify()


def test_a_user_lost_between_cycles_is_waited_for_three_times(network):
    net = network(2)
    net.run_cycles(4)
    net.remove('user2')
    net.run_cycles(6)
    assert net.served()[4:] == [1] * 6
    waits = [beacon_to_grant_s(net, cycle_id) > 0.09 for cycle_id in range(5, 11)]
    assert waits == [True] * 3 + [False] * 3


def test_waiting_for_a_lost_user_does_not_cost_another_its_cycle(network):
    """The time to wait for acks may exceed the time that a user waits for its grant."""
    net = network(2, ack_timeout_s=3.0)
    net.run_cycles(4)
    net.remove('user2')
    net.run_cycles(5)
    assert {outcome for _, _, outcome in net.outcomes()} == {'served'}
    assert net['user1'].counters == {'not_granted': 3}


@pytest.mark.parametrize('state', [State.ESTIMATING, State.STEERING, State.TRANSMITTING])
def test_a_user_lost_after_positioning_loses_only_its_data(network, state):
    net = network(2)
    net.run_cycles(2)
    net.run_to(state)
    net.remove('user1')
    net.run_cycles(2)
    assert net.outcomes()[2:] == [(3, 1, 'data_lost'), (4, 2, 'served')]


ROLE_FAULTS = [
    ('rhs_controller', State.CONFIGURING, 'rhs_silent'),
    ('rhs_controller', State.ESTIMATING, 'transmission_silent'),
    ('channel', State.CONFIGURING, 'user_gone'),
    ('channel', State.SOUNDING, 'user_gone'),
    ('channel', State.ESTIMATING, 'data_lost'),
    ('positioner', State.SOUNDING, 'positioner_silent'),
    ('transmission', State.SOUNDING, 'transmission_silent'),
]


@pytest.mark.parametrize(('role', 'state', 'reason'), ROLE_FAULTS)
@pytest.mark.parametrize('noticed', [True, False])
def test_a_lost_role_causes_a_timeout_and_may_return(network, role, state, reason, noticed):
    net = network()
    net.run_cycles(1)
    net.run_to(state)
    gone_s = net.now_s
    net.remove(role, noticed)
    net.run_cycles(1)
    assert net.outcomes()[-1] == (2, 1, reason)
    assert net.now_s - gone_s < 1.1
    assert net['bs'].counters == {reason: 1}
    assert net['bs'].state is State.RESTING
    net.run(limit_s=10.0)
    if noticed:
        assert net['bs'].state is State.WAITING
        assert net['bs'].counters == {reason: 1}
    else:
        assert net['bs'].state is not State.WAITING
        assert net['bs'].counters.total() > 5
        assert net.served() == [1]
    net.add(role)
    net.run_cycles(3)
    assert net.served()[-2:] == [1, 1]
    net.verify()


@pytest.mark.parametrize('role', ['rhs_controller', 'positioner', 'transmission', 'channel'])
@pytest.mark.parametrize('state', [
    State.BEACONING, State.CONFIGURING, State.SOUNDING, State.ESTIMATING, State.STEERING,
    State.TRANSMITTING, State.RESTING])
def test_a_role_that_restarts_costs_one_cycle_at_most(network, role, state):
    net = network(2)
    net.run_cycles(4)
    net.run_to(state)
    net.restart(role)
    net.run_cycles(4)
    outcomes = [outcome for _, _, outcome in net.outcomes()[4:]]
    assert outcomes[1:] == ['served'] * 3
    net.verify()


@pytest.mark.parametrize('role', ['rhs_controller', 'channel', 'positioner', 'transmission'])
def test_the_base_station_waits_for_a_role_and_logs_it_once(network, role):
    net = network(absent=[role])
    net.run(limit_s=30.0)
    assert net.sent(m.Beacon) == []
    assert net['bs'].state is State.WAITING
    assert net.logged('bs') == [f'waiting for {role}']
    net.add(role)
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert net.logged('bs') == [f'waiting for {role}']
    if role == 'channel':
        assert net.counters() == {}
    else:
        assert net.counters() == {'user1': {'no_beacon': 1}}
        assert net.logged('user1')[1:] == ['no beacon for 3 s', 'beacons resumed']


def test_every_change_of_the_missing_roles_is_logged_once(network):
    net = network(absent=['positioner', 'channel'])
    net.run(limit_s=5.0)
    net.add('channel')
    net.run(limit_s=5.0)
    net.remove('transmission')
    net.run(limit_s=5.0)
    net.add('positioner')
    net.add('transmission')
    assert net.logged('bs') == [
        'waiting for channel, positioner', 'waiting for positioner',
        'waiting for positioner, transmission', 'waiting for transmission']
    net.run_cycles(1)
    net.remove('transmission')
    net.run(limit_s=5.0)
    assert net.logged('bs')[4:] == ['waiting for transmission']


def test_missing_roles_are_not_logged_again_without_a_change(network, codebooks):
    net = network(absent=['positioner'])
    for codebook in codebooks:
        net.offer(codebook)
        net.dispatch('bs', PeersChanged(('positioner',)))
    assert net.logged('bs') == ['waiting for positioner']


def test_a_role_missing_briefly_between_cycles_costs_no_cycle(network):
    net = network()
    net.run_cycles(1)
    net.restart('positioner', noticed=True)
    net.run_cycles(2)
    assert net.served() == [1, 1, 1]
    assert net.logged('bs') == []


def test_a_user_without_a_base_station_waits_and_logs_it_once(network):
    net = network(absent=['bs'])
    net.run(limit_s=30.0)
    assert net.logged('user1') == ['waiting for bs']
    assert net['user1'].state is user_role.State.DISCONNECTED
    net.publish(m.Beacon(cycle_id=7, attempt=0))
    net.run(limit_s=1.0)
    assert net.sent(m.Ack) == []
    net.add('bs')
    net.run_cycles(1)
    assert net.served() == [1]
    assert net.logged('user1') == ['waiting for bs', 'listening for beacons']


@pytest.mark.parametrize('noticed', [True, False])
@pytest.mark.parametrize('cycles', [0, 3])
@pytest.mark.parametrize('state', [
    State.BEACONING, State.CONFIGURING, State.SOUNDING, State.ESTIMATING, State.STEERING,
    State.TRANSMITTING, State.RESTING])
def test_a_restarted_base_station_is_answered(network, state, cycles, noticed):
    net = network(2)
    net.run_cycles(cycles)
    net.run_to(state)
    net.restart('bs', noticed)
    mark, n_ends = len(net.log), len(net.outcomes())
    net.run_cycles(6)
    ends = [(user, outcome) for _, user, outcome in net.outcomes()[n_ends:]]
    assert {user for user, outcome in ends if outcome == 'served'} == {1, 2}
    assert [outcome for _, outcome in ends[2:]] == ['served'] * 4
    assert {ack.user for ack in net.sent(m.Ack, mark)} == {1, 2}
    net.verify()


@pytest.mark.parametrize('state', [State.SOUNDING, State.STEERING])
def test_a_restarted_base_station_uses_the_present_position_of_the_user(network, scenario, state):
    """The number of the interrupted cycle is not used again."""
    walk = mobility.RandomWalk(scenario, 50.0, np.random.default_rng(0))
    net = network({1: walk})
    net.run_to(state)
    net.restart('bs')
    net.run_cycles(2)
    assert net.served() == [1, 1]
    before, again, _ = net.sent(m.GroundTruth)
    assert before.cycle_id == 1 < again.cycle_id
    assert np.linalg.norm(again.position - before.position) > 0.1
    net.verify()


def test_users_wait_without_a_base_station(network):
    net = network(2)
    net.run_cycles(2)
    net.run_to(State.SOUNDING)
    net.remove('bs')
    assert [net[u].state for u in ('user1', 'user2')] == [user_role.State.DISCONNECTED] * 2
    net.run(limit_s=5.0)
    assert net.logged('user1')[-1] == 'waiting for bs'


@pytest.mark.parametrize(('loss', 'seed'), [(0.05, 1), (0.2, 2), (0.2, 3)])
def test_users_are_served_while_messages_are_lost_at_random(network, noisy, loss, seed):
    """With 20 % loss only one cycle in 200 is complete, but no cycles are mixed."""
    net = network(2, transport=noisy(seed, loss=loss), step_timeout_s=0.1)
    duration_s = 60.0 if loss < 0.1 else 300.0
    for half in range(2):
        before = len(net.served())
        net.run(limit_s=duration_s / 2)
        assert len(net.served()) > before, half
    assert {user for _, user, _ in net.outcomes()} == {1, 2}
    reasons = collections.Counter(outcome for _, _, outcome in net.outcomes())
    assert reasons.keys() == {'served', 'rhs_silent', 'user_gone', 'positioner_silent',
                              'transmission_silent', 'data_lost'}
    assert {r: n for r, n in reasons.items() if r != 'served'} == {
        r: n for r, n in net['bs'].counters.items() if r in reasons}
    ends = [0.0, *(s.time_s for s in net.log
                   if isinstance(s.message, m.ProtocolState) and s.message.outcome), net.now_s]
    assert np.diff(ends).max() < 3.0
    net.verify()
    net.transport = lambda message, recipient: [(1e-3, message)]
    net.run_cycles(2)
    mark = len(net.outcomes())
    net.run_cycles(4)
    assert sorted(u for _, u, o in net.outcomes()[mark:] if o == 'served') == [1, 1, 2, 2]


@pytest.mark.parametrize('seed', [1, 2])
def test_cycles_are_not_mixed_under_loss_duplication_and_reordering(network, noisy, seed):
    net = network(3, ordered=False, step_timeout_s=0.2, rest_s=0.0, transport=noisy(
        seed, loss=0.03, doubles=0.2, jitter_s=0.01))
    net.run(limit_s=30.0)
    assert set(net.served()) == {1, 2, 3}
    net.verify()


class Blind:
    """An estimator without a fix in the given cycles."""

    name = 'blind'

    def __init__(self, cycles):
        self._cycles, self._cycle = cycles, 0

    def estimate(self, received):
        self._cycle += 1
        if self._cycle in self._cycles:
            return Estimate(np.full(3, np.nan), np.full((3, 3), np.nan), 'nothing fits')
        return Estimate(np.array([10.0, 0.0, 0.0]), np.eye(3))


def test_without_a_fix_the_cycle_ends_at_once_without_a_position(network):
    net = network(make=lambda codebook: Blind({2}))
    net.run_cycles(3)
    assert net.outcomes() == [(1, 1, 'served'), (2, 1, 'no_fix'), (3, 1, 'served')]
    assert [e.cycle_id for e in net.sent(m.PositionEstimate)] == [1, 3]
    assert not net.sent(m.Beam, cycle_id=2)
    (told,) = net.sent(m.NoFix)
    assert (told.cycle_id, told.user, told.reason) == (2, 1, 'nothing fits')
    (signals_s,) = [s.time_s for s in net.log if isinstance(s.message, m.ReceivedSignals)
                    and s.message.cycle_id == 2]
    (end_s,) = [s.time_s for s in net.log if isinstance(s.message, m.ProtocolState)
                and s.message.outcome == 'no_fix']
    assert end_s - signals_s < 0.01
    assert net.counters() == {
        'bs': {'no_fix': 1}, 'positioner': {'no_fix': 1}, 'user1': {'abandoned': 1}}
    net.verify()


def test_a_lost_no_fix_costs_the_timeout_of_one_step(network):
    net = network(make=lambda codebook: Blind({2}), transport=LosesFirst(m.NoFix, {}))
    net.run_cycles(3)
    assert net.transport.lost is not None
    assert net.outcomes() == [(1, 1, 'served'), (2, 1, 'positioner_silent'), (3, 1, 'served')]
    net.verify()


@pytest.mark.parametrize('changes', [{'cycle_id': 1}, {'user': 2}, {'codebook_id': 'x'}], ids=str)
def test_a_no_fix_of_another_cycle_does_not_end_the_cycle(network, codebooks, changes):
    net = network()
    net.run_cycles(1)
    net.run_to(State.ESTIMATING)
    net.publish(m.NoFix(**{'cycle_id': 2, 'user': 1, 'codebook_id': codebooks[0].id,
                           'reason': ''} | changes))
    net.run_cycles(1)
    assert net.served() == [1, 1]
    assert sum(net['bs'].counters.values()) == 1


def test_a_base_station_without_acks_detects_a_missing_role(network):
    net = network()
    net.run_cycles(1)
    net.remove('user1')
    net.run(limit_s=2.0)
    assert net['bs'].state is State.BEACONING
    net.remove('positioner')
    net.run(limit_s=2.0)
    assert net['bs'].state is State.WAITING
    assert net.logged('bs') == ['waiting for positioner']
    net.add('positioner')
    net.run(limit_s=2.0)
    assert net['bs'].state is State.BEACONING


def test_a_user_that_stops_answering_is_logged_once(network):
    net = network(2)
    net.run_cycles(2)
    net.remove('user2', noticed=False)
    net.run_cycles(8)
    # The user may be removed in the middle of one of its cycles.
    assert net.logged('bs') == ['user 2 no longer answers']
    assert net['bs'].counters['user_lost'] == 1
    net.add('user2')
    net.run_cycles(4)
    assert set(net.served()[-2:]) == {1, 2}
    assert net.logged('bs') == ['user 2 no longer answers']
