"""The checker accepts the results of correct networks and describes every violation."""

import dataclasses
import re

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from system.invariants import RECEIVES, InvariantChecker


@pytest.fixture
def net(network):
    """A network of two users after four cycles."""
    result = network(2)
    result.run_cycles(4)
    return result


def messages_of(net):
    return [sent.message for sent in net.log if isinstance(sent.message, RECEIVES)]


def test_a_correct_network_has_no_violations(net):
    checker = net.check_invariants()
    assert checker.checked == len(net.sent(m.PositionEstimate)) + len(net.sent(m.Capacity))
    assert checker.checked == 8
    assert checker.violations == []


def test_messages_may_repeat_and_arrive_in_any_order(net):
    messages = messages_of(net) * 2
    np.random.default_rng(0).shuffle(messages)
    checker = net.check_invariants(messages)
    assert checker.checked == 16
    assert checker.violations == []


def test_a_result_is_checked_after_the_settling_time(net):
    checker = net.checker()
    first = [message for message in messages_of(net) if message.cycle_id == 1]
    for message in sorted(first, key=lambda message: not isinstance(message, m.PositionEstimate)):
        checker.add(message, 5.0)
    assert checker.checked == 0
    checker.add(m.Grant(cycle_id=2, user=1), 5.9)
    assert checker.checked == 0
    checker.add(m.Grant(cycle_id=2, user=1), 6.1)
    assert checker.checked == 2
    assert checker.violations == []


def of(kind, **fields):
    return lambda message: isinstance(message, kind) and message.cycle_id == 2 and all(
        getattr(message, name) == value for name, value in fields.items())


POSITIONING = {'mode': m.Mode.POSITIONING}
TRANSMISSION = {'mode': m.Mode.TRANSMISSION}
# Which messages of cycle 2 are changed, how (None: removed), and the expected violation.
CASES = {
    'no grant': (of(m.Grant), None, 'granted to nobody'),
    'another user': (of(m.Grant), {'user': 7}, r'granted to \[7\]'),
    'no signals': (of(m.ReceivedSignals), None, 'no received signals'),
    'signals of another': (of(m.ReceivedSignals), {'user': 7}, 'received signals of user 7'),
    'no band': (of(m.FeedSignals, band=1), None, r'incomplete.*\[1\]'),
    'band of another': (of(m.FeedSignals, band=1), {'user': 7}, r'users \[.*7\]'),
    'no configuration': (of(m.RhsConfiguration, band=1, **POSITIONING), None,
                         'band 1 measured with no configuration'),
    'two codebooks': (of(m.RhsConfiguration, band=1, **POSITIONING), {'codebook_id': 'other'},
                      r"band 1 measured with \['other'\]"),
    'no estimate': (of(m.PositionEstimate), None, 'no such estimate'),
    'no beam': (of(m.Beam), None, 'no such beam'),
    'no beam on the surface': (of(m.RhsConfiguration, **TRANSMISSION), None,
                               'not applied by the surface'),
    'estimate of another codebook': (of(m.PositionEstimate), {'codebook_id': 'other'},
                                     'never offered'),
    'mutated band': (of(m.FeedSignals, band=1), {'signals': 2.0},
                       'do not match the feed signals'),
    'huge band': (of(m.FeedSignals, band=1), {'signals': 1e300}, 'do not match the feed signals'),
    'mutated configuration': (of(m.RhsConfiguration, band=0, **POSITIONING), {'analog': 0.5},
                               'not in the codebook'),
    'two channels': (of(m.FeedSignals, band=1), {'sender': 77}, 'several channels'),
    'another position': (of(m.GroundTruth), {'position': np.array([0.3, 0.0, 0.0])},
                         'do not match the true position'),
}


@pytest.mark.parametrize('case', CASES)
def test_a_fault_is_reported_once_for_each_result_of_its_cycle(net, case):
    matches, changes, text = CASES[case]
    messages = []
    for message in messages_of(net):
        if not matches(message):
            messages.append(message)
        elif changes is not None:
            arrays = {name: getattr(message, name) * factor for name, factor in changes.items()
                      if name in ('signals', 'analog')}
            messages.append(dataclasses.replace(message, **changes | arrays))
    checker = net.check_invariants(messages)
    assert any(re.search(text, fault) for fault in checker.violations), checker.violations
    assert len(checker.violations) <= 2
    assert all('of cycle 2,' in fault for fault in checker.violations)


def test_a_codebook_must_have_been_offered(net):
    net.codebooks.clear()
    checker = net.check_invariants()
    assert len(checker.violations) == 4
    assert all('never offered' in fault for fault in checker.violations)


def test_messages_of_an_undiscovered_publisher_may_be_missing(net):
    (codebook_id,), checker, end = net.codebooks, net.checker(), m.Grant(cycle_id=0, user=1)
    checker.expect_rediscovery([m.PositionEstimate])
    for message in messages_of(net):
        # The first estimate that arrives is that of cycle 3.
        if not (isinstance(message, m.PositionEstimate) and message.cycle_id < 3):
            checker.add(message, 0.0)
    checker.add(end, 1e9)
    assert checker.violations == []
    assert (checker.checked, checker.unverified) == (6, 2)
    # After the discovery, a missing estimate is a violation.
    for message in messages_of(net):
        if not isinstance(message, m.PositionEstimate) and message.cycle_id == 4:
            checker.add(dataclasses.replace(message, cycle_id=5), 0.0)
    checker.add(end, 1e9)
    assert checker.violations == [
        f'Capacity of cycle 5, user 2, codebook {codebook_id}: no such estimate']


def test_a_node_that_replaces_another_may_be_discovered_late(net):
    """Messages of the node that is to be replaced do not end the tolerance."""
    checker = InvariantChecker(net.scenario)
    older, newer = 1, 2
    for cycle_id, sender in ((1, older), (2, older), (4, newer)):
        if cycle_id == 2:
            checker.expect_rediscovery([m.Grant], by_another=True)
        checker.add(m.Grant(cycle_id=cycle_id, user=1, sender=sender), 0.0)
        tolerated = m.Grant in checker._undiscovered
        assert tolerated == (cycle_id == 2)


def test_old_cycles_are_discarded(net):
    checker = InvariantChecker(net.scenario)
    for cycle_id in range(1000):
        checker.add(m.Grant(cycle_id=cycle_id, user=1), 0.0)
    assert len(checker._cycles) <= 64
