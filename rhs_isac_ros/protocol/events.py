"""Events of the roles other than messages, and the actions that the roles return."""

import dataclasses
from typing import TYPE_CHECKING, Any

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.positioning import Estimator, TrackEstimate
from rhs_isac_ros.protocol.messages import Message

if TYPE_CHECKING:
    # The settings import the roles of the users, which use the events.
    from rhs_isac_ros.protocol.settings import PositionerSettings


@dataclasses.dataclass(frozen=True)
class Timeout:
    """The deadline of the role has passed."""


@dataclasses.dataclass(frozen=True, eq=False)
class CodebookOffered:
    """A codebook is available for the next cycle."""

    codebook: Codebook


@dataclasses.dataclass(frozen=True)
class SettingsOffered:
    """New settings, of the same class as those in use, are available to the role."""

    settings: Any


@dataclasses.dataclass(frozen=True)
class PeersChanged:
    """The set of required roles that are missing has changed."""

    missing: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class StoodBy:
    """The node stands by, because a newer one has the same role."""


@dataclasses.dataclass(frozen=True)
class Resumed:
    """The node serves again; ids of cycles used meanwhile are below `first_cycle_id`."""

    first_cycle_id: int = 0


@dataclasses.dataclass(frozen=True)
class PauseRequested:
    """An operator requests that no cycle begins after the current one."""


@dataclasses.dataclass(frozen=True)
class ResumeRequested:
    """An operator requests that cycles follow each other again."""


@dataclasses.dataclass(frozen=True)
class StepRequested:
    """An operator requests one cycle of a paused base station."""


@dataclasses.dataclass(frozen=True, eq=False)
class EstimatorReady:
    """The estimator requested by `BuildEstimator` was built in `elapsed_s` seconds."""

    codebook: Codebook
    estimator: Estimator
    elapsed_s: float


@dataclasses.dataclass(frozen=True, eq=False)
class EstimatorFailed:
    """The estimator requested by `BuildEstimator` could not be built."""

    codebook: Codebook
    reason: str


Event = (Message | Timeout | CodebookOffered | SettingsOffered | PeersChanged | StoodBy | Resumed
         | PauseRequested | ResumeRequested | StepRequested | EstimatorReady | EstimatorFailed)


@dataclasses.dataclass(frozen=True)
class Send:
    """Publish a message."""

    message: Message


@dataclasses.dataclass(frozen=True)
class LogMessage:
    """Log a text, as a warning if `warning` is set."""

    text: str
    warning: bool = False


@dataclasses.dataclass(frozen=True)
class Reply:
    """Answer the request of an operator."""

    success: bool
    text: str


@dataclasses.dataclass(frozen=True, eq=False)
class BuildEstimator:
    """Build an estimator in the background; reply with `EstimatorReady` or `EstimatorFailed`."""

    codebook: Codebook
    settings: 'PositionerSettings'


@dataclasses.dataclass(frozen=True)
class RevertSettings:
    """Reset the parameters to these settings, because the settings offered last are unusable."""

    settings: Any


@dataclasses.dataclass(frozen=True, eq=False)
class PublishTrack:
    """Publish the estimated position and velocity of a user that is tracked."""

    user: int
    estimate: TrackEstimate


Action = Send | LogMessage | Reply | BuildEstimator | RevertSettings | PublishTrack
