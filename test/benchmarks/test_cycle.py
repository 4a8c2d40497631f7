"""The chain of messages of a cycle, for the benchmark of the cycle."""

import pytest

pytest.importorskip('rclpy')
from benchmarks import cycle  # noqa: E402


@pytest.fixture
def served(network):
    """A cycle with two users, whose messages take a millisecond each."""
    net = network(2)
    net.run_cycles(1)
    return cycle.Cycle([(sent.time_s, sent.message) for sent in net.log
                        if type(sent.message) in cycle.SENDERS and sent.message.cycle_id == 1])


def test_each_message_of_the_chain_is_sent_a_hop_after_the_previous_one(served):
    assert served.is_served
    links = served.links()
    assert [link.elapsed_s for link in links] == pytest.approx([1e-3] * len(links))
    assert sum(link.elapsed_s for link in links) == pytest.approx(served.duration_s)
    assert [link[:2] for link in links] == [
        ('ack', 'user'), ('rhs/command', 'bs'), ('rhs/configuration', 'rhs_controller'),
        ('pilot_request', 'bs'), ('pilot', 'user'), ('feed_signals', 'channel'),
        ('received_signals', 'bs'), ('position_estimate', 'positioner'), ('beam', 'transmission'),
        ('rhs/configuration (beam)', 'rhs_controller'), ('data downlink offered', 'bs'),
        ('data downlink delivered', 'channel'), ('data uplink offered', 'user'),
        ('data uplink delivered', 'channel'), ('end', 'bs')]


def test_a_cycle_that_was_given_up_is_not_served(served):
    assert not cycle.Cycle([pair for pair in served.sent
                            if getattr(pair[1], 'outcome', '') != 'served']).is_served
