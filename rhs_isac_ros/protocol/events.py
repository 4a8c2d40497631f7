"""What a role is told, besides messages, and what it asks for."""

import dataclasses
from typing import Any

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.positioning import Estimator
from rhs_isac_ros.protocol.messages import Message
from rhs_isac_ros.protocol.settings import PositionerSettings


@dataclasses.dataclass(frozen=True)
class Tick:
    """The deadline that a role named has passed."""


@dataclasses.dataclass(frozen=True, eq=False)
class CodebookOffered:
    """A codebook is to be used from the next cycle on."""

    codebook: Codebook


@dataclasses.dataclass(frozen=True)
class SettingsOffered:
    """Other settings, of the class that the role has, are to be used from the next cycle on."""

    settings: Any


@dataclasses.dataclass(frozen=True)
class PeersChanged:
    """The set of roles that a role needs and does not see has changed."""

    missing: tuple[str, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class EstimatorReady:
    """What `BuildEstimator` asked for is there; it took `elapsed_s`."""

    codebook: Codebook
    estimator: Estimator
    elapsed_s: float


@dataclasses.dataclass(frozen=True, eq=False)
class EstimatorFailed:
    """What `BuildEstimator` asked for cannot be had."""

    codebook: Codebook
    reason: str


Event = (Message | Tick | CodebookOffered | SettingsOffered | PeersChanged | EstimatorReady
         | EstimatorFailed)


@dataclasses.dataclass(frozen=True)
class Send:
    """Publish a message."""

    message: Message


@dataclasses.dataclass(frozen=True)
class LogMessage:
    """Tell the person who watches; `warning` if something is amiss."""

    text: str
    warning: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class BuildEstimator:
    """Make an estimator for a codebook, meanwhile, and answer with one of two events."""

    codebook: Codebook
    settings: PositionerSettings


@dataclasses.dataclass(frozen=True)
class SettingsReverted:
    """What was offered last cannot be used: parameters are to tell these settings again."""

    settings: Any


Action = Send | LogMessage | BuildEstimator | SettingsReverted
