"""Which nodes receive messages with recipients."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.delivery import (
    DELIVERIES,
    UNKNOWN,
    USER,
    deliveries_from,
    deliveries_to,
    is_due,
)

OF = {(one.kind, one.recipient): one for one in DELIVERIES}
GRANT, UPLINK = OF[m.Grant, USER], OF[m.Data, 'bs']


def test_every_delivery_is_sent_and_received_by_its_roles(roles):
    for one in DELIVERIES:
        assert one.kind in roles[one.sender].SENDS
        assert one.kind in roles[one.recipient].RECEIVES
    assert {*sum(map(deliveries_from, roles), ())} == set(DELIVERIES)
    assert {*sum(map(deliveries_to, roles), ())} == set(DELIVERIES)


@pytest.mark.parametrize(('one', 'instance', 'to', 'due'), [
    (GRANT, 5, (), True),
    (GRANT, 5, (5, 7), True),
    (GRANT, 5, (7,), False),
    (GRANT, 5, (UNKNOWN,), True),
    (GRANT, 5, (USER,), True),
    (UPLINK, 5, ('bs',), True),
    (UPLINK, 5, (5,), False),
    (UPLINK, 5, ('channel',), False)])
def test_recipients_are_roles_or_instances_of_user_nodes(one, instance, to, due):
    assert is_due(one, instance, to) == due
