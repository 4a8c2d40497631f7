"""The messages of the protocol, as plain data; their ROS types have the same names and fields."""

import dataclasses
import enum
from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.protocol.fields import MessageError as MessageError
from rhs_isac_ros.protocol.fields import array, index, number, open_float, size
from rhs_isac_ros.protocol.fields import check as check

_LAST_USER = 2**32 - 1
_MOST_BITS = 1e15


class Mode(enum.IntEnum):
    """What the surface is configured for."""

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
    """Phase of the protocol, as the base station sees it."""

    BEACONING = 0
    POSITIONING = 1
    ESTIMATING = 2
    TRANSMITTING = 3


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Message:
    """Anything that travels between the nodes."""

    cycle_id: int

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return sizes that depend on the message's content.

        Parameters
        ----------
        sizes
            Sizes by symbol, as `Scenario.sizes` gives them.

        Returns
        -------
        dict
            More sizes, by the symbols that its fields are declared with.
        """
        return {}


def same(one: Message, other: Message) -> bool:
    """Tell whether two messages say the same, as the double of a message does.

    Parameters
    ----------
    one, other
        Messages.

    Returns
    -------
    bool
        True if they are of one kind and all their fields are equal; NaN equals nothing.
    """
    return type(one) is type(other) and all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name))
        for field in dataclasses.fields(one))


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Beacon(Message):
    """The base station invites users to a cycle."""

    attempt: int


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Ack(Message):
    """A user wants to be served."""

    user: int = number(1, _LAST_USER)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Grant(Message):
    """The cycle belongs to a user."""

    user: int = number(1, _LAST_USER)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class RhsCommand(Message):
    """The surface is to apply the codebook's configurations of a band."""

    band: int = index('N_B')
    codebook_id: str


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class RhsConfiguration(Message):
    """What the surface applies."""

    mode: Mode
    band: int = index('N_B')
    codebook_id: str
    analog: np.ndarray = array('FRAMES N_E', low=0, high=1)

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return the number of frames: one for the whole transmission.

        Parameters
        ----------
        sizes
            Sizes by symbol.

        Returns
        -------
        dict
            The size FRAMES.
        """
        return {'FRAMES': sizes['F'] if self.mode is Mode.POSITIONING else 1}


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PilotRequest(Message):
    """The user is to send the pilots of a band."""

    user: int = number(1, _LAST_USER)
    band: int = index('N_B')
    n_frames: int = size('F')


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Pilot(Message):
    """One unit symbol of the user."""

    user: int = number(1, _LAST_USER)
    band: int = index('N_B')
    frame: int = index('F')
    symbol_re: float
    symbol_im: float


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class FeedSignals(Message):
    """The signals at the feeds for one pilot."""

    user: int = number(1, _LAST_USER)
    band: int = index('N_B')
    frame: int = index('F')
    signals: np.ndarray = array('N_SB K', complex)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ReceivedSignals(Message):
    """The combined signals of a positioning phase."""

    user: int = number(1, _LAST_USER)
    codebook_id: str
    signals: np.ndarray = array('N_B N_SB F', complex)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PositionEstimate(Message):
    """Where the user is."""

    user: int = number(1, _LAST_USER)
    codebook_id: str
    position: np.ndarray = array('3', low=-1e6, high=1e6)
    covariance_m2: np.ndarray = array('3 3')
    crlb_m2: float = open_float()
    estimator: str
    latency_s: float = number(0, 3600)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class NoFix(Message):
    """The received signals tell no position."""

    user: int = number(1, _LAST_USER)
    codebook_id: str
    reason: str


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Beam(Message):
    """The beam of the transmission phase."""

    user: int = number(1, _LAST_USER)
    codebook_id: str
    band: int = index('N_B')
    analog: np.ndarray = array('N_E', low=0, high=1)
    digital: np.ndarray = array('N_SB K', complex)
    expected_bps: float = number(0, _MOST_BITS)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Data(Message):
    """Payload of the transmission phase."""

    user: int = number(1, _LAST_USER)
    direction: Direction
    stage: Stage
    duration_s: float = number(0, 3600)
    bits: float = number(0, _MOST_BITS)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Capacity(Message):
    """What the beam of a cycle carries."""

    user: int = number(1, _LAST_USER)
    codebook_id: str
    band: int = index('N_B')
    expected_bps: float = number(0, _MOST_BITS)
    actual_bps: float = open_float()
    perfect_bps: float = open_float()
    loss_bps: float = open_float()
    loss_percent: float = open_float()
    at_estimate_bps: float = number(0, _MOST_BITS)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class CapacityStatistics(Message):
    """Lower quartile, median and upper quartile of what the newest beams carry."""

    n_reports: int = number(1, 2**32 - 1)
    expected_bps: np.ndarray = array('3', low=0, high=_MOST_BITS)
    actual_bps: np.ndarray = array('3', low=0, high=_MOST_BITS)
    perfect_bps: np.ndarray = array('3', low=0, high=_MOST_BITS)
    loss_bps: np.ndarray = array('3')
    loss_percent: np.ndarray = array('3')


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class GroundTruth(Message):
    """Where the user really is."""

    user: int = number(1, _LAST_USER)
    position: np.ndarray = array('3', low=-1e6, high=1e6)
    velocity: np.ndarray = array('3')


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ProtocolState(Message):
    """A change of phase."""

    user: int = number(0, _LAST_USER)
    phase: Phase
    outcome: str
    began_s: np.ndarray = array('4', may_lack=True)
    elapsed_s: float = number(0, 1e9)
