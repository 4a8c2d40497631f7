"""Messages on the air, and the protocol under impairments."""

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Air, Channel
from rhs_isac_ros.protocol.settings import Impairments


def through(n, **impairments):
    """Return the cycle ids of n messages sent at time 0, as they arrive, and what was counted."""
    air = Air(np.random.default_rng(0))
    counted = [air.send(m.Beacon(cycle_id=cycle, attempt=0), Impairments(**impairments), 0.0)
               for cycle in range(n)]
    return [message.cycle_id for message in air.arrived(np.inf)], counted


def test_without_impairments_messages_arrive_at_once_in_order():
    assert through(50) == ([*range(50)], [''] * 50)
    assert through(50, delay_s=0.5)[0] == [*range(50)]


def test_losses_and_duplicates_have_their_probabilities_and_are_counted():
    arrived, counted = through(5000, loss_probability=0.2, double_probability=0.1)
    lost = 5000 - len(set(arrived))
    doubled = len(arrived) - len(set(arrived))
    assert counted.count('emulated_loss') == lost
    assert counted.count('emulated_double') == doubled
    # Four standard deviations of the binomial.
    assert abs(lost - 1000) < 4 * np.sqrt(5000 * 0.2 * 0.8)
    assert abs(doubled - 400) < 4 * np.sqrt(4000 * 0.1 * 0.9)
    assert len(arrived) <= 2 * len(set(arrived))


def test_messages_are_delayed_at_random_and_reordered():
    air = Air(np.random.default_rng(0))
    air.send(m.Beacon(cycle_id=1, attempt=0), Impairments(delay_s=0.5, jitter_s=0.2), 10.0)
    due_s = air.in_flight[0][0]
    assert 10.5 <= due_s <= 10.7
    assert air.arrived(due_s - 1e-6) == []
    (message,) = air.arrived(due_s)
    assert message.cycle_id == 1
    assert air.arrived(np.inf) == []
    arrived, _ = through(100, delay_s=0.5, jitter_s=0.2)
    assert sorted(arrived) == [*range(100)]
    assert arrived != sorted(arrived)


def test_impairments_of_messages_are_independent():
    some, more = (set(through(1000, loss_probability=p)[0]) for p in (0.3, 0.1))
    assert some < more


def test_nearly_all_cycles_are_served_under_impairments(network):
    net = network(2, rest_s=0.0, retries=3)
    net._roles['channel'] = channel = Channel(
        net.scenario, net.seed, Impairments(0.05, 0.05, 1e-3, 5e-3, multipath_memory=False))
    channel._air = Air(np.random.default_rng(1))
    net.run_cycles(300, limit_s=600.0)
    outcomes = net.ends()
    assert outcomes.count('served') >= 0.99 * len(outcomes)
    assert net['channel'].counters['emulated_loss'] > 50
    assert net['bs'].counters['retry_band'] > 25
    net.verify()
