"""Nodes that answer beacons with many numbers, beside users that were served before."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Send

# Name of the node on the bus.
NODE = 'user900'
DURATION_S = 20.0


class Numbers:
    """A node that answers every beacon with all its numbers, and nothing else."""

    def __init__(self, n):
        self._numbers, self.counters = range(3, 3 + n), {}

    def next_deadline(self):
        return None

    def handle(self, event, now_s):
        return [Send(m.Ack(cycle_id=event.cycle_id, user=number)) for number in self._numbers
                if isinstance(event, m.Beacon)]


@pytest.fixture
def attack(network):
    """Function that adds such a node to a network in which two users are served."""
    def make(n=30, **options):
        net = network(2, **options)
        net.run_cycles(4)
        net.instances[NODE] = 10**6
        net._roles[NODE] = Numbers(n)
        return net
    return make


def rates(net):
    """Return the number of cycles that served each of the first two users from now on."""
    first = len(net.served())
    net.run(limit_s=DURATION_S)
    return [net.served()[first:].count(user) for user in (1, 2)]


@pytest.fixture(scope='module')
def usual(network):
    """Number of cycles that serve each of two users that are alone."""
    return min(rates(network(2)))


@pytest.mark.parametrize(('n', 'policy'), [
    (1, 'round_robin'), (30, 'round_robin'), (30, 'first'), (30, 'random')])
def test_numbers_that_complete_no_cycle_take_at_most_half_of_the_time(attack, usual, n, policy):
    served = rates(attack(n, policy=policy))
    worst = 2 * min(served) if policy == 'round_robin' else sum(served)
    assert worst >= 0.45 * 2 * usual
