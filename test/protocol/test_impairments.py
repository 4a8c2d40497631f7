"""A channel with impairments, and the protocol under them."""

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel, ImpairedChannel
from rhs_isac_ros.protocol.events import LogMessage, Send, Timeout
from rhs_isac_ros.protocol.role import PlainRole
from rhs_isac_ros.protocol.settings import Impairments


class Repeats(PlainRole):
    """Publishes each message that it receives, with a log message."""

    SENDS = RECEIVES = ()

    def handle(self, event, now_s):
        return [Send(event), LogMessage('received')]


@pytest.fixture
def impaired():
    """Function that takes impairments and returns an impaired `Repeats`."""
    def make(seed=0, **impairments):
        return ImpairedChannel(Repeats(), Impairments(**impairments), np.random.default_rng(seed))
    return make


def through(role, n):
    """Return the cycle ids of n messages sent at time 0, in the order of their arrival."""
    arrived = [action for cycle in range(n) for action in role.handle(m.Beacon(
        cycle_id=cycle, attempt=0), 0.0)]
    while (due_s := role.next_deadline()) is not None:
        arrived += role.handle(Timeout(), due_s)
    assert sum(isinstance(action, LogMessage) for action in arrived) == n
    return [action.message.cycle_id for action in arrived if isinstance(action, Send)]


def test_an_ideal_channel_changes_nothing(impaired):
    role = impaired()
    (sent, note) = sorted(
        role.handle(m.Beacon(cycle_id=5, attempt=0), 1.0), key=lambda a: isinstance(a, LogMessage))
    assert (sent.message.cycle_id, note.text) == (5, 'received')
    assert role.next_deadline() is None
    assert role.counters == {}


def test_losses_and_duplicates_have_their_probabilities_and_are_counted(impaired):
    role = impaired(loss_probability=0.2, double_probability=0.1)
    arrived = through(role, 5000)
    lost = 5000 - len(set(arrived))
    doubled = len(arrived) - len(set(arrived))
    assert role.counters == {'emulated_loss': lost, 'emulated_double': doubled}
    # Four standard deviations of the binomial.
    assert abs(lost - 1000) < 4 * np.sqrt(5000 * 0.2 * 0.8)
    assert abs(doubled - 400) < 4 * np.sqrt(4000 * 0.1 * 0.9)
    assert len(arrived) <= 2 * len(set(arrived))


def test_messages_are_delayed_at_random_and_reordered(impaired):
    role = impaired(delay_s=0.5, jitter_s=0.2)
    role.handle(m.Beacon(cycle_id=1, attempt=0), 10.0)
    due_s = role.next_deadline()
    assert 10.5 <= due_s <= 10.7
    assert role.handle(Timeout(), due_s - 1e-6) == []
    (sent,) = role.handle(Timeout(), due_s)
    assert sent.message.cycle_id == 1
    arrived = through(role, 100)
    assert sorted(arrived) == list(range(100))
    assert arrived != sorted(arrived)


def test_without_jitter_the_order_is_kept(impaired):
    assert through(impaired(delay_s=0.5), 50) == list(range(50))


def test_impairments_of_messages_are_independent(impaired):
    some, more = (set(through(impaired(loss_probability=p), 1000)) for p in (0.3, 0.1))
    assert some < more


def test_nearly_all_cycles_are_served_under_impairments(network):
    net = network(2, rest_s=0.0, retries=3)
    air = Impairments(0.05, 0.05, 1e-3, 5e-3, multipath_memory=False)
    channel = Channel(net.scenario, net.seed, air)
    net._roles['channel'] = ImpairedChannel(channel, air, np.random.default_rng(1))
    net.run_cycles(300, limit_s=600.0)
    outcomes = [outcome for _, _, outcome in net.outcomes()]
    assert outcomes.count('served') >= 0.99 * len(outcomes)
    assert net['channel'].counters['emulated_loss'] > 50
    assert net['bs'].counters['retry_band'] > 25
    net.verify()
