"""Messages that do not belong to a cycle are dropped and counted; late ones change nothing."""

import dataclasses

import numpy as np
import pytest
from in_memory_network import LATENCY_S, Fault

from rhs_isac_ros.model import mobility
from rhs_isac_ros.protocol import messages as m

POSITIONING, TRANSMISSION = m.Mode.POSITIONING, m.Mode.TRANSMISSION
DOWN = {'direction': m.Direction.DOWNLINK}
UP = {'direction': m.Direction.UPLINK}
OFFERED, DELIVERED = {'stage': m.Stage.OFFERED}, {'stage': m.Stage.DELIVERED}


class Adds(Fault):
    """Sends an altered copy after, or before, the first message of a class to a recipient."""

    before = False

    def __call__(self, message, recipient):
        arriving = [(LATENCY_S, message)]
        if self.affects(message, recipient):
            self.n_affected = 1
            arriving.insert(0 if self.before else 1, (LATENCY_S, self.alter(message)))
        return arriving


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
    (m.Ack, {}, 'bs', {}, 'duplicate'),
    (m.Ack, {}, 'bs', {'user': 2}, 'late_ack'),
    (m.FeedSignals, {}, 'bs', {'cycle_id': 1}, 'wrong_cycle'),
    (m.FeedSignals, {}, 'bs', {'user': 2}, 'wrong_user'),
    (m.FeedSignals, {}, 'bs', {}, 'duplicate'),
    (m.FeedSignals, {'band': 1}, 'bs', {}, 'duplicate'),
    (m.RhsConfiguration, {}, 'bs', {'cycle_id': 1}, 'wrong_cycle'),
    (m.RhsConfiguration, {}, 'bs', {'codebook_id': 'x'}, 'wrong_codebook'),
    (m.RhsConfiguration, {}, 'bs', {'band': 1}, ''),
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


@pytest.fixture(scope='module')
def plain(network):
    net = network(seed=5)
    net.run_cycles(2)
    return net


@pytest.mark.parametrize(
    ('kind', 'fields', 'recipient', 'changes', 'counter', 'before'), WRONG_CASES,
    ids=lambda value: getattr(value, '__name__', str(value)))
def test_altered_messages_are_dropped_and_counted(
        network, plain, kind, fields, recipient, changes, counter, before):
    """The cycle continues as if the altered copy had not arrived."""
    adds = Adds(kind, recipient, n=1, alter=replace(**changes), **fields)
    adds.before = before
    net = network(transport=adds, seed=5)
    net.run_cycles(2)
    assert adds.n_affected
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


@pytest.mark.parametrize(('late_s', 'counter'), [(2.5e-3, 'duplicate'), (0.05, 'stale_command')])
def test_a_duplicate_command_is_answered_again_unless_it_is_stale(network, late_s, counter):
    net = network(transport=Fault(m.RhsCommand, 'rhs_controller', 1e-3, late_s, band=1))
    net.run_cycles(2)
    net.run(limit_s=0.06)
    assert net.served()[:2] == [1, 1]
    assert net['rhs_controller'].counters.keys() == {counter}
    net.verify()


@pytest.mark.parametrize('late_s', [0.03, 0.11])
def test_a_late_duplicate_grant_changes_no_position(network, scenario, late_s):
    """The user has finished the cycle, and the channel has begun the next one."""
    walk = mobility.RandomWalk(scenario, 50.0, np.random.default_rng(0))
    net = network({1: walk}, transport=Fault(m.Grant, 'user1', 1e-3, late_s), ordered=False)
    net.run_cycles(4)
    assert net.served() == [1] * 4
    assert [truth.cycle_id for truth in net.sent(m.GroundTruth)] == [1, 2, 3, 4]
    assert set(net['user1'].counters) <= {'late_grant', 'wrong_cycle'}
    assert net['user1'].counters
    net.verify()


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
