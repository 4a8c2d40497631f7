"""Cycles without a position estimate."""

import itertools
import types

import numpy as np
import pytest
from in_memory_network import Fault

from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BsState


@pytest.fixture
def make():
    """Function that returns an estimator without a fix in the second cycle."""
    found = Estimate(np.array([10.0, 0.0, 0.0]), np.eye(3))
    nothing = Estimate(np.full(3, np.nan), np.full((3, 3), np.nan), 'nothing fits')
    results = itertools.chain([found, nothing], itertools.repeat(found))
    return lambda codebook: types.SimpleNamespace(
        name='no_fix', estimate=lambda received: next(results))


def test_without_a_fix_the_cycle_ends_at_once_without_a_position(network, make):
    net = network(make=make)
    net.run_cycles(3)
    assert net.outcomes() == [(1, 1, 'served'), (2, 1, 'no_fix'), (3, 1, 'served')]
    assert [e.cycle_id for e in net.sent(m.PositionEstimate)] == [1, 3]
    assert not net.sent(m.Beam, cycle_id=2)
    (message,) = net.sent(m.NoFix)
    assert (message.cycle_id, message.user, message.reason) == (2, 1, 'nothing fits')
    (signals_s,) = [s.time_s for s in net.log if isinstance(s.message, m.ReceivedSignals)
                    and s.message.cycle_id == 2]
    (end_s,) = [s.time_s for s in net.log if isinstance(s.message, m.ProtocolState)
                and s.message.outcome == 'no_fix']
    assert end_s - signals_s < 0.01
    assert net.logged('bs') == [
        'cycle 2 of user 1 given up: no_fix', 'cycle 3: user 1 served again after: no_fix']
    assert net.counters() == {
        'bs': {'no_fix': 1}, 'positioner': {'no_fix': 1}, 'user1': {'abandoned': 1}}
    net.verify()


def test_a_lost_no_fix_costs_the_timeout_of_one_step(network, make):
    net = network(make=make, transport=Fault(m.NoFix, 'bs', n=1))
    net.run_cycles(3)
    assert net.transport.n_affected
    assert net.outcomes() == [(1, 1, 'served'), (2, 1, 'positioner_silent'), (3, 1, 'served')]
    net.verify()


@pytest.mark.parametrize('changes', [{'cycle_id': 1}, {'user': 2}, {'codebook_id': 'x'}], ids=str)
def test_a_no_fix_of_another_cycle_does_not_end_the_cycle(network, codebooks, changes):
    net = network()
    net.run_cycles(1)
    net.run_to(BsState.ESTIMATING)
    net.publish(m.NoFix(**{'cycle_id': 2, 'user': 1, 'codebook_id': codebooks[0].id,
                           'reason': ''} | changes))
    net.run_cycles(1)
    assert net.served() == [1, 1]
    assert sum(net['bs'].counters.values()) == 1
