"""Events that the roles handle besides messages, their actions, and the outcomes they count."""

import dataclasses
import enum
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.frontend import Sounding
from rhs_isac_ros.positioning import Estimate, Estimator, SearchEstimator
from rhs_isac_ros.positioning.agreement import Pair
from rhs_isac_ros.protocol.messages import Message


@dataclasses.dataclass(frozen=True)
class Timeout:
    """The deadline of the role has passed."""


@dataclasses.dataclass(frozen=True)
class Immediately:
    """Another event has led to the present state: the event of rows that wait for nothing."""


@dataclasses.dataclass(frozen=True, eq=False)
class CodebookOffered:
    """A codebook is available to the role."""

    codebook: Codebook


@dataclasses.dataclass(frozen=True)
class SettingsOffered:
    """New settings, of the same class as the current ones, are available to the role."""

    settings: Any


@dataclasses.dataclass(frozen=True)
class PeersChanged:
    """The required roles that are missing, or another missing requirement, have changed."""

    missing: tuple[str, ...]
    lacking: str = ''  # description of a missing requirement that is not a role


@dataclasses.dataclass(frozen=True)
class StoodBy:
    """The node stands by, because a newer one has the same role."""


@dataclasses.dataclass(frozen=True)
class Resumed:
    """The node serves again; another node may have used cycle ids below `first_cycle_id`."""

    first_cycle_id: int


@dataclasses.dataclass(frozen=True)
class PauseRequested:
    """An operator requests a pause after the current cycle."""


@dataclasses.dataclass(frozen=True)
class ResumeRequested:
    """An operator requests the end of a pause."""


@dataclasses.dataclass(frozen=True)
class StepRequested:
    """An operator requests one cycle of a paused base station."""


@dataclasses.dataclass(frozen=True)
class LocateRequested:
    """A client requests the position of a user, who is to be served once before all others."""

    user: int


@dataclasses.dataclass(frozen=True, eq=False)
class EstimatorBuilt:
    """The result of `BuildEstimator`: an estimator, built in `elapsed_s` [s], or a `failure`."""

    codebook: Codebook
    estimator: Estimator | None
    elapsed_s: float = 0.0
    failure: str = ''


@dataclasses.dataclass(frozen=True)
class PatternsApplied:
    """The surface has shown and confirmed all configurations of the `ApplyPatterns` with `key`.

    `feeds` are the signals that were measured for unit symbols, complex128 [F, N_SB, K].
    """

    key: tuple[int, int]
    feeds: np.ndarray | None = dataclasses.field(default=None, compare=False)


@dataclasses.dataclass(frozen=True)
class FrontEndFailed:
    """A configuration of the `ApplyPatterns` with `key` was not confirmed, or not measured."""

    key: tuple[int, int]
    kind: str  # identifies faults of the same kind, such as ``surface_silence``
    text: str
    trace: str = dataclasses.field(default='', compare=False)  # of an exception of the driver


@dataclasses.dataclass(frozen=True, eq=False)
class AgreementsDrawn:
    """Agreements of the surfaces of a site for right poses, as `PoseTest` takes them."""

    references: Sequence[Mapping[Pair, float]]
    places: np.ndarray


Event = (Message | Timeout | Immediately | CodebookOffered | SettingsOffered | PeersChanged
         | StoodBy | Resumed | PauseRequested | ResumeRequested | StepRequested | LocateRequested
         | EstimatorBuilt | PatternsApplied | FrontEndFailed | AgreementsDrawn)


@dataclasses.dataclass(frozen=True)
class Send:
    """Publish a message."""

    message: Message


@dataclasses.dataclass(frozen=True)
class LogMessage:
    """Log a text, as a warning if `warning` is set.

    `holds` is True if the state named by `key` begins or has another text, False if it ends, and
    None if the text is about an event. The log limits states and warnings that repeat; an event
    without a `key` is identified by its text.
    """

    text: str
    warning: bool = False
    key: str = ''
    holds: bool | None = None


@dataclasses.dataclass(frozen=True)
class Reply:
    """Answer a request from an operator."""

    success: bool
    text: str


@dataclasses.dataclass(frozen=True, eq=False)
class BuildEstimator:
    """Build an estimator in the background; reply with `EstimatorBuilt`."""

    codebook: Codebook
    settings: Any


@dataclasses.dataclass(frozen=True, eq=False)
class PrepareEstimator:
    """Compute the table of an estimator in the background, while the estimator is in use."""

    estimator: SearchEstimator


@dataclasses.dataclass(frozen=True, eq=False)
class ApplyPatterns:
    """Show configurations on the surface, one after the other, float64 [F, N_E].

    If there is a `sounding`, measure each of them. Reply with `PatternsApplied` or, after the
    first fault, `FrontEndFailed`.
    """

    key: tuple[int, int]
    configurations: np.ndarray
    sounding: Sounding | None = None


@dataclasses.dataclass(frozen=True)
class RevertSettings:
    """Reset the parameters to these settings, because the latest ones are unusable."""

    settings: Any


@dataclasses.dataclass(frozen=True, eq=False)
class PublishTrack:
    """Publish the estimated position and velocity of a user.

    `stamp_ns` is the time of the measurement, as in `Message`.
    """

    user: int
    estimate: Estimate
    stamp_ns: int = 0


Action = (Send | LogMessage | Reply | BuildEstimator | PrepareEstimator | ApplyPatterns
          | RevertSettings | PublishTrack)


class Kind(enum.Enum):
    """Kind of an outcome; the value precedes the name of the counter in the diagnostics."""

    DROPPED = 'dropped'    # a message was ignored, or repeated an earlier one
    REPEATED = 'retries'   # a step of a cycle was requested again
    LOST = 'cycles'        # a cycle ended without service
    IDLE = 'beacons'       # nobody answered a beacon, a user stopped answering, or beacons ceased


@enum.unique
class Outcome(enum.Enum):
    """An outcome that a role counts; the value is the name of the counter."""

    kind: Kind

    def __new__(cls, counter: str, kind: Kind) -> 'Outcome':
        """Create a member whose value is the name of its counter."""
        member = object.__new__(cls)
        member._value_ = counter
        member.kind = kind
        return member

    # A message that is late, repeated, rejected or discarded, or meant for another receiver.
    WRONG_CYCLE = 'wrong_cycle', Kind.DROPPED
    WRONG_USER = 'wrong_user', Kind.DROPPED
    WRONG_INSTANCE = 'wrong_instance', Kind.DROPPED
    WRONG_SCENARIO = 'wrong_scenario', Kind.DROPPED
    NUMBER_TAKEN = 'number_taken', Kind.DROPPED
    WRONG_BAND = 'wrong_band', Kind.DROPPED
    WRONG_CODEBOOK = 'wrong_codebook', Kind.DROPPED
    DUPLICATE = 'duplicate', Kind.DROPPED
    LATE_ACK = 'late_ack', Kind.DROPPED
    NOT_ALLOWED = 'not_allowed', Kind.DROPPED
    TOO_OFTEN = 'too_often', Kind.DROPPED
    STALE_BEACON = 'stale_beacon', Kind.DROPPED
    LATE_GRANT = 'late_grant', Kind.DROPPED
    STALE_COMMAND = 'stale_command', Kind.DROPPED
    STALE = 'stale', Kind.DROPPED
    OVERFLOW = 'overflow', Kind.DROPPED
    BEHIND = 'behind', Kind.DROPPED
    # A plug-in failed while it was used for a message.
    PLUGIN_FAULT = 'plugin_fault', Kind.DROPPED

    RETRY_RHS = 'retry_rhs', Kind.REPEATED
    RETRY_BAND = 'retry_band', Kind.REPEATED
    RETRY_POSITION = 'retry_position', Kind.REPEATED
    RETRY_BEAM = 'retry_beam', Kind.REPEATED
    RETRY_DATA = 'retry_data', Kind.REPEATED
    ASKED_AGAIN = 'asked_again', Kind.REPEATED

    # A cycle that ended without service, as counted by the base station.
    RHS_SILENT = 'rhs_silent', Kind.LOST
    USER_GONE = 'user_gone', Kind.LOST
    CHANNEL_SILENT = 'channel_silent', Kind.LOST
    NO_FIX = 'no_fix', Kind.LOST
    POSITIONER_SILENT = 'positioner_silent', Kind.LOST
    TRANSMISSION_SILENT = 'transmission_silent', Kind.LOST
    DATA_LOST = 'data_lost', Kind.LOST
    # A cycle in which a surface that follows another one has not received the pilots of all bands.
    INCOMPLETE = 'incomplete', Kind.LOST
    # A cycle that ended without service to a user that answered, as counted by that user.
    NOT_GRANTED = 'not_granted', Kind.LOST
    ABANDONED = 'abandoned', Kind.LOST
    BS_SILENT = 'bs_silent', Kind.LOST

    UNANSWERED = 'unanswered', Kind.IDLE
    USER_LOST = 'user_lost', Kind.IDLE
    NO_BEACON = 'no_beacon', Kind.IDLE


_KINDS = {outcome.value: outcome.kind for outcome in Outcome}


def kind_of(counter: str) -> Kind:
    """Return the kind of a counter; it is `Kind.DROPPED` for counters without an `Outcome`."""
    return _KINDS.get(counter, Kind.DROPPED)
