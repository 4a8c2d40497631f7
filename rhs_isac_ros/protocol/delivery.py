"""Messages that wake only the nodes to which they are addressed.

Every message of the protocol has a topic. If all nodes subscribed to it, each would also receive
the messages for others, and receiving a message often takes longer than handling it. The messages
in `DELIVERIES` therefore have further topics, to which only their recipients subscribe.
"""

from typing import NamedTuple

from rhs_isac_ros.protocol import messages as m

# A role, `OBSERVERS` for none of the roles, or the instance of a node of users, where `UNKNOWN`
# stands for all of these nodes.
Recipient = str | int
OBSERVERS = 'observers'
USER, UNKNOWN = 'user', 0


class Delivery(NamedTuple):
    """A message that is delivered on topics of its recipients.

    Attributes
    ----------
    kind
        Class of the message.
    sender, recipient
        The roles.
    """

    kind: type[m.Message]
    sender: str
    recipient: str


DELIVERIES = (
    Delivery(m.Beacon, 'bs', USER),
    Delivery(m.Grant, 'bs', USER),
    Delivery(m.PilotRequest, 'bs', USER),
    Delivery(m.RhsConfiguration, 'rhs_controller', 'transmission'),
    Delivery(m.GroundTruth, USER, 'channel'),
    Delivery(m.GroundTruth, USER, 'transmission'),
    # Offered to the channel, which delivers them.
    Delivery(m.Data, 'bs', 'channel'),
    Delivery(m.Data, USER, 'channel'),
    Delivery(m.Data, 'channel', 'bs'),
    Delivery(m.Data, 'channel', USER),
)


def deliveries_from(sender: str) -> tuple[Delivery, ...]:
    """Return the deliveries that a role sends."""
    return tuple(one for one in DELIVERIES if one.sender == sender)


def deliveries_to(recipient: str) -> tuple[Delivery, ...]:
    """Return the deliveries to a role."""
    return tuple(one for one in DELIVERIES if one.recipient == recipient)


def is_due(one: Delivery, instance: int, to: tuple[Recipient, ...]) -> bool:
    """Return whether a node of the recipient receives a delivery.

    Parameters
    ----------
    instance
        Instance of the node.
    to
        Recipients, as in `Send`.
    """
    return not to or one.recipient in to or (
        one.recipient == USER and (instance in to or UNKNOWN in to))
