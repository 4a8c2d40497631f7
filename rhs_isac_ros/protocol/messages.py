"""The messages of the protocol as dataclasses; ROS types have the same names and fields."""

import dataclasses
import enum
from collections.abc import Iterator, Mapping

import numpy as np

from rhs_isac_ros.protocol.fields import MessageError as MessageError
from rhs_isac_ros.protocol.fields import array, index, number, optional_float, size
from rhs_isac_ros.protocol.fields import check as check

_LAST_USER = 2**32 - 1
_MAX_BITS = 1e15


class Mode(enum.IntEnum):
    """Purpose of a configuration of the surface."""

    POSITIONING = 0
    TRANSMISSION = 1


class Direction(enum.IntEnum):
    """Direction of a transmission."""

    DOWNLINK = 0
    UPLINK = 1


class Stage(enum.IntEnum):
    """Whether data enter or leave the channel."""

    OFFERED = 0
    DELIVERED = 1


class Phase(enum.IntEnum):
    """Phase of a cycle, from the point of view of the base station."""

    BEACONING = 0
    POSITIONING = 1
    ESTIMATING = 2
    TRANSMITTING = 3


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Message:
    """Base of all messages.

    The adapter to ROS sets `sender` and `scenario_id` of the messages that a role sends, and drops
    received messages of another scenario.

    Attributes
    ----------
    sender
        Instance of the node that sent the message: its start in nanoseconds since 1970; 0 if
        unknown, as in messages sent by hand.
    scenario_id
        `Scenario.id` of that node; empty if unknown.
    """

    cycle_id: int
    sender: int = 0
    scenario_id: str = ''

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return sizes that depend on the content, by symbol.

        Parameters
        ----------
        sizes
            Sizes by symbol, as in `Scenario.sizes`.
        """
        return {}


def same_instance(one: int, other: int) -> bool:
    """Return whether two instances of a node are equal, or one of them is 0, which is unknown."""
    return one == other or not one or not other


def same(one: Message, other: Message) -> bool:
    """Return whether two messages have the same class and equal fields; NaN != NaN."""
    return type(one) is type(other) and all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name))
        for field in dataclasses.fields(one))


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Beacon(Message):
    """Invitation from the base station to a range of users to take part in a cycle."""

    attempt: int
    first_user: int = number(1, _LAST_USER, default=1)
    last_user: int = number(1, _LAST_USER, default=_LAST_USER)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Ack(Message):
    """Request of a user to be served."""

    user: int = number(1, _LAST_USER)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Grant(Message):
    """Assignment of the cycle to a user."""

    user: int = number(1, _LAST_USER)
    user_instance: int = 0


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class RhsCommand(Message):
    """Command to apply the configurations of a codebook for a band."""

    band: int = index('N_B')
    codebook_id: str


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class RhsConfiguration(Message):
    """Report of the configurations that the surface applies."""

    mode: Mode
    band: int = index('N_B')
    codebook_id: str
    analog: np.ndarray = array('FRAMES N_E', low=0, high=1)

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return the number of frames, FRAMES: 1 for a transmission."""
        return {'FRAMES': sizes['F'] if self.mode is Mode.POSITIONING else 1}


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PilotRequest(Message):
    """Request to a user to send the pilots of a range of bands, in order."""

    user: int = number(1, _LAST_USER)
    user_instance: int = 0
    band: int = index('N_B')
    last_band: int = index('N_B')
    n_frames: int = size('F')


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Pilot(Message):
    """Pilots of a user for a band, a symbol of unit magnitude in each frame."""

    user: int = number(1, _LAST_USER)
    band: int = index('N_B')
    symbols: np.ndarray = array('F', complex)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class FeedSignals(Message):
    """Signals at the feeds for the pilots of a band."""

    user: int = number(1, _LAST_USER)
    user_instance: int = 0
    band: int = index('N_B')
    signals: np.ndarray = array('F N_SB K', complex)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ReceivedSignals(Message):
    """Combined signals of a positioning phase."""

    user: int = number(1, _LAST_USER)
    user_instance: int = 0
    codebook_id: str
    signals: np.ndarray = array('N_B N_SB F', complex)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PositionEstimate(Message):
    """Estimate of the position of a user."""

    user: int = number(1, _LAST_USER)
    user_instance: int = 0
    codebook_id: str
    position: np.ndarray = array('3', low=-1e6, high=1e6)
    covariance_m2: np.ndarray = array('3 3')
    crlb_m2: float = optional_float()
    estimator: str
    latency_s: float = number(0, 3600)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class NoFix(Message):
    """Report that no position can be estimated from the received signals."""

    user: int = number(1, _LAST_USER)
    codebook_id: str
    reason: str


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Beam(Message):
    """Beam of the transmission phase."""

    user: int = number(1, _LAST_USER)
    codebook_id: str
    band: int = index('N_B')
    analog: np.ndarray = array('N_E', low=0, high=1)
    digital: np.ndarray = array('N_SB K', complex)
    expected_bps: float = number(0, _MAX_BITS)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Data(Message):
    """Payload of the transmission phase."""

    user: int = number(1, _LAST_USER)
    direction: Direction
    stage: Stage
    duration_s: float = number(0, 3600)
    bits: float = number(0, _MAX_BITS)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Capacity(Message):
    """Capacity of the beam of a cycle."""

    user: int = number(1, _LAST_USER)
    codebook_id: str
    band: int = index('N_B')
    expected_bps: float = number(0, _MAX_BITS)
    actual_bps: float = optional_float()
    perfect_bps: float = optional_float()
    loss_bps: float = optional_float()
    loss_percent: float = optional_float()
    at_estimate_bps: float = number(0, _MAX_BITS)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class CapacityStatistics(Message):
    """Lower quartile, median and upper quartile of the capacities of the latest beams."""

    n_reports: int = number(1, 2**32 - 1)
    expected_bps: np.ndarray = array('3', low=0, high=_MAX_BITS)
    actual_bps: np.ndarray = array('3', low=0, high=_MAX_BITS)
    perfect_bps: np.ndarray = array('3', low=0, high=_MAX_BITS)
    loss_bps: np.ndarray = array('3')
    loss_percent: np.ndarray = array('3')


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class GroundTruth(Message):
    """True position of a user."""

    user: int = number(1, _LAST_USER)
    position: np.ndarray = array('3', low=-1e6, high=1e6)
    velocity: np.ndarray = array('3')


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class GroundTruths(Message):
    """True positions of all users of one node."""

    users: np.ndarray = array('USERS', int, low=1, high=_LAST_USER)
    position: np.ndarray = array('USERS 3', low=-1e6, high=1e6)
    velocity: np.ndarray = array('USERS 3')

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return the number of users, USERS."""
        return {'USERS': len(self.users)}

    def each(self) -> Iterator[GroundTruth]:
        """Yield the true position of each user."""
        for user, position, velocity in zip(
                self.users.tolist(), self.position, self.velocity, strict=True):
            yield GroundTruth(
                cycle_id=self.cycle_id, sender=self.sender, scenario_id=self.scenario_id,
                user=user, position=position, velocity=velocity)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ProtocolState(Message):
    """Change of phase of a cycle."""

    user: int = number(0, _LAST_USER)
    phase: Phase
    outcome: str
    began_s: np.ndarray = array('4', nan_allowed=True)
    elapsed_s: float = number(0, 1e9)
