"""The declarations of all ROS parameters, and nodes whose parameters may change.

Descriptors, checks and documentation derive from the declarations. `protocol.settings` declares
the parameters that are settings of a role.
"""

import argparse
import contextlib
import copy
import dataclasses
import difflib
import functools
import itertools
import re
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from rhs_isac_ros.calibration import CalibrationError, load_surface
from rhs_isac_ros.frontend import RADIOS, SURFACES
from rhs_isac_ros.model import mobility
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.protocol.settings import BaseStationSettings
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import create_or_refuse, log, refusals
from rhs_isac_ros.ros.node_surface import NodeSurface
from rhs_isac_ros.ros.roster import MEMBERS
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.arguments import ArgumentParser
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import Field, ParameterError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter(Field):
    """Declaration of a parameter; a `dynamic` one may change while the node runs."""

    name: str
    default: bool | int | float | str | list[float]
    dynamic: bool = False
    is_frame: bool = False  #: Whether the value is the name of a frame.

    # ROS does not accept 1 instead of 1.0.
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
        # tf2 refuses such names when it is asked for a transform.
        if self.is_frame and (not value or value.startswith('/')):
            raise ParameterError(
                f'{self.name}: {value!r}, expected the name of a frame, without a / in front')


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
_SYSTEM = _parameter(
    'system_file', '', 'System file, which names a scenario, a codebook and a calibration, in '
    'place of scenario_file; empty: none.')
_SITE = _parameter(
    'site_file', '', 'Site file, which takes the place of scenario_file. The surface of a node is '
    'named after the last part of its namespace; empty: no site.')
_FILES = _SCENARIO, _SYSTEM, _SITE
_SEED = _parameter('seed', 0, 'Seed of all random numbers.', low=0, high=2**31 - 1)
_USER_TOPICS = _parameter(
    'user_topics', 64, 'Highest user number for which separate topics are created.',
    low=0, high=MAX_USERS)

_TABLES = _parameter(
    'table_folder', '', 'Directory in which tables are cached; empty: the cache directory of the '
    'user.')

# For all roles that take part in the choice or the use of a codebook.
_LIBRARY = _parameter(
    'library_file', '', 'Library of codebooks, the same for all nodes, from which each cycle '
    'takes the one for the predicted position; empty: only the codebook of the optimizer.')

# Mobilities of robots. The library has further mobilities.
ODOMETRY, TF = ROBOTS = ('odometry', 'tf')
_FRAME = _parameter(
    'frame_id', topics.MAP_FRAME, 'Frame of the site, in which all positions are.', is_frame=True)

# Parameters of the roles other than their settings.
_OTHERS: Mapping[str, tuple[Parameter, ...]] = {
    'rhs_controller': (_LIBRARY,),
    'transmission': (_LIBRARY,),
    'bs': (
        _SEED,
        _FRAME,
        _LIBRARY,
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
        _parameter('robot_frame', 'base_link', 'Frame of the robot, for the mobility tf.',
                   is_frame=True),
        _parameter(
            'robot_timeout_s', 1.0, 'Time without a position of the robot after which the user '
            'stops answering beacons.', unit='s', low=0.05, high=3600.0),
        _FRAME,
        _USER_TOPICS,
        _parameter(
            'position_m', [], 'Initial position x, y, z of each user in frame_id; empty: random '
            'points of the region of interest.', unit='m', low=-1e6, high=1e6),
        _parameter('waypoints_m', [],
                   'Coordinates x, y, z of each waypoint in frame_id, in order.',
                   unit='m', low=-1e6, high=1e6),
        _parameter('speed_mps', 1.0, 'Speed, at most max_user_speed_mps of the scenario.',
                   unit='m/s', low=0.0, high=1e4),
        _parameter('ground_truth_period_s', 0.5, 'Period at which the true position is published; '
                   'at least 5 s for users at rest.',
                   unit='s', low=0.01, high=60.0),
        _declared_by(BaseStationSettings)['step_timeout_s'],
        _parameter('beacon_timeout_s', 1.5,
                   'Time without a beacon after which a warning is logged.',
                   unit='s', low=0.1, high=7200.0),
    ),
    'channel': (
        _SEED,
        _parameter('surface', 'emulated', 'Surface that shows the configurations.',
                   choices=tuple(SURFACES), plugins=plugins.SURFACES),
        _parameter('surface_options', '', 'Options of the surface, as in port=/dev/ttyUSB0 '
                   'timeout_s=0.2; empty: none.'),
        _parameter('radio', 'emulated', 'Radio that measures the pilots. Those with noise of '
                   'their own need receiver_noise: false of bs.',
                   choices=tuple(RADIOS), plugins=plugins.RADIOS),
        _parameter('radio_options', '', 'Options of the radio, as in noise_psd_dbm_hz=-150.0 '
                   'of waveform, or path=samples of sigmf; '
                   'empty: none.'),
        _parameter('samples_folder', '', 'Folder in which the samples of the radio are recorded '
                   'as SigMF collections; empty: no recording.'),
        _parameter('states_file', '', 'Calibration file with the coefficients of the '
                   'emulated elements; empty: those of the scenario.'),
    ),
    'receiver': (_SEED,),
    'fusion': (_SEED, _TABLES, _FRAME, _USER_TOPICS),
    'positioner': (
        _LIBRARY,
        _TABLES,
        _FRAME,
        _USER_TOPICS,
    ),
    topics.OPTIMIZER_NODE: (
        _parameter('codebook_file', '', 'Codebook file; empty: the default codebook.'),
    ),
}

NODES: Mapping[str, tuple[Parameter, ...]] = {
    **{name: (*_FILES, *_declared_by(member.settings).values(), *_OTHERS.get(name, ()))
       for name, member in sorted(MEMBERS.items())},
    'visualizer': (
        *_FILES,
        _FRAME,
        _USER_TOPICS,
        _parameter('period_s', 0.2, 'Period at which the scene is published.',
                   unit='s', low=0.01, high=60.0),
        _parameter('forget_s', 10.0, 'Time without a message after which a user is removed.',
                   unit='s', low=0.1, high=3600.0),
    ),
    'network': (_parameter('users', 2, 'Number of users.', low=1, high=MAX_USERS), _SITE),
}

# Options for nodes that need no services; access control then need not permit any.
WITHOUT_SERVICES: Mapping[str, Any] = {
    'start_parameter_services': False,
    'parameter_overrides': [RosParameter('start_type_description_service', value=False)]}
# Parameters that rclpy declares for each node.
_OF_RCLPY = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
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


# Valid values of qos_overrides.<topic>.<publisher or subscription>.<policy>, by policy. A file may
# contain overrides for other nodes, so policies that no node of this package uses are included.
_DURATION_NS = Field(int, unit='ns', low=0, high=2**63 - 1)
_QOS: Mapping[str, Field] = {
    'history': Field(str, choices=('keep_last', 'keep_all', 'system_default')),
    'depth': Field(int, low=0, high=2**31 - 1),
    'reliability': Field(
        str, choices=('reliable', 'best_effort', 'system_default', 'best_available')),
    'durability': Field(
        str, choices=('volatile', 'transient_local', 'system_default', 'best_available')),
    'deadline': _DURATION_NS, 'lifespan': _DURATION_NS, 'liveliness_lease_duration': _DURATION_NS,
    'liveliness': Field(
        str, choices=('automatic', 'manual_by_topic', 'system_default', 'best_available')),
    'avoid_ros_namespace_conventions': Field(bool)}
_QOS_NAME = re.compile(r'qos_overrides\.(?:/\w+)+\.(?:publisher|subscription)(?:_\w+)?\.(\w+)')


def check_qos_overrides(node: Node) -> None:
    """Raise ParameterError if a parameter ``qos_overrides.*`` has an invalid name or value.

    rclpy examines an override when the endpoint is created, which may be long after the start.
    """
    for name, parameter in node._parameter_overrides.items():
        if not name.startswith('qos_overrides.'):
            continue
        match = _QOS_NAME.fullmatch(name)
        if not match or match[1] not in _QOS:
            raise ParameterError(
                f'{name}: invalid name, expected qos_overrides./TOPIC.publisher.POLICY or '
                f'qos_overrides./TOPIC.subscription.POLICY, with POLICY {", ".join(_QOS)}')
        value = parameter.value
        # rclpy accepts upper case, too.
        if problem := _QOS[match[1]].problem(value.lower() if isinstance(value, str) else value):
            raise ParameterError(f'{name}: {problem}')


def declare(node: Node, executable: str) -> types.SimpleNamespace:
    """Declare the parameters of an executable in `NODES`, and return their values by name.

    Raises ParameterError if a value has the wrong type, is out of range, or is not allowed.
    """
    check_qos_overrides(node)
    return types.SimpleNamespace(
        **{parameter.name: _declare_one(node, parameter) for parameter in NODES[executable]})


def check_nodes(nodes: Sequence[Node]) -> None:
    """Check the names of the nodes of a process, and the parameters with which they were started.

    Raises ParameterError if two nodes have the same name. Logs a warning if there are parameters
    that no executable has; those of other executables are accepted, because nodes may share a
    parameter file.
    """
    names = [node.get_fully_qualified_name() for node in nodes]
    for name in names:
        if (n := names.count(name)) > 1:
            raise ParameterError(f'argument -r: {n} nodes are renamed to {name}, expected one: '
                                 '-r NAME:__node:=NEW_NAME')
    known = known_names()
    for node in nodes:
        # rclpy gives no public access to all overrides. An endpoint declares its qos_overrides.*.
        foreign = [f'{name}{hint(name, known)}' for name in sorted(node._parameter_overrides)
                   if not (name in known or node.has_parameter(name)
                           or name.startswith('qos_overrides.'))]
        if foreign:
            log(node, f'unknown parameters are ignored: {", ".join(foreign)}',
                LoggingSeverity.WARN)


def known_names() -> set[str]:
    """Return the names of the parameters of all executables."""
    known = {parameter.name for parameters in NODES.values() for parameter in parameters}
    return known.union(CODEBOOK)


def hint(name: str, known: Iterable[str]) -> str:
    """Return a text that suggests the closest of the known names; empty if none is close."""
    close = difflib.get_close_matches(name, known, 1)
    return f' (the closest is {close[0]})' if close else ''


def check_arguments(
        parser: argparse.ArgumentParser, executable: str, arguments: Sequence[str]) -> None:
    """Exit with a usage error if ``-p`` sets a parameter that the executable does not have.

    A parameter file may set parameters of several executables; see `check_nodes`.
    """
    accepted = set(_names(executable)).union(*map(_names, _composed(executable)))
    known = known_names()
    for name in _assigned(arguments):
        if name not in known and not name.startswith(_OF_RCLPY):
            parser.error(f'argument -p: {name}: unknown parameter{hint(name, known)}')
        owners = [owner for owner in NODES if name in _names(owner)]
        if owners and name not in accepted:
            parser.error(f'argument -p: {name} is a parameter of {", ".join(owners)}, '
                         f'expected one of {executable}')


def _names(executable: str) -> list[str]:
    """Return the names of the parameters of an executable, not of the nodes that it composes."""
    names = [parameter.name for parameter in NODES[executable]]
    return [*names, *CODEBOOK] if executable == 'optimizer' else names


def _assigned(arguments: Sequence[str]) -> Iterator[str]:
    """Yield the parameters to which a command line assigns values for all nodes."""
    in_ros_arguments = False
    for word, following in itertools.pairwise(arguments):
        if word in ('--ros-args', '--'):
            in_ros_arguments = word == '--ros-args'
        elif in_ros_arguments and word in ('-p', '--param'):
            name, _, _ = following.partition(':=')
            # A name with a colon is for a single node.
            if ':' not in name:
                yield name


def _composed(executable: str) -> list[str]:
    return [name for name in NODES if name in MEMBERS] if executable == 'network' else []


def make_parser(executable: str, text: str) -> ArgumentParser:
    """Return a parser of the command line of an executable that has only ROS arguments.

    `text` is the docstring of its module, whose first line contains a colon and a description.
    """
    description = text.partition('\n')[0].rpartition('``: ')[2]
    return ArgumentParser(
        prog=executable, usage=f'{executable} [--ros-args -p NAME:=VALUE ...]',
        description=description[:1].upper() + description[1:], epilog=parameter_help(executable),
        formatter_class=argparse.RawDescriptionHelpFormatter)


def parameter_help(executable: str) -> str:
    """Return a description of the parameters of an executable, with an example."""
    own = list(NODES[executable])
    lines = ['ROS parameters:', *(_describe(parameter) for parameter in own)]
    if executable == 'optimizer':
        lines += [f'  {name}\n      {text}' for name, text in CODEBOOK.items()]
    elif composed := _composed(executable):
        # `network` sets these itself.
        others = {parameter.name: parameter for name in composed for parameter in NODES[name]
                  if parameter.name not in ('user_id', 'user_count')}
        lines += ['', 'ROS parameters of the composed nodes:', *map(_describe, others.values())]
    example = _example(own)
    return '\n'.join([*lines, '', f'example: {executable} --ros-args -p {example}'])


def _describe(parameter: Parameter) -> str:
    details = [parameter.type, f'default {parameter.default_text}']
    if parameter.range:
        details.append(parameter.range)
    if parameter.dynamic:
        details.append('dynamic')
    return f'  {parameter.name} ({"; ".join(details)})\n      {parameter.text}'


def _example(declared: Sequence[Parameter]) -> str:
    """Return an assignment to the first parameter, preferably not the scenario file or seed."""
    chosen = next((parameter for parameter in declared
                   if parameter.name not in ('scenario_file', 'seed')), declared[0])
    value = 'my.yaml' if chosen.default == '' else chosen.default_text
    return f'{chosen.name}:={value}'


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
        Node.set_parameters(node, [RosParameter(parameter.name, typed, default)])
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
        values: Any, node: NodeSurface, name: str = 'calibration_file') -> SurfaceEstimate | None:
    """Return the surface in the calibration file of a parameter, or else that of the system."""
    if not (file := getattr(values, name)):
        surface = node.system.surface if node.system else None
        assert surface is None or isinstance(surface, SurfaceEstimate)
        return surface
    with translated(CalibrationError, ParameterError, name):
        return load_surface(file, node.scenario)


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

    def destroy_node(self) -> None:
        """Run the callbacks in `endings`, then destroy the node."""
        self.endings.close()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def make_settings(self, values: types.SimpleNamespace) -> Any:
        """Return the role's settings, None if it has none; raise ParameterError if invalid."""
        settings = MEMBERS[self._executable].settings
        return settings and settings_of(settings, values)

    def on_settings_changed(self, settings: Any) -> None:
        """Handle new settings after a change to parameters; by default, do nothing."""

    def revert_parameters(self, settings: Any) -> None:
        """Reset dynamic parameters to earlier settings, without calling `on_settings_changed`."""
        changes = [RosParameter(name, value=value)
                   for name, value in dataclasses.asdict(settings).items()
                   if name in self._dynamic]
        super().set_parameters_atomically(changes)
        self._current_values = self._with(changes)

    def set_parameters_atomically(
            self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set all parameters or none; the parameter services call this method, too.

        Unlike in rclpy, the reason for a rejection contains the value and the valid range, or the
        name of an unknown parameter, and read-only parameters are accepted if they keep their
        values, as in a dump of the node.
        """
        if unknown := [p.name for p in parameter_list if not self.has_parameter(p.name)]:
            return SetParametersResult(successful=False, reason=(
                f'{", ".join(unknown)}: not a parameter of this node'))
        changes = [p for p in parameter_list if not self._is_kept(p)]
        if not changes:
            return SetParametersResult(successful=True)
        values, settings = self._with(changes), None
        is_dynamic = any(p.name in self._dynamic for p in changes)
        if is_dynamic:
            try:
                for name, parameter in self._dynamic.items():
                    parameter.check(getattr(values, name))
                settings = self.make_settings(values)
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        # A change to use_sim_time makes rclpy subscribe to the simulated time.
        what = f'subscription to {topics.CLOCK}'
        result = create_or_refuse(self, what, functools.partial(
            super().set_parameters_atomically, changes))
        if result is None:
            self._time_source.ros_time_is_active = False
            return SetParametersResult(successful=False, reason=refusals(self)[what])
        if result.successful and is_dynamic:
            self._current_values = values
            self.on_settings_changed(settings)
        return result

    def set_parameters(self, parameter_list: list[RosParameter]) -> list[SetParametersResult]:
        """Set parameters one after the other; see `set_parameters_atomically`."""
        return [self.set_parameters_atomically([one]) for one in parameter_list]

    def _is_kept(self, parameter: RosParameter) -> bool:
        name = parameter.name
        return (self.has_parameter(name) and self.describe_parameter(name).read_only
                and same_value(self.get_parameter(name), parameter))

    def _with(self, changes: Iterable[RosParameter]) -> types.SimpleNamespace:
        return types.SimpleNamespace(**{
            **vars(self._current_values),
            **{p.name: p.value for p in changes if p.name in self._dynamic}})
