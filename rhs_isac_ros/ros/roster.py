"""The roles of a network.

Parameters, the launch file, DDS permissions, the checks for missing roles, and tests derive from
the declarations in `ROSTER`.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.protocol.settings import (
    BaseStationSettings,
    Impairments,
    PositionerSettings,
    TransmissionSettings,
)
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.protocol.user import User
from rhs_isac_ros.ros import topics


@dataclasses.dataclass(frozen=True, kw_only=True)
class Member:
    """Declaration of a role: its class, settings, topics and requirements."""

    role: Any = None  # class of the role, if it exchanges messages of the protocol
    settings: type | None = None  # dataclass of the settings that are parameters, if any
    requires: tuple[str, ...] = ()  # roles that must be present before it serves
    is_unique: bool = True  # whether only one node serves in the role; others stand by
    has_codebook: bool = False  # whether it uses the codebook of the optimizer
    publishes: tuple[str, ...] = ()  # further topics; {user} stands for the number of a user

    @property
    def sent(self) -> tuple[str, ...]:
        """Topics that nodes of the role publish; topics of protocol messages come first."""
        return (*(topics.NAMES[kind] for kind in (self.role.SENDS if self.role else ())),
                *self.publishes, topics.DIAGNOSTICS,
                *((topics.PRESENCE,) if self.is_unique else ()))

    @property
    def received(self) -> tuple[str, ...]:
        """Topics of the network to which nodes of the role subscribe; protocol messages first."""
        return (*(topics.NAMES[kind] for kind in (self.role.RECEIVES if self.role else ())),
                *((topics.CODEBOOK,) if self.has_codebook else ()),
                *((topics.PRESENCE,) if self.is_unique else ()))

    @property
    def needed(self) -> tuple[str, ...]:
        """Roles whose absence the nodes of the role report."""
        return (*self.requires, *((topics.OPTIMIZER_NODE,) if self.has_codebook else ()))


# The launch file and `demo` start the nodes in this order.
ROSTER: Mapping[str, Member] = {
    'rhs_controller': Member(role=RhsController, has_codebook=True),
    'positioner': Member(
        role=Positioner, settings=PositionerSettings, has_codebook=True,
        publishes=(topics.POSITION, topics.POSE, topics.ODOMETRY)),
    'transmission': Member(role=Transmission, settings=TransmissionSettings, has_codebook=True),
    topics.OPTIMIZER_NODE: Member(publishes=(topics.CODEBOOK,)),
    'channel': Member(role=Channel, settings=Impairments),
    'user': Member(
        role=User, publishes=(topics.TRUE_ODOMETRY,), requires=('channel', 'bs'),
        is_unique=False),
    'bs': Member(
        role=BaseStation, settings=BaseStationSettings, has_codebook=True,
        requires=('rhs_controller', 'channel', 'positioner', 'transmission')),
}
# Roles in which only one node of a network serves.
UNIQUE = tuple(name for name, member in ROSTER.items() if member.is_unique)


def identifying_endpoints(name: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return two tuples of topics, published and subscribed, that show that a role is present.

    Each contains the first topic that only this role publishes or subscribes to, if any. One
    is enough, because a node creates its publishers together, and likewise its subscriptions.
    """
    others = [member for other, member in ROSTER.items() if other != name]
    sent = {topic for member in others for topic in member.sent}
    received = {topic for member in others for topic in member.received}
    return (tuple(topic for topic in ROSTER[name].sent if topic not in sent)[:1],
            tuple(topic for topic in ROSTER[name].received if topic not in received)[:1])
