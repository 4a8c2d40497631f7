"""Settings of the roles, most of which may change while the network runs.

`setting` declares each field once: the ROS parameter of the same name takes its default, range and
description from this declaration.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np

from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.positioning import ESTIMATORS, EstimatorKind
from rhs_isac_ros.protocol.admission import parse_users
from rhs_isac_ros.protocol.user_registry import MAX_USERS, POLICIES
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import Field

# Priors for the position.
REGION, TRACK = PRIORS = ('region', 'track')


def setting(
        default: bool | int | float | str, text: str, *, dynamic: bool = True, **declared: Any
) -> Any:
    """Declare a setting with a ROS parameter, which may change at run time if it is `dynamic`.

    `text` describes the setting; `declared` contains further attributes of `Field`.
    """
    return dataclasses.field(default=default, metadata={
        'declared': Field(type(default), text, **declared), 'dynamic': dynamic})


@dataclasses.dataclass(frozen=True)
class ReceiverSettings:
    """Settings of a receiver."""

    receiver_noise: bool = setting(
        True, 'Whether to add thermal noise; false if the radio adds its own.')


@dataclasses.dataclass(frozen=True)
class BaseStationSettings(ReceiverSettings):
    """Settings of the base station; raises ValueError if ``allowed_users`` is invalid."""

    policy: str = setting(
        'round_robin', 'Policy that selects among the users that answer.', choices=POLICIES)
    ack_timeout_s: float = setting(
        0.1, 'Time to wait for acks.', unit='s', low=0.001, high=60.0)
    # Not dynamic, because a change would not reach the users, which have the same timeout.
    step_timeout_s: float = setting(
        1.0, 'Time to wait for the next message of a cycle, including repetitions. Signals have '
        'the time of all frames in addition.', unit='s', low=0.01, high=60.0,
        dynamic=False)
    retries: int = setting(
        3, 'Maximum number of times that a step is repeated within step_timeout_s.',
        low=0, high=100)
    rest_s: float = setting(0.1, 'Pause between cycles.', unit='s', low=0.0, high=3600.0)
    data_duration_s: float = setting(
        1e-3, 'Duration of the data transmission in each direction.', unit='s',
        low=1e-6, high=10.0)
    handover_ratio: float = setting(
        1.02, 'In a site, ratio of the expected capacities of two surfaces from which the data of '
        'a user move to the better one.', low=1.0, high=1e3)
    allowed_users: str = setting(
        '', 'Users whose acks are accepted, such as 1, 4, 10-20; empty: all.')
    max_users: int = setting(
        MAX_USERS, 'Highest user number from which acks are accepted.', low=1, high=MAX_USERS)
    ack_rate_hz: float = setting(
        200.0, 'Maximum rate of acks accepted from each user.', unit='Hz', low=1.0, high=1e6)

    def __post_init__(self) -> None:
        """Check ``allowed_users``."""
        with translated(ValueError, ValueError, 'allowed_users'):
            parse_users(self.allowed_users)


def _calibration_file() -> Any:
    return setting('', 'Calibration file; empty: the surface of the scenario.')


def _track_speed_mps() -> Any:
    return setting(
        1.0, 'Typical speed of the users, for new tracks.', unit='m/s', low=0.01, high=1e3)


def _declaring(does: Callable[[EstimatorKind], bool]) -> str:
    """Return the names of the built-in estimators that declare something."""
    return ' and '.join(name for name in ESTIMATORS if does(EstimatorKind(name)))


@dataclasses.dataclass(frozen=True)
class PositionerSettings:
    """Settings of the positioner; raises ValueError if the estimator cannot use the prior."""

    estimator: str = setting(
        'bayes', 'Position estimator.', choices=tuple(ESTIMATORS), plugins=plugins.ESTIMATORS)
    model_file: str = setting(
        '', 'Trained model; required by the estimator '
        f'{_declaring(lambda kind: "model_file" in kind.readers)}.')
    reject_outside: bool = setting(
        True, 'Whether users who are more probably outside of the region than inside get no fix; '
        'the scenario declares the prior probability, and 0 excludes such users. Only '
        f'{_declaring(lambda kind: "reject_outside" in kind.options)} use it.')
    estimator_options: str = setting(
        '', 'Further options of the estimator, such as log2_points=12.')
    calibration_file: str = _calibration_file()
    prior: str = setting(
        'region', 'Prior of the position: uniform in the region of interest, or the track of the '
        'user from earlier cycles, with the estimator bayes.', choices=PRIORS)
    track_speed_mps: float = _track_speed_mps()

    def __post_init__(self) -> None:
        """Check that the estimator can use the prior."""
        if self.prior == TRACK and not EstimatorKind(self.estimator).uses_tracks:
            raise ValueError(
                f"prior: '{TRACK}', expected '{REGION}' with the estimator {self.estimator}; "
                f'tracks need {_declaring(lambda kind: kind.uses_tracks)}')


@dataclasses.dataclass(frozen=True)
class FusionSettings:
    """Settings of the fusion of a site."""

    wait_s: float = setting(
        0.2, 'Time to wait for the other surfaces after the first one has answered; less than '
        'step_timeout_s of the base station.', unit='s', low=0.0, high=60.0)
    track_speed_mps: float = _track_speed_mps()


@dataclasses.dataclass(frozen=True)
class TransmissionSettings:
    """Settings of the role ``transmission``."""

    band: int = setting(
        -1, 'Band of the transmission, from 0; -1: the best band of each cycle.',
        low=-1, high=4095)
    calibration_file: str = _calibration_file()


def shown(value: Any) -> str:
    """Return a parameter value as text; booleans are in lower case, as in ROS."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _of_scenario(name: str) -> Any:
    """Declare a setting that overrides the scenario field `name` unless it is negative."""
    declared = Scenario.__dataclass_fields__[name].metadata['declared']
    first_sentence = declared.text.partition('. ')[0].rstrip('.')
    return setting(
        -1.0, f'{first_sentence}; negative: the value of the scenario.', unit=declared.unit,
        low=-1.0, high=declared.high)


@dataclasses.dataclass(frozen=True)
class Impairments:
    """Impairments of the air interface, and deviations of the signals from their model.

    Settings that override fields of the scenario affect only the channel.
    """

    loss_probability: float = setting(
        0.0, 'Probability that a message is lost.', low=0.0, high=1.0)
    double_probability: float = setting(
        0.0, 'Probability that a message that is not lost is duplicated.', low=0.0, high=1.0)
    delay_s: float = setting(
        0.0, 'Minimum delay of each message.', unit='s', low=0.0, high=10.0)
    jitter_s: float = setting(
        0.0, 'Maximum additional random delay; messages may be reordered.', unit='s',
        low=0.0, high=10.0)
    multipath_memory: bool = setting(
        True, 'Whether the multipath of a user is correlated over its cycles by Eq. (4). If not, '
        'each cycle has an independent multipath, which does not depend on times.')
    user_gain_std_db: float = _of_scenario('user_gain_std_db')
    phase_std_rad: float = _of_scenario('phase_std_rad')
    band_phase_std_rad: float = _of_scenario('band_phase_std_rad')
    timing_std_s: float = _of_scenario('timing_std_s')
    carrier_offset_std_hz: float = _of_scenario('carrier_offset_std_hz')
    element_error_rms: float = _of_scenario('element_error_rms')
    blocked_probability: float = _of_scenario('blocked_probability')
    failed_element_share: float = _of_scenario('failed_element_share')
    surface_shift_m: float = setting(
        0.0, 'Distance of the surface from its pose in the scenario, to its left.', unit='m',
        low=-10.0, high=10.0)
    surface_turn_deg: float = setting(
        0.0, 'Rotation of the surface against its pose in the scenario, about its vertical axis.',
        unit='deg', low=-90.0, high=90.0)

    def applied_to(self, scenario: Scenario) -> Scenario:
        """Return the scenario, with fields overridden by the settings that are not negative."""
        known = {field.name for field in dataclasses.fields(Scenario)}
        values = dataclasses.asdict(self)
        return dataclasses.replace(scenario, **{
            name: value for name, value in values.items() if name in known and value >= 0})

    def pose_of(self, scenario: Scenario) -> Pose:
        """Return the actual pose of the surface."""
        shift_m = scenario.pose.vectors_to_site(np.array([0.0, self.surface_shift_m, 0.0]))
        turn = scenario.pose.vectors_to_site(
            np.array([0.0, 0.0, math.radians(self.surface_turn_deg)]))
        return scenario.pose.displaced(np.concatenate([shift_m, turn]))


SettingsT = TypeVar('SettingsT', bound=Any)


class PendingSettings(Generic[SettingsT]):
    """Keeps the `latest` settings until they may replace the settings `in_use`."""

    def __init__(self, settings: SettingsT) -> None:
        self.in_use = settings
        self.latest = settings

    def apply(self) -> str:
        """Put the latest settings into use; return a description of the changes, '' if none."""
        described = ', '.join(f'{name} {text!r}' for name, text in self._pending().items())
        self.in_use = self.latest
        return f'settings applied: {described}' if described else ''

    def describe(self) -> dict[str, str]:
        """Return the values in use as ``parameter.<name>``, pending ones as ``pending.<name>``."""
        in_use = {f'parameter.{name}': shown(value) for name, value in vars(self.in_use).items()}
        return in_use | {f'pending.{name}': text for name, text in self._pending().items()}

    def _pending(self) -> dict[str, str]:
        """Return the latest values that are not in use yet, by name."""
        in_use = vars(self.in_use)
        return {name: shown(value) for name, value in vars(self.latest).items()
                if value != in_use[name]}
