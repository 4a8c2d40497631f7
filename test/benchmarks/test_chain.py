"""The chain of messages of a cycle, for the benchmark of the cycle."""

import importlib.util
from pathlib import Path

import pytest

PARTS = Path(__file__).parents[2] / 'scripts' / 'benchmarks' / 'parts'


def load(name):
    spec = importlib.util.spec_from_file_location(name, PARTS / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def chain():
    return load('chain')


@pytest.fixture
def cycle(chain, network):
    """A cycle with two users, whose messages take a millisecond each."""
    net = network(2)
    net.run_cycles(1)
    found = chain.Cycle()
    found.sent = [(sent.time_s, sent.message) for sent in net.log
                  if isinstance(sent.message, chain.KINDS) and sent.message.cycle_id == 1]
    return found


def test_each_message_of_the_chain_is_sent_a_hop_after_the_previous_one(cycle):
    links = cycle.links()
    assert len(links) == len(load('hops').CHAIN)
    assert [link.elapsed_s for link in links] == pytest.approx([1e-3] * len(links))
    assert sum(link.elapsed_s for link in links) == pytest.approx(cycle.duration_s)


def test_the_chain_names_messages_and_their_senders(cycle):
    names = [(link.name, link.sender) for link in cycle.links()]
    assert names[:5] == [
        ('ack', 'user'), ('rhs/command', 'bs'), ('rhs/configuration', 'rhs_controller'),
        ('pilot_request', 'bs'), ('pilot', 'user')]
    assert names[-5:] == [
        ('data downlink offered', 'bs'), ('data downlink delivered', 'channel'),
        ('data uplink offered', 'user'), ('data uplink delivered', 'channel'), ('end', 'bs')]


def test_a_cycle_that_was_given_up_is_not_served(chain, cycle):
    assert cycle.is_served
    assert cycle.began_s()[0] == 0.0
    given_up = chain.Cycle()
    given_up.sent = [pair for pair in cycle.sent if getattr(pair[1], 'outcome', '') != 'served']
    assert not given_up.is_served
