"""What of a role may change while the network runs, by the names of its parameters."""

import dataclasses
from typing import Any

from rhs_isac_ros.protocol.ack_filter import parse_users


@dataclasses.dataclass(frozen=True)
class BaseStationSettings:
    """How a base station works.

    Attributes
    ----------
    policy
        How to select among the users that answer, one of `POLICIES`.
    receiver_noise
        Whether the receiver adds thermal noise.
    ack_timeout_s
        How long to wait for acks [s].
    step_timeout_s
        How long to wait for the next message of a cycle [s].
    retries
        How often a step of a cycle is asked for again, before the cycle is given up.
    rest_s
        Pause between cycles [s].
    data_duration_s
        How long each direction transmits data [s].
    allowed_users
        Users whose acks it takes, as `parse_users` reads them.
    ack_rate_hz
        Acks that it takes of each user in a second.

    Raises
    ------
    ValueError
        If ``allowed_users`` is no list of users.
    """

    policy: str = 'round_robin'
    receiver_noise: bool = True
    ack_timeout_s: float = 0.1
    step_timeout_s: float = 1.0
    retries: int = 3
    rest_s: float = 0.1
    data_duration_s: float = 1e-3
    allowed_users: str = ''
    ack_rate_hz: float = 200.0

    def __post_init__(self) -> None:
        """Check what a type and a range do not tell."""
        try:
            parse_users(self.allowed_users)
        except ValueError as error:
            raise ValueError(f'allowed_users: {error}') from None


@dataclasses.dataclass(frozen=True)
class PositionerSettings:
    """How a positioner estimates.

    Attributes
    ----------
    estimator
        Name of the estimator.
    model_file
        Its trained model, if it needs one.
    """

    estimator: str = 'bayes'
    model_file: str = ''


@dataclasses.dataclass(frozen=True)
class TransmissionSettings:
    """How a transmission chooses its band.

    Attributes
    ----------
    band
        Band of the transmission, from 0; -1: in each cycle the one of the best expected capacity.
    """

    band: int = -1


def changes(old: Any, new: Any) -> dict[str, Any]:
    """Compare settings of a role.

    Parameters
    ----------
    old, new
        Settings of one class.

    Returns
    -------
    dict
        The new values, by name, of what is another.
    """
    names = [field.name for field in dataclasses.fields(old)]
    return {name: getattr(new, name) for name in names
            if getattr(new, name) != getattr(old, name)}


def describe_settings(in_use: Any, newest: Any) -> dict[str, str]:
    """Put settings in words, for the diagnostics.

    Parameters
    ----------
    in_use
        The settings that the role works with.
    newest
        Those that it was given last.

    Returns
    -------
    dict
        ``parameter.<name>``, what is in use, and ``pending.<name>``, what waits.
    """
    told = {f'parameter.{name}': shown(value)
            for name, value in dataclasses.asdict(in_use).items()}
    return told | {f'pending.{name}': shown(value)
                   for name, value in changes(in_use, newest).items()}


def shown(value: Any) -> str:
    """Write a value as ROS does.

    Parameters
    ----------
    value
        The value of a parameter.

    Returns
    -------
    str
        The text.
    """
    return str(value).lower() if isinstance(value, bool) else str(value)
