"""Nodes that answer beacons with many numbers, beside users that were served before."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Send

pytestmark = pytest.mark.usefixtures('plain_beams')

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


@pytest.fixture
def usual(network):
    """Number of cycles that serve each of two users that are alone."""
    return min(rates(network(2)))


@pytest.mark.parametrize('n', [1, 4, 30])
def test_numbers_that_complete_no_cycle_take_at_most_half_of_the_time(attack, usual, n):
    net = attack(n)
    assert min(rates(net)) >= 0.45 * usual
    net.verify()


@pytest.mark.parametrize('policy', ['first', 'random'])
def test_other_policies_protect_the_users_too(attack, usual, policy):
    assert sum(rates(attack(policy=policy))) >= 0.45 * 2 * usual


@pytest.mark.parametrize('name', ['user1', 'channel'])
def test_a_restart_does_not_end_the_protection(attack, places, usual, name):
    net = attack()
    net.run_cycles(10)
    net.remove(name, noticed=False)
    net.run(limit_s=1.6)
    if name == 'channel':
        net.add(name)
    else:
        net.add_user(1, places[0])
    net.run(limit_s=5.0)
    assert min(rates(net)) >= 0.45 * usual


def test_numbers_that_were_served_lose_their_rank_when_they_complete_no_more_cycles(
        network, places, usual):
    net = network(2)
    net.run_cycles(4)
    net.add_users(dict.fromkeys(range(3, 33), places[0]), NODE)
    net.run(lambda: len(set(net.served())) == 32)
    net.transport = lambda message, recipient: (
        [] if recipient == NODE and isinstance(message, m.PilotRequest) else [(1e-3, message)])
    # Six of the numbers are seniors. Each of them fails three times.
    net.run(limit_s=90.0)
    assert min(rates(net)) >= 0.45 * usual
