"""The watch over the results: it is silent on good networks, and names what is wrong."""

import dataclasses
import re

import numpy as np
import pytest

from rhs_isac_ros.monitoring.invariants import RECEIVES, InvariantChecker
from rhs_isac_ros.protocol import messages as m

# Of a cycle without results: what came before it is judged.
END = m.Grant(cycle_id=0, user=1)


@pytest.fixture
def heard(network):
    """What a good network of two users says in four cycles."""
    net = network(2)
    net.run_cycles(4)
    return net


def judge(net, messages, codebooks=True):
    promises = InvariantChecker(net.scenario)
    for codebook in net.codebooks.values() if codebooks else ():
        promises.know(codebook)
    for message in messages:
        promises.add(message, 0.0)
    promises.add(END, 1e9)
    return promises


def messages_of(net):
    return [sent.message for sent in net.log if isinstance(sent.message, RECEIVES)]


def test_a_good_network_breaks_none(heard):
    promises = judge(heard, messages_of(heard))
    assert promises.checked == len(heard.sent(m.PositionEstimate)) + len(heard.sent(m.Capacity))
    assert promises.checked == 8
    assert promises.broken == []


def test_repeats_and_any_order_are_allowed(heard):
    messages = messages_of(heard) * 2
    np.random.default_rng(0).shuffle(messages)
    promises = judge(heard, messages)
    assert promises.checked == 16
    assert promises.broken == []


def test_a_result_is_judged_when_nothing_more_can_come(heard):
    promises = InvariantChecker(heard.scenario)
    for codebook in heard.codebooks.values():
        promises.know(codebook)
    first = [message for message in messages_of(heard) if message.cycle_id == 1]
    for message in sorted(first, key=lambda message: not isinstance(message, m.PositionEstimate)):
        promises.add(message, 5.0)
    assert promises.checked == 0
    promises.add(m.Grant(cycle_id=2, user=1), 5.9)
    assert promises.checked == 0
    promises.add(m.Grant(cycle_id=2, user=1), 6.1)
    assert promises.checked == 2
    assert promises.broken == []


def of(kind, **fields):
    return lambda message: isinstance(message, kind) and message.cycle_id == 2 and all(
        getattr(message, name) == value for name, value in fields.items())


POSITIONING = {'mode': m.Mode.POSITIONING}
TRANSMISSION = {'mode': m.Mode.TRANSMISSION}
# What is taken out of cycle 2, what it is replaced with, and what is said of it.
CASES = {
    'no grant': (of(m.Grant), None, 'granted to nobody'),
    'another user': (of(m.Grant), {'user': 7}, r'granted to \[7\]'),
    'no signals': (of(m.ReceivedSignals), None, 'no received signals'),
    'signals of another': (of(m.ReceivedSignals), {'user': 7}, 'received signals of user 7'),
    'no frame': (of(m.FeedSignals, band=1, frame=0), None, r'incomplete.*\[\(1, 0\)\]'),
    'frame of another': (of(m.FeedSignals, band=1, frame=0), {'user': 7}, r'users \[.*7\]'),
    'no configuration': (of(m.RhsConfiguration, band=1, **POSITIONING), None,
                         'band 1 taken with no configuration'),
    'two codebooks': (of(m.RhsConfiguration, band=1, **POSITIONING), {'codebook_id': 'other'},
                      r"band 1 taken with \['other'\]"),
    'no estimate': (of(m.PositionEstimate), None, 'no such estimate'),
    'no beam': (of(m.Beam), None, 'no such beam'),
    'no beam on the surface': (of(m.RhsConfiguration, **TRANSMISSION), None,
                               'does not hold'),
    'estimate of another codebook': (of(m.PositionEstimate), {'codebook_id': 'other'},
                                     'never offered'),
    'frame of a lie': (of(m.FeedSignals, band=0, frame=1), {'signals': 2.0},
                       'not those at the feeds'),
    'configuration of a lie': (of(m.RhsConfiguration, band=0, **POSITIONING), {'analog': 0.5},
                               'not in the codebook'),
}


@pytest.mark.parametrize('case', CASES)
def test_what_is_wrong_is_named_once_for_each_result_of_the_cycle(heard, case):
    matches, changes, text = CASES[case]
    messages = []
    for message in messages_of(heard):
        if not matches(message):
            messages.append(message)
        elif changes is not None:
            arrays = {name: getattr(message, name) * factor for name, factor in changes.items()
                      if name in ('signals', 'analog')}
            messages.append(dataclasses.replace(message, **changes | arrays))
    promises = judge(heard, messages)
    assert any(re.search(text, fault)
               for fault in promises.broken), promises.broken
    assert len(promises.broken) <= 2
    assert all('of cycle 2,' in fault for fault in promises.broken)


def test_a_codebook_must_have_been_offered(heard):
    promises = judge(heard, messages_of(heard), codebooks=False)
    assert len(promises.broken) == 4
    assert all('never offered' in fault for fault in promises.broken)


def test_what_a_new_publisher_said_before_it_was_heard_is_not_missed(heard):
    promises = InvariantChecker(heard.scenario)
    for codebook in heard.codebooks.values():
        promises.know(codebook)
    promises.expect_silence([m.PositionEstimate])
    for message in messages_of(heard):
        # The first estimate to be heard is that of cycle 3.
        if not (isinstance(message, m.PositionEstimate) and message.cycle_id < 3):
            promises.add(message, 0.0)
    promises.add(END, 1e9)
    assert promises.broken == []
    assert (promises.checked, promises.unverified) == (6, 2)
    # What was heard must fit all the same, and later ones may not be missing.
    for message in messages_of(heard):
        if not isinstance(message, m.PositionEstimate) and message.cycle_id == 4:
            promises.add(dataclasses.replace(message, cycle_id=5), 0.0)
    promises.add(END, 1e9)
    assert promises.broken == [
        f'Capacity of cycle 5, user 2, codebook {next(iter(heard.codebooks))}: no such estimate']


def test_it_forgets_old_cycles(heard):
    promises = InvariantChecker(heard.scenario)
    for cycle_id in range(1000):
        promises.add(m.Grant(cycle_id=cycle_id, user=1), 0.0)
    assert len(promises._cycles) <= 64
