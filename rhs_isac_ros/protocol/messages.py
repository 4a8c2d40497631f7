"""The messages of the protocol as dataclasses; the ROS types have the same names and fields."""

import dataclasses
import datetime
import enum
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.model.arrays import all_finite, is_masked, position_problem
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.gaussian import covariance_problem
from rhs_isac_ros.support.fields import Field
from rhs_isac_ros.support.texts import listed


class MessageError(ValueError):
    """A field of a message has an invalid value."""


def array(
        dims: str, kind: type = float, low: float = -math.inf, high: float = math.inf,
        nan_allowed: bool = False, in_front: bool = False, empty: bool = False) -> Any:
    """Declare an array field; `low` and `high` are inclusive limits of magnitudes if complex.

    `dims` lists the dimensions, separated by spaces: numbers, or symbols of `Scenario.sizes` or
    `Message.own_sizes`. If `nan_allowed` is set, NaN stands for an unknown value. With `in_front`,
    the entries are positions in front of the surface, in the frame of the site. With `empty`, the
    default is an array whose first dimension is 0.
    """
    return dataclasses.field(
        default_factory=functools.partial(np.zeros, (0, *map(int, dims.split()[1:])))
        if empty else dataclasses.MISSING,
        metadata={'check': _array_problem, 'dims': tuple(dims.split()),
                  'declared': Field(kind, low=low, high=high), 'nan_allowed': nan_allowed,
                  'in_front': in_front})


def index(symbol: str) -> Any:
    """Declare an index field, from 0 to one less than the size `symbol` in `Scenario.sizes`."""
    return dataclasses.field(metadata={'check': _index_problem, 'index_of': symbol})


def number(low: float, high: float, default: Any = dataclasses.MISSING) -> Any:
    """Declare a number field with an inclusive range."""
    return dataclasses.field(
        default=default,
        metadata={'check': _number_problem, 'declared': Field(float, low=low, high=high)})


def size(symbol: str) -> Any:
    """Declare a field that must equal the size `symbol` in `Scenario.sizes`."""
    return dataclasses.field(metadata={'check': _size_problem, 'equals': symbol})


def optional_float(default: Any = dataclasses.MISSING) -> Any:
    """Declare a number field in which NaN stands for an unknown value."""
    return dataclasses.field(
        default=default, metadata={'check': _number_problem, 'nan_allowed': True})


def check(message: 'Message', scenario: Scenario) -> None:
    """Check the fields of a message against their declarations and a scenario.

    Raises MessageError if a shape or a size is wrong, an index or a number is out of range, a
    number is not finite, except where NaN is allowed, a position is behind the surface, or the
    message has a problem of its own.
    """
    sizes = scenario.sizes
    own = message.own_sizes(sizes)
    sizes = {**sizes, **own} if own else sizes
    kind: type = type(message)
    for name, problem_of, in_front in _checks(kind):
        value = getattr(message, name)
        problem = problem_of(value, sizes) or (
            position_problem(scenario.pose.to_surface(value)) if in_front else '')
        if problem:
            raise MessageError(f'{kind.__name__}.{name}: {problem}')
    if problem := message.own_problem(scenario):
        raise MessageError(f'{kind.__name__}.{problem}')


@functools.cache
def _checks(kind: type) -> tuple[tuple[str, Callable[[Any, Mapping[str, int]], str], bool], ...]:
    """Return the name, a function that describes violations, and `in_front` of each field."""
    return tuple(
        (field.name, functools.partial(meta.get('check', _number_problem), meta),
         meta.get('in_front', False))
        for field in dataclasses.fields(kind)
        if (meta := field.metadata) or field.type is float)


def _index_problem(meta: Mapping[str, Any], value: int, sizes: Mapping[str, int]) -> str:
    symbol = meta['index_of']
    end = sizes[symbol]
    return '' if 0 <= value < end else f'{value}, expected 0 to {end - 1} ({symbol} = {end})'


def _size_problem(meta: Mapping[str, Any], value: int, sizes: Mapping[str, int]) -> str:
    symbol = meta['equals']
    return '' if value == sizes[symbol] else f'{value}, expected {symbol} = {sizes[symbol]}'


def _number_problem(meta: Mapping[str, Any], value: float, sizes: Mapping[str, int]) -> str:
    if not math.isfinite(value) and 'nan_allowed' not in meta:
        return f'{value}, expected a finite number'
    declared = meta.get('declared')
    if declared and not declared.low <= value <= declared.high:
        return f'{value}, expected {declared.range}'
    return ''


def _array_problem(
        meta: Mapping[str, Any], value: np.ndarray, sizes: Mapping[str, int]) -> str:
    dims, declared = meta['dims'], meta['declared']
    expected = [sizes[d] if d in sizes else int(d) for d in dims]
    if list(value.shape) != expected:
        described = ', '.join(d if d.isdigit() else f'{d} = {e}'
                              for d, e in zip(dims, expected, strict=True))
        return f'shape {list(value.shape)}, expected [{described}]'
    if is_masked(value) or (
            value.dtype.kind == 'c' and declared.kind is not complex):
        return f'{type(value).__name__} of {value.dtype}, expected real numbers without a mask'
    has_range = value.size and (declared.low > -math.inf or declared.high < math.inf)
    if has_range and declared.kind is complex:
        value = np.abs(value)
    # A comparison with NaN is false, so an array that passes this check contains no NaN.
    if has_range and declared.low <= value.min() and value.max() <= declared.high:
        return ''
    if not all_finite(value) and not (
            meta['nan_allowed'] and (np.isfinite(value) | np.isnan(value)).all()):
        return 'not finite, expected finite numbers'
    return (f'{value.min():g} to {value.max():g}, expected {declared.range}' if has_range else '')


# Highest number of a user in a message.
LAST_USER = 2**32 - 1
# Highest magnitude of the coordinates in a message [m].
MAX_COORDINATE_M = 1e6
_MAX_BITS = 1e15
# Maximum relative excess of the power of a beam, and magnitude that counts as excess [sqrt(W)].
_POWER_TOLERANCE = 1e-6
_MAX_MAGNITUDE = 1e9


class Mode(enum.IntEnum):
    """Purpose of a configuration of the surface."""

    POSITIONING = 0
    TRANSMISSION = 1


class Direction(enum.IntEnum):
    """Direction of a data transmission."""

    DOWNLINK = 0
    UPLINK = 1


class Stage(enum.IntEnum):
    """Whether data enter the channel or leave it."""

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

    The adapter to ROS sets `sender` and, except for `Data` of a surface of the site, `scenario_id`
    when a role sends a message. It drops received messages of another scenario.
    """

    cycle_id: int
    #: Instance of the node that sent the message: the time at which the node started, in
    #: nanoseconds since 1970; 0 if unknown, as in messages sent by hand.
    sender: int = 0
    #: `Scenario.id` of the sending node, or of the surface that carries `Data`; empty if unknown.
    scenario_id: str = ''
    #: Stamp of the header on the clock of the emulated world [ns]. Signals, and the estimates
    #: from them, carry the time of the measurement. If 0, the adapter inserts the current time.
    stamp_ns: int = 0

    def time_s(self, now_s: float) -> float:
        """Return the stamp of the message [s], or `now_s` if the stamp is 0."""
        return 1e-9 * self.stamp_ns if self.stamp_ns else now_s

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return the sizes that depend on the message itself, by symbol as in `Scenario.sizes`."""
        return {}

    def own_problem(self, scenario: Scenario) -> str:
        """Return the name of an invalid field and what is wrong with it; '' if there is none."""
        return ''


def same_instance(one: int, other: int) -> bool:
    """Return whether two instances are equal, or at least one of them is unknown (0)."""
    return one == other or not one or not other


def same(one: Message, other: Message) -> bool:
    """Return whether two messages have the same class and equal fields, apart from the stamps."""
    return type(one) is type(other) and all(
        _equal(getattr(one, field.name), getattr(other, field.name))
        for field in dataclasses.fields(one) if field.name != 'stamp_ns')


def _equal(one: object, other: object) -> bool:
    """Compare values or arrays; NaN equals NaN."""
    can_be_nan = np.asarray(one).dtype.kind in 'fc'
    return np.array_equal(one, other, equal_nan=can_be_nan)  # type: ignore[arg-type]


# Fields that the messages of a cycle have in common.
_COMMON = ('cycle_id', 'user', 'user_instance', 'band', 'codebook_id')
MessageT = TypeVar('MessageT', bound=Message)


def derive(kind: type[MessageT], source: object, **fields: Any) -> MessageT:
    """Return a message of the class `kind` with the cycle, user, band and codebook of a source.

    Attributes that the source or `kind` lacks are left out. `fields` adds or replaces fields.
    """
    common = {name: getattr(source, name) for name in _COMMON
              if name in kind.__dataclass_fields__ and hasattr(source, name)}
    return kind(**common | fields)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Beacon(Message):
    """Invitation from the base station to a range of users to take part in a cycle."""

    attempt: int
    first_user: int = number(1, LAST_USER, default=1)
    last_user: int = number(1, LAST_USER, default=LAST_USER)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Ack(Message):
    """Request from a user to be served."""

    user: int = number(1, LAST_USER)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Grant(Message):
    """Assignment of the cycle to a user."""

    user: int = number(1, LAST_USER)
    user_instance: int = 0


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class RhsCommand(Message):
    """Command to the RHS controller to apply the configurations of a codebook for a band."""

    band: int = index('N_B')
    codebook_id: str


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class RhsConfiguration(Message):
    """Report of the configurations that the RHS controller applies in one band."""

    mode: Mode
    band: int = index('N_B')
    codebook_id: str
    analog: np.ndarray = array('FRAMES N_E', low=0, high=1)

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return the number of frames FRAMES, which is 1 for a transmission."""
        return {'FRAMES': sizes['F'] if self.mode is Mode.POSITIONING else 1}


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PilotRequest(Message):
    """Request to a user for pilots in the bands `band` to `last_band`, in ascending order."""

    user: int = number(1, LAST_USER)
    user_instance: int = 0
    band: int = index('N_B')
    last_band: int = index('N_B')
    n_frames: int = size('F')


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Pilot(Message):
    """Pilots of a user in one band: a symbol of unit magnitude for each frame."""

    user: int = number(1, LAST_USER)
    band: int = index('N_B')
    symbols: np.ndarray = array('F', complex, low=0.99, high=1.01)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class FeedSignals(Message):
    """Signals at the feeds of the surface for the pilots of a user in one band, per unit symbol.

    The sender divides the signals of each frame by the symbol of the pilots.
    """

    user: int = number(1, LAST_USER)
    user_instance: int = 0
    band: int = index('N_B')
    signals: np.ndarray = array('F N_SB K', complex)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ReceivedSignals(Message):
    """Signals of a positioning phase in all bands, combined over the feeds."""

    user: int = number(1, LAST_USER)
    user_instance: int = 0
    codebook_id: str
    signals: np.ndarray = array('N_B N_SB F', complex)

    @property
    def stacked(self) -> np.ndarray:
        """The signals in the shape that estimators take, complex128 [N_B, N_SB F]."""
        return self.signals.reshape(len(self.signals), -1)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PositionEstimate(Message):
    """Estimate of the position of a user, in the frame of the site."""

    user: int = number(1, LAST_USER)
    user_instance: int = 0
    codebook_id: str
    position: np.ndarray = array('3', low=-MAX_COORDINATE_M, high=MAX_COORDINATE_M,
                                 in_front=True)
    covariance_m2: np.ndarray = array('3 3', low=-MAX_COORDINATE_M**2, high=MAX_COORDINATE_M**2)
    crlb_m2: float = optional_float()
    estimator: str
    latency_s: float = number(0, 3600)
    outside_probability: float = number(0, 1, default=0.0)
    blocked_probability: float = number(0, 1, default=0.0)
    #: Codebook proposed for the next cycle of the user, if this begins within a time [s]; empty
    #: for that of the whole region.
    next_codebook_id: str = ''
    next_codebook_s: float = number(0, 3600, default=0.0)


# Maximum number of components of a mixture in a message.
MAX_COMPONENTS = 256


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Posterior(Message):
    """What one or all surfaces know about the position of a user, in the frame of the site."""

    user: int = number(1, LAST_USER)
    user_instance: int = 0
    codebook_id: str
    log_weights: np.ndarray = array('COMPONENTS')
    #: Positions, or positions and velocities, and their covariances.
    means: np.ndarray = array('COMPONENTS D', low=-MAX_COORDINATE_M, high=MAX_COORDINATE_M)
    covariances_m2: np.ndarray = array(
        'COMPONENTS D D', low=-MAX_COORDINATE_M**2, high=MAX_COORDINATE_M**2)
    log_evidence: float
    missing_probability: float = number(1e-9, 1 - 1e-9)
    outside_probability: float = number(0, 1, default=0.0)
    blocked_probability: float = number(0, 1, default=0.0)
    surface_position_m: np.ndarray = array('3', low=-MAX_COORDINATE_M, high=MAX_COORDINATE_M)
    surface_quaternion: np.ndarray = array('4', low=-1, high=1)
    surface_uncertainty: np.ndarray = array('6 6', low=-MAX_COORDINATE_M, high=MAX_COORDINATE_M)
    #: The likelihood around the surface, in range [m] and direction cosines; of no length if the
    #: Gaussians in the frame of the site touch it at their means.
    sheet_log_weights: np.ndarray = array('SHEETS', empty=True)
    sheet_means: np.ndarray = array(
        'SHEETS 3', empty=True, low=-MAX_COORDINATE_M, high=MAX_COORDINATE_M)
    sheet_covariances: np.ndarray = array(
        'SHEETS 3 3', empty=True, low=-MAX_COORDINATE_M**2, high=MAX_COORDINATE_M**2)
    #: Log-likelihoods relative to a user in the region and in sight; NaN if unknown.
    outside_log_ratio: float = optional_float(math.nan)
    blocked_log_ratio: float = optional_float(math.nan)
    misfit_log_ratio: float = optional_float(math.nan)
    #: Likelihood of positions outside of the region, relative to the average inside: Gaussians,
    #: the logarithm of a constant, largest range, and logarithm of the volume of the region [m^3].
    #: If the range is 0, they state nothing.
    outside_log_weights: np.ndarray = array('PLACES', empty=True)
    outside_means: np.ndarray = array(
        'PLACES 3', empty=True, low=-MAX_COORDINATE_M, high=MAX_COORDINATE_M)
    outside_covariances_m2: np.ndarray = array(
        'PLACES 3 3', empty=True, low=-MAX_COORDINATE_M**2, high=MAX_COORDINATE_M**2)
    outside_log_rest: float = 0.0
    outside_range_m: float = number(0, MAX_COORDINATE_M, default=0.0)
    region_log_volume: float = 0.0

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return the numbers of Gaussians, and the dimension D of the COMPONENTS."""
        return {'COMPONENTS': len(self.log_weights), 'SHEETS': len(self.sheet_log_weights),
                'PLACES': len(self.outside_log_weights),
                'D': 6 if self.means.shape[1:] == (6,) else 3}

    def own_problem(self, scenario: Scenario) -> str:
        """Describe a mixture without a density, a pose that is none, or means behind it."""
        for fewest, log_weights, covariances in (
                (1, 'log_weights', 'covariances_m2'),
                (0, 'sheet_log_weights', 'sheet_covariances'),
                (0, 'outside_log_weights', 'outside_covariances_m2')):
            n = len(getattr(self, log_weights))
            if not fewest <= n <= MAX_COMPONENTS:
                return f'{log_weights}: {n} components, expected {fewest} to {MAX_COMPONENTS}'
            if problem := covariance_problem(getattr(self, covariances)):
                return f'{covariances}: {problem}'
        if len(self.outside_log_weights) and not self.outside_range_m:
            return (f'outside_range_m: 0, expected the largest range of '
                    f'{len(self.outside_log_weights)} Gaussians outside of the region')
        try:
            pose = self.surface_pose
        except ValueError as error:
            return f'surface_{error}'
        for name in ('means', 'outside_means'):
            if problem := position_problem(pose.to_surface(getattr(self, name)[:, :3])):
                return f'{name}: {problem}'
        return ''

    @property
    def surface_pose(self) -> Pose:
        """Pose of the surface in the frame of the site; raises ValueError if it is none."""
        x, y, z = self.surface_position_m.tolist()
        return Pose((x, y, z), tuple(self.surface_quaternion.tolist()),
                    tuple(map(tuple, self.surface_uncertainty.tolist())))


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class NoFix(Message):
    """Report that the received signals yield no position."""

    user: int = number(1, LAST_USER)
    codebook_id: str
    reason: str


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Beam(Message):
    """Beam of the transmission phase."""

    user: int = number(1, LAST_USER)
    codebook_id: str
    band: int = index('N_B')
    analog: np.ndarray = array('N_E', low=0, high=1)
    digital: np.ndarray = array('N_SB K', complex)
    expected_bps: float = number(0, _MAX_BITS)

    def own_problem(self, scenario: Scenario) -> str:
        """Return what is wrong with the power of the beam; '' if it is within the limit."""
        limit_w, magnitudes = scenario.max_power_w, np.abs(self.digital)
        # Squares of large numbers overflow.
        power_w = float(np.sum(np.minimum(magnitudes, _MAX_MAGNITUDE)**2))
        if power_w <= (1 + _POWER_TOLERANCE) * limit_w:
            return ''
        return f'digital: power {power_w:g} W, expected at most max_power_w = {limit_w:g} W'


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Data(Message):
    """Number of bits offered or delivered in one direction of the transmission phase."""

    user: int = number(1, LAST_USER)
    direction: Direction
    stage: Stage
    duration_s: float = number(0, 3600)
    bits: float = number(0, _MAX_BITS)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Capacity(Message):
    """Capacities of the beam in a cycle, and of a beam chosen for the true position."""

    user: int = number(1, LAST_USER)
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
    """Lower quartile, median and upper quartile of each figure in the latest capacity reports."""

    n_reports: int = number(1, 2**32 - 1)
    expected_bps: np.ndarray = array('3', low=0, high=_MAX_BITS)
    actual_bps: np.ndarray = array('3', low=0, high=_MAX_BITS)
    perfect_bps: np.ndarray = array('3', low=0, high=_MAX_BITS)
    loss_bps: np.ndarray = array('3')
    loss_percent: np.ndarray = array('3')


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class GroundTruth(Message):
    """True position and velocity of a user, in the frame of the site."""

    user: int = number(1, LAST_USER)
    position: np.ndarray = array('3', low=-MAX_COORDINATE_M, high=MAX_COORDINATE_M,
                                 in_front=True)
    velocity: np.ndarray = array('3', low=-SPEED_OF_LIGHT_MPS, high=SPEED_OF_LIGHT_MPS)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class GroundTruths(Message):
    """True positions and velocities of all users of one node, in the frame of the site."""

    users: np.ndarray = array('USERS', int, low=1, high=LAST_USER)
    position: np.ndarray = array('USERS 3', low=-MAX_COORDINATE_M, high=MAX_COORDINATE_M,
                                 in_front=True)
    velocity: np.ndarray = array('USERS 3', low=-SPEED_OF_LIGHT_MPS, high=SPEED_OF_LIGHT_MPS)

    def own_sizes(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return the number of users, USERS."""
        return {'USERS': len(self.users)}

    def each(self) -> Iterator[GroundTruth]:
        """Yield a `GroundTruth` for each user."""
        for user, position, velocity in zip(
                self.users.tolist(), self.position, self.velocity, strict=True):
            yield GroundTruth(
                cycle_id=self.cycle_id, sender=self.sender, scenario_id=self.scenario_id,
                stamp_ns=self.stamp_ns, user=user, position=position, velocity=velocity)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ProtocolState(Message):
    """Report that a phase of a cycle has begun, or that the cycle has ended."""

    user: int = number(0, LAST_USER)
    phase: Phase
    outcome: str
    began_s: np.ndarray = array('4', nan_allowed=True)
    elapsed_s: float = number(0, 1e9)


#: Messages of the base station and the users that concern every surface of a site.
OF_USERS = (Grant, Pilot, GroundTruth)
#: Messages with which a surface, or in a site their fusion, answers the signals of a user.
LOCATED = (PositionEstimate, NoFix)
#: Messages that contain positions.
POSITIONS = (PositionEstimate, Posterior, GroundTruth, GroundTruths)


def started(instance: int) -> str:
    """Return the start time of an instance as text for a log message."""
    time = datetime.datetime.fromtimestamp(instance // 10**9, datetime.timezone.utc)
    return f'started {time:%Y-%m-%d %H:%M:%S} UTC'


def describe_conflict(users: Sequence[int], instance: int) -> str:
    """Return a text about two nodes with the same numbers of users; `instance` is served."""
    numbers, these = (('user', 'this number') if len(users) == 1 else ('users', 'these numbers'))
    return (f'{numbers} {listed(users)}: two nodes have {these}; the first one, '
            f'{started(instance)}, is served')


def conflict_key(instance: int) -> str:
    """Return the key of log messages about the numbers of a node, which are limited together."""
    return f'number of {instance}'


def describe_conflicts(instances: Mapping[int, int]) -> dict[str, str]:
    """Return a description for each node that is served, by its key in the diagnostics.

    `instances` contains the node by the number of the user. The key contains the lowest number.
    """
    users: dict[int, list[int]] = {}
    for user in sorted(instances):
        users.setdefault(instances[user], []).append(user)
    return {f'conflict.user_{numbers[0]}': describe_conflict(numbers, instance)
            for instance, numbers in users.items()}
