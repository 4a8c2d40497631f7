"""Many users as nodes of their own."""

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m

pytestmark = pytest.mark.usefixtures('plain_beams')

# Twice as many as a beacon invites.
N_USERS = 16


@pytest.fixture
def crowd(network, scenario):
    """A network in which every user has been served, and the place of another one."""
    places = scenario.sample_positions(N_USERS + 1, np.random.default_rng(3))
    net = network({user: places[user - 1] for user in range(1, N_USERS + 1)}, rest_s=0.0)
    net.run(lambda: set(net.served()) == {*range(1, N_USERS + 1)})
    return net, places[-1]


def test_a_restarted_user_is_invited_as_its_new_instance(crowd):
    net, _ = crowd
    net.restart('user5')
    first = len(net.served())
    net.run(lambda: 5 in net.served()[first:], limit_s=10.0)
    instance = net.instances['user5']
    assert instance in {grant.user_instance for grant in net.sent(m.Grant, user=5)}
    net.verify()
