"""The declarations of all ROS parameters, and nodes whose parameters may change.

Descriptors, checks and documentation derive from the declarations. `protocol.settings` declares
the parameters that are settings of a role.
"""

import contextlib
import copy
import dataclasses
import difflib
import functools
import types
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from rhs_isac_ros.calibration import CalibrationError, load_surface
from rhs_isac_ros.model import Scenario, mobility
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.protocol.settings import BaseStationSettings
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import create_or_refuse, refusals
from rhs_isac_ros.ros.roster import ROSTER
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import Field, ParameterError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter(Field):
    """Declaration of a parameter; a `dynamic` one may change while the node runs."""

    name: str
    default: bool | int | float | str | list[float]
    dynamic: bool = False

    # ROS does not accept 1 in place of 1.0.
    WORDS = {**Field.WORDS, float: 'a number with a decimal point',
             list: 'a list of numbers, each with a decimal point'}

    @property
    def type(self) -> str:
        """ROS type of the parameter."""
        return {bool: 'bool', int: 'integer', float: 'double', str: 'string',
                list: 'double_array'}[self.kind]

    @property
    def default_text(self) -> str:
        """Default as YAML; ``empty`` for an empty text or list."""
        if self.default in ('', []):
            return 'empty'
        text = str(self.default)
        return text.lower() if self.kind is bool else text

    def check(self, value: Any) -> None:
        """Raise ParameterError for an invalid value."""
        # ROS checks neither lists nor the exact ends of a range.
        if problem := self.problem(value):
            raise ParameterError(f'{self.name}: {problem}')


def _parameter(
        name: str, default: bool | int | float | str | list[float], text: str,
        **declared: Any) -> Parameter:
    return Parameter(kind=type(default), text=text, name=name, default=default, **declared)


def _declared_by(settings: type[Any] | None) -> dict[str, Parameter]:
    """Return the parameters that the fields of a settings class declare, by name."""
    return {} if settings is None else {
        field.name: Parameter(
            **vars(field.metadata['declared']), name=field.name,
            default=getattr(settings, field.name), dynamic=field.metadata['dynamic'])
        for field in dataclasses.fields(settings)}


_SCENARIO = _parameter(
    'scenario_file', '', "YAML file of the scenario; empty: Table I of the paper.")
_SEED = _parameter('seed', 0, 'Seed of all random numbers.', low=0, high=2**31 - 1)
_USER_TOPICS = _parameter(
    'user_topics', 64, 'Highest user number for which separate topics are created.',
    low=0, high=MAX_USERS)

# Mobilities of robots. The library has further mobilities.
ODOMETRY, TF = ROBOTS = ('odometry', 'tf')
_FRAME = (
    _parameter(
        'frame_id', topics.MAP_FRAME, 'Frame of poses, odometry, paths and transforms; messages '
        'of the protocol are in the frame of the surface.'),
    _parameter(
        'surface_pose', [0.0] * 6, 'Pose of the surface in frame_id: x, y, z in metres, roll, '
        'pitch, yaw in radians.', low=-1e6, high=1e6),
)

# Parameters of the roles other than their settings.
_OTHERS: Mapping[str, tuple[Parameter, ...]] = {
    'bs': (
        _SEED,
        *_FRAME,
        _parameter(
            'first_cycle', 0, 'Id of the first cycle; 0: derived from the clock, so that no id '
            'is reused after a restart.', low=0, high=2**53),
    ),
    'user': (
        _SEED,
        _parameter('user_id', 1, 'Id of the user, or the first of several.',
                   low=1, high=MAX_USERS),
        _parameter('user_count', 1, 'Number of users of the node, with consecutive ids.',
                   low=1, high=MAX_USERS),
        _parameter('mobility', 'static', 'Mobility model, or source of the position of a robot.',
                   choices=(*mobility.KINDS, *ROBOTS), plugins=plugins.MOBILITIES),
        _parameter('odometry_topic', 'odom',
                   'Odometry of the robot in frame_id, for the mobility odometry.'),
        _parameter('robot_frame', 'base_link', 'Frame of the robot, for the mobility tf.'),
        _parameter(
            'robot_timeout_s', 1.0, 'Time without a position of the robot after which the user '
            'stops answering beacons.', unit='s', low=0.05, high=3600.0),
        *_FRAME,
        _USER_TOPICS,
        _parameter(
            'position_m', [], 'Initial position x, y, z of each user; empty: random points of '
            'the region of interest.', unit='m', low=-1e6, high=1e6),
        _parameter('waypoints_m', [], 'Coordinates x, y, z of each waypoint, in order.',
                   unit='m', low=-1e6, high=1e6),
        _parameter('speed_mps', 1.0, 'Speed, at most max_user_speed_mps of the scenario.',
                   unit='m/s', low=0.0, high=1e4),
        _parameter('ground_truth_period_s', 0.5, 'Period at which the true position is published.',
                   unit='s', low=0.01, high=60.0),
        _declared_by(BaseStationSettings)['step_timeout_s'],
        _parameter('beacon_timeout_s', 1.5,
                   'Time without a beacon after which a warning is logged.',
                   unit='s', low=0.1, high=7200.0),
    ),
    'channel': (_SEED,),
    'positioner': (
        _parameter('table_folder', '', 'Directory in which tables are cached; empty: the cache '
                   'directory of the user.'),
        *_FRAME,
        _USER_TOPICS,
    ),
    topics.OPTIMIZER_NODE: (
        _parameter('codebook_file', '', 'Codebook file; empty: the default codebook.'),
    ),
}

NODES: Mapping[str, tuple[Parameter, ...]] = {
    **{name: (_SCENARIO, *_declared_by(member.settings).values(), *_OTHERS.get(name, ()))
       for name, member in sorted(ROSTER.items())},
    'visualizer': (
        _SCENARIO,
        *_FRAME,
        _USER_TOPICS,
        _parameter('period_s', 0.2, 'Period at which the scene is published.',
                   unit='s', low=0.01, high=60.0),
        _parameter('forget_s', 10.0, 'Time without a message after which a user is removed.',
                   unit='s', low=0.1, high=3600.0),
    ),
    'network': (_parameter('users', 2, 'Number of users.', low=1, high=MAX_USERS),),
}

CODEBOOK_PREFIX = 'codebook.'
# The parameters of the optimizer that hold the codebook, with their descriptions.
CODEBOOK: Mapping[str, str] = {
    'codebook.id': 'Hash of the codebook; must match its content.',
    'codebook.shape': 'Sizes N_B, N_SB, F, K, N_E.',
    'codebook.average_crlb': 'Average Cramer-Rao bound [m^2].',
    'codebook.provenance': 'Provenance of the codebook.',
    'codebook.analog': 'Configurations [N_B, F, N_E], from 0 to 1.',
    'codebook.digital_re': 'Combining vectors [N_B, N_SB, F, K], real parts [sqrt(W)].',
    'codebook.digital_im': 'Combining vectors [N_B, N_SB, F, K], imaginary parts [sqrt(W)].',
}


def declare(node: Node, executable: str) -> types.SimpleNamespace:
    """Declare the parameters of an executable in `NODES`, and return their values by name.

    Raises ParameterError if a value has the wrong type, is out of range, or is not allowed.
    """
    return types.SimpleNamespace(
        **{parameter.name: _declare_one(node, parameter) for parameter in NODES[executable]})


def check_overrides(node: Node) -> None:
    """Warn if a node was started with parameters that no executable has.

    Parameters of other executables are accepted, because nodes may share a parameter file.
    """
    known = known_names()
    # rclpy gives no public access to all overrides. An endpoint declares its qos_overrides.*.
    foreign = [f'{name}{hint(name)}' for name in sorted(node._parameter_overrides)
               if not (name in known or node.has_parameter(name)
                       or name.startswith('qos_overrides.'))]
    if foreign:
        node.get_logger().warning(f'unknown parameters are ignored: {", ".join(foreign)}')


def known_names() -> set[str]:
    """Return the names of the parameters of all executables."""
    known = {parameter.name for parameters in NODES.values() for parameter in parameters}
    return known.union(CODEBOOK)


def hint(name: str) -> str:
    """Return a text that suggests the closest known parameter; empty if none is close."""
    close = difflib.get_close_matches(name, known_names(), 1)
    return f' (the closest is {close[0]})' if close else ''


def _declare_one(node: Node, parameter: Parameter) -> Any:
    default, low, high = parameter.default, parameter.low, parameter.high
    is_empty = default == []
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    descriptor = ParameterDescriptor(
        description=parameter.text + unit, additional_constraints=parameter.expected,
        read_only=not (parameter.dynamic or is_empty))
    if parameter.kind is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    elif parameter.kind is float:
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    # ROS cannot infer the element type of an empty list.
    typed = RosParameter.Type.DOUBLE_ARRAY if is_empty else default
    try:
        value: Any = node.declare_parameter(parameter.name, typed, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        raise ParameterError(
            f'{parameter.name}: {error}; expected {parameter.expected}') from None
    if value is None:
        # If one parameter has no value, the node returns no values at all to a request for several
        # parameters, such as a request of `ros2 param dump`.
        value = default
        node.set_parameters([RosParameter(parameter.name, typed, default)])
    if is_empty:
        # A copy: rclpy keeps the original, and rejects a new descriptor of a read-only parameter.
        final = copy.copy(descriptor)
        final.read_only = not parameter.dynamic
        node.set_descriptor(parameter.name, final)
    value = list(value) if parameter.kind is list else value
    parameter.check(value)
    return value


def settings_of(kind: type[Any], values: types.SimpleNamespace) -> Any:
    """Return settings of the class `kind`, filled in from the parameters with the same names."""
    with translated(ValueError, ParameterError):
        return kind(**{field.name: getattr(values, field.name)
                       for field in dataclasses.fields(kind)})


def calibrated_surface(
        values: types.SimpleNamespace, scenario: Scenario) -> SurfaceEstimate | None:
    """Return the surface in the file ``calibration_file``; None if the parameter is empty."""
    with translated(CalibrationError, ParameterError, 'calibration_file'):
        return load_surface(values.calibration_file, scenario)


def scenario_of(values: types.SimpleNamespace) -> Scenario:
    """Return the scenario in the file ``scenario_file``; Table I if the parameter is empty."""
    file = values.scenario_file
    return Scenario.from_yaml(file) if file else Scenario()


_FLOATING = (RosParameter.Type.DOUBLE, RosParameter.Type.DOUBLE_ARRAY)


def same_value(one: RosParameter, other: RosParameter) -> bool:
    """Return whether two parameters have the same type and value; NaN equals NaN."""
    return one.type_ == other.type_ and bool(np.array_equal(
        one.value, other.value, equal_nan=one.type_ in _FLOATING))


class ParameterizedNode(Node):
    """A node that checks each change to its parameters as a whole and converts it to settings.

    The node declares the parameters of `executable`, which is also the default name of the node.
    `values` contains the initial values by name. Raises ParameterError if one is invalid.
    """

    def __init__(self, executable: str, name: str = '', **node_options: Any) -> None:
        super().__init__(name or executable, **node_options)
        # Callbacks that run before the node is destroyed.
        self.endings = contextlib.ExitStack()
        self._executable = executable
        self.values = declare(self, executable)
        self._dynamic = {parameter.name: parameter for parameter in NODES[executable]
                         if parameter.dynamic}
        self._current_values = self.values
        # Settings from the last check. ROS may still reject the change that was checked.
        self._checked_settings: Any = None
        self._is_reverting = False
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._on_set)

    def destroy_node(self) -> None:
        """Run the callbacks in `endings`, then destroy the node."""
        self.endings.close()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def make_settings(self, values: types.SimpleNamespace) -> Any:
        """Return the role's settings, None if it has none; raise ParameterError if invalid."""
        settings = ROSTER[self._executable].settings
        return settings and settings_of(settings, values)

    def on_settings_changed(self, settings: Any) -> None:
        """Handle new settings after a change to parameters; by default, do nothing."""

    def revert_parameters(self, settings: Any) -> None:
        """Reset dynamic parameters to earlier settings, without calling `on_settings_changed`."""
        self._is_reverting = True
        try:
            self.set_parameters_atomically([
                RosParameter(name, value=value)
                for name, value in dataclasses.asdict(settings).items() if name in self._dynamic])
        finally:
            self._is_reverting = False

    def set_parameters_atomically(
            self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set all parameters or none; the parameter services call this method, too.

        Unlike in rclpy, the reason for a rejection contains the value and the valid range, and
        read-only parameters are accepted if they keep their values, as in a dump of the node.
        """
        parameter_list = [p for p in parameter_list if not self._is_kept(p)]
        if not parameter_list:
            return SetParametersResult(successful=True)
        try:
            self._check_each(parameter_list)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        # A change to use_sim_time makes rclpy subscribe to the simulated time.
        what = f'subscription to {topics.CLOCK}'
        result = create_or_refuse(self, what, functools.partial(
            super().set_parameters_atomically, parameter_list))
        if result:
            return result
        self._time_source.ros_time_is_active = False
        return SetParametersResult(successful=False, reason=refusals(self)[what])

    def _is_kept(self, parameter: RosParameter) -> bool:
        name = parameter.name
        return (self.has_parameter(name) and self.describe_parameter(name).read_only
                and same_value(self.get_parameter(name), parameter))

    def _dynamic_values(self, changes: Iterable[RosParameter]) -> dict[str, Any]:
        return {p.name: p.value for p in changes if p.name in self._dynamic}

    def _check_each(self, changes: Iterable[RosParameter]) -> None:
        for name, value in self._dynamic_values(changes).items():
            self._dynamic[name].check(value)

    def _with(self, changes: Iterable[RosParameter]) -> types.SimpleNamespace:
        return types.SimpleNamespace(
            **{**vars(self._current_values), **self._dynamic_values(changes)})

    def _check(self, changes: list[RosParameter]) -> SetParametersResult:
        if self._dynamic_values(changes) and not self._is_reverting:
            try:
                self._check_each(changes)
                self._checked_settings = self.make_settings(self._with(changes))
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_set(self, changes: list[RosParameter]) -> None:
        if not self._dynamic_values(changes):
            return
        self._current_values = self._with(changes)
        if not self._is_reverting:
            self.on_settings_changed(self._checked_settings)
