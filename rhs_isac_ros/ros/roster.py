"""The roles of a network.

Parameters, the launch files, DDS permissions, the checks for missing roles, and tests derive from
the declarations in `MEMBERS`.
"""

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.fusion import Fusion
from rhs_isac_ros.protocol.messages import Beam, Data, Message, RhsConfiguration
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.protocol.receiver import Receiver
from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.protocol.settings import (
    BaseStationSettings,
    FusionSettings,
    Impairments,
    PositionerSettings,
    ReceiverSettings,
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
    requires_of_site: tuple[str, ...] = ()  # roles of the whole site, if any, that must be, too
    from_all: tuple[type[Message], ...] = ()  # messages from every surface of a site, not only its
    is_unique: bool = True  # whether only one node serves in the role; others stand by
    has_codebook: bool = False  # whether it uses the codebook of the optimizer
    of_site: bool = False  # whether it serves all surfaces of a site instead of one
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
                *self.announced)

    @property
    def announced(self) -> tuple[str, ...]:
        """Topics with the codebook and the presence of other nodes, in its own namespace."""
        return (*((topics.CODEBOOK,) if self.has_codebook else ()), topics.PRESENCE)

    @property
    def needed(self) -> tuple[str, ...]:
        """Roles whose absence the nodes of the role report."""
        return (*self.requires, *((topics.OPTIMIZER_NODE,) if self.has_codebook else ()))


# A network with one surface. The launch file and `demo` start the nodes in this order.
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
        from_all=(Data,), is_unique=False),
    'bs': Member(
        role=BaseStation, settings=BaseStationSettings, has_codebook=True,
        requires=('rhs_controller', 'channel', 'positioner', 'transmission'),
        requires_of_site=('fusion',), from_all=(Beam, RhsConfiguration, Data)),
}
# The other roles of a site.
_OF_SITES: Mapping[str, Member] = {
    'receiver': Member(role=Receiver, settings=ReceiverSettings, has_codebook=True),
    'fusion': Member(
        role=Fusion, settings=FusionSettings, of_site=True, from_all=Fusion.RECEIVES,
        publishes=(topics.POSITION, topics.POSE, topics.ODOMETRY)),
}
MEMBERS: Mapping[str, Member] = {**ROSTER, **_OF_SITES}
# The roles of a surface that follows the base station of another one.
FOLLOWING = ('rhs_controller', 'positioner', 'transmission', topics.OPTIMIZER_NODE, 'channel',
             'receiver')


# Roles in which only one node of a network serves.
UNIQUE = tuple(name for name, member in ROSTER.items() if member.is_unique)
# Maximum number of users for which `network`, `demo` and the launch file start one node each. More
# users run in one node, because every node takes memory, and CPU time even between cycles.
MAX_USER_NODES = 16


class Placed(NamedTuple):
    """A node of a network or a site."""

    namespace: str  # relative to that of the site; empty without a site
    role: str
    name: str  # empty: that of the role
    users: dict[str, Any]  # parameters with the users of the node, if it has any


def networks(surfaces: Collection[str] = ()) -> list[tuple[str, tuple[str, ...]]]:
    """Return the namespaces and the roles of the networks of a site, given its surfaces.

    Namespaces are relative to that of the site. The first surface leads, and comes first; the
    roles of the whole site come last. Without surfaces, there is one network without a name.
    """
    if not surfaces:
        return [('', tuple(ROSTER))]
    leader, *others = surfaces
    return [(leader, tuple(ROSTER)), *((name, FOLLOWING) for name in others),
            ('', tuple(name for name, member in MEMBERS.items() if member.of_site))]


def nodes_of(users: int, surfaces: Collection[str] = (), together: bool = False
             ) -> Iterator[Placed]:
    """Yield the nodes of a network, or of a site with `surfaces`; users are numbered from 1.

    If `together`, the users are in one node.
    """
    of_users = {'users': (1, users)} if together else {
        f'user_{user}': (user, 1) for user in range(1, users + 1)}
    for namespace, roles in networks(surfaces):
        for role in roles:
            if MEMBERS[role].is_unique:
                yield Placed(namespace, role, '', {})
                continue
            for name, (first, count) in of_users.items():
                yield Placed(namespace, role, name, {'user_id': first, 'user_count': count})
