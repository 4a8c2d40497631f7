"""Starts a network or a site: ``ros2 launch rhs_isac_ros network.launch.py``.

``--show-args`` lists the arguments. Other launch files can include this one.
"""

import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, LogInfo, OpaqueFunction
from launch.conditions import InvalidConditionExpressionError, evaluate_condition_expression
from launch.events.process import ProcessExited
from launch.substitutions import TextSubstitution
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from rhs_isac_ros.positioning import Site
from rhs_isac_ros.ros.parameters import NODES, hint
from rhs_isac_ros.ros.roster import MAX_USER_NODES, networks, nodes_of

PACKAGE, FOLDER = 'rhs_isac_ros', Path(__file__).resolve().parent
# A launch that receives SIGTERM does not end its processes, so the kernel does.
END_WITH_LAUNCH = 'setpriv --pdeathsig TERM'
ARGUMENTS = {
    'users': ('2', 'Number of users; more than 16 share one process.'),
    'config': ('', 'Scenario file; empty: Table I of the paper.'),
    'codebook': ('', 'Codebook file that fits the scenario; empty: the default codebook.'),
    'system': ('', 'System file, which names a scenario, a codebook and a calibration, in place '
               'of config; empty: none.'),
    'site': ('', 'Site file, which takes the place of config and codebook: one network for each '
             'surface, and their fusion; empty: a single surface.'),
    'seed': ('0', 'Seed of all random numbers.'),
    'estimator': ('bayes', 'Position estimator.'),
    'params_file': ('', 'ROS parameter file for all nodes, which takes precedence over the other '
                        'arguments; empty: none.'),
    'use_sim_time': ('false', 'Whether the emulated world follows the topic /clock.'),
    'visualizer': ('false', 'Whether to publish markers for RViz and Foxglove.'),
    'rviz': ('false', 'Whether to start the visualizer and RViz.'),
    'record': ('', 'Recording to write (MCAP file); empty: none.'),
    'namespace': ('', 'Namespace of all nodes and topics, which separates several networks.'),
    'log_level': ('info', 'Minimum severity of logged messages.'),
    'respawn': ('false', 'Whether to restart a process that ends; otherwise a failure ends the '
                         'launch.'),
    'composed': ('true', 'Whether to run all nodes but the visualizer in one process.'),
}
LOG_LEVELS = ('debug', 'info', 'warn', 'error', 'fatal')
# Names with a meaning for launch itself.
OF_LAUNCH = ('launch-prefix', 'launch-prefix-filter', 'emulate_tty', 'sigterm_timeout',
             'sigkill_timeout')
# Names that Nav2 passes to what it includes, each with the argument of which it sets the default.
OF_NAV2 = {'use_composition': 'composed', 'use_respawn': 'respawn', 'autostart': '',
           'container_name': ''}
RESPAWN_DELAY_S = 1.0
# Exit code for invalid parameters, arguments or files: a restart would fail again.
INVALID = 2


def generate_launch_description() -> LaunchDescription:
    """Return the arguments of the launch and the function that starts the nodes."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, (default, text) in ARGUMENTS.items()),
        OpaqueFunction(function=start_nodes),
    ])


def start_nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return the nodes, for the values of the arguments in `context`.

    Raises
    ------
    ValueError
        If an argument is unknown or has an invalid value, if the parameter file does not exist, or
        if the site file is invalid or used with another file.
    """
    _refuse_unknown(context)
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    for other, name in OF_NAV2.items():
        if name and given[name] == ARGUMENTS[name][0]:
            given[name] = context.launch_configurations.get(other, given[name])
    # A parent may push a namespace, and pass it, too.
    pushed = context.launch_configurations.get('ros_namespace', '')
    if given['namespace'].strip('/') == pushed.strip('/'):
        given['namespace'] = ''
    users = _integer('users', given, 1)
    values = {'seed': _integer('seed', given, 0), 'codebook_file': given['codebook'],
              'estimator': given['estimator']}
    others = [name for name in ('config', 'system', 'codebook') if given[name]]
    if given['site'] and others:
        raise ValueError(f'site: {given["site"]!r}, expected none with {others[0]}')
    surfaces = Site.from_yaml(given['site']).surfaces if given['site'] else ()
    file = given['params_file']
    if file and not Path(file).is_file():
        raise ValueError(f'params_file: {file!r}, expected an existing file')
    if given['log_level'].lower() not in LOG_LEVELS:
        raise ValueError(f'log_level: {given["log_level"]!r}, expected {", ".join(LOG_LEVELS)}')
    if _boolean('composed', given):
        # Without a name, the parameters apply to every node of the process.
        nodes = [_node(given, 'network', None, users=users, **values)]
    else:
        together = users > MAX_USER_NODES
        nodes = [LogInfo(msg=f'the {users} users share the node users')] if together else []
        nodes += [_node(_below(given, one.namespace), one.role, one.name or one.role,
                        **_known(one.role, values), **one.users)
                  for one in nodes_of(users, surfaces, together)]
    if _boolean('visualizer', given) or _boolean('rviz', given):
        nodes += [_node(_below(given, name), 'visualizer', 'visualizer')
                  for name, roles in networks(surfaces) if 'positioner' in roles]
    # The recorder comes first, because it misses earlier messages that are not latched.
    return [*_recorder(given), *nodes, *_rviz(given)]


def _refuse_unknown(context: LaunchContext) -> None:
    """Raise ValueError if an include of a launch file in this folder has an unknown argument.

    launch sets an argument that nobody declares without a word. In `context`, it looks like an
    argument of a parent, so the actions that include these files are examined.
    """
    event = getattr(context.locals, 'event', None)
    for include in _includes(event.launch_description) if hasattr(
            event, 'launch_description') else ():
        if Path(include.launch_description_source.location).resolve().parent == FOLDER:
            for name, _ in include.launch_arguments:
                text = perform_substitutions(context, normalize_to_list_of_substitutions(name))
                if text not in (*ARGUMENTS, *OF_LAUNCH, *OF_NAV2):
                    raise ValueError(f'{text}: unknown argument{hint(text, ARGUMENTS)}')


def _includes(entity: LaunchDescriptionEntity) -> Iterator[IncludeLaunchDescription]:
    for one in [*entity.describe_sub_entities(), *(
            one for _, several in entity.describe_conditional_sub_entities() for one in several)]:
        if isinstance(one, IncludeLaunchDescription):
            yield one
        yield from _includes(one)


def _below(given: dict[str, str], name: str) -> dict[str, str]:
    """Return the arguments of a network with a name, whose namespace is in the given one."""
    return {**given, 'namespace': f'{given["namespace"].rstrip("/")}/{name}'.rstrip('/')}


def _known(role: str, values: dict[str, int | str]) -> dict[str, int | str]:
    """Return those of the `values` that are parameters of a role."""
    known = {parameter.name for parameter in NODES[role]}
    return {name: value for name, value in values.items() if name in known}


def _integer(name: str, given: dict[str, str], low: int) -> int:
    text = given[name]
    if not (text.isascii() and text.isdecimal()) or int(text) < low:
        raise ValueError(f'{name}: {text!r}, expected an integer of at least {low}')
    return int(text)


def _boolean(name: str, given: dict[str, str]) -> bool:
    """Return the value of an argument, which is read like a condition of launch."""
    try:
        return evaluate_condition_expression(LaunchContext(), [TextSubstitution(text=given[name])])
    except InvalidConditionExpressionError:
        raise ValueError(f'{name}: {given[name]!r}, expected true or false') from None


def _node(given: dict[str, str], executable: str, name: str | None, **values: int | str) -> Node:
    # rcl gives precedence to the parameters that it reads last, which are those in the file.
    file = [ParameterFile(given['params_file'])] if given['params_file'] else []
    # JSON quotes a string so that YAML does not read it as another type.
    pairs = [f'{key}:={json.dumps(value, ensure_ascii=False)}'
             for key, value in {
                 **values, 'scenario_file': given['config'],
                 'system_file': given['system'], 'site_file': given['site'],
                 # By default not set, because a parent may have set it for all nodes.
                 **({'use_sim_time': True} if _boolean('use_sim_time', given) else {})}.items()]
    return _process(
        given, name or executable, _boolean('respawn', given),
        [word for pair in pairs for word in ('-p', pair)],
        executable=executable, name=name, parameters=file)


def _recorder(given: dict[str, str]) -> list[Node]:
    if not given['record']:
        return []
    # Not restarted, because a second process would replace the recording. If the disk is full, the
    # network does not end with the recorder.
    return [_process(given, 'record', False, [], is_optional=True, executable='record',
                     name='recorder', arguments=[given['record'], *(
                         word for name in ('config', 'system', 'site')
                         for word in (f'--{name}', given[name]))])]


def _process(
        given: dict[str, str], exec_name: str, respawn: bool, ros_arguments: list[str],
        is_optional: bool = False, **options: Any) -> Node:
    """Return an action for a process of the package, named `exec_name` in the output.

    If it fails and is neither restarted nor optional, the launch ends.
    """
    return Node(
        package=PACKAGE, exec_name=exec_name, output='screen', prefix=END_WITH_LAUNCH,
        namespace=given['namespace'], respawn=respawn, respawn_delay=RESPAWN_DELAY_S,
        ros_arguments=['--log-level', given['log_level'], *ros_arguments],
        on_exit=functools.partial(_end_if_failed, respawn, is_optional), **options)


def _rviz(given: dict[str, str]) -> list[LaunchDescriptionEntity]:
    if not _boolean('rviz', given):
        return []
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        return [LogInfo(msg='rviz2 is not installed: apt install ros-jazzy-rviz2')]
    name = 'site' if given['site'] else 'network'
    file = f'{get_package_share_directory(PACKAGE)}/config/rviz/{name}.rviz'
    return [Node(
        package='rviz2', executable='rviz2', name='rviz', exec_name='rviz', output='screen',
        # The topic names in the file are relative.
        namespace=given['namespace'], prefix=END_WITH_LAUNCH, arguments=['-d', file])]


def _end_if_failed(
        respawns: bool, is_optional: bool, event: ProcessExited, context: LaunchContext) -> None:
    """End the launch with exit code 1 if a process failed that is not optional.

    A process that will be restarted may fail, but not with the exit code `INVALID`.

    Raises
    ------
    RuntimeError
        ``launch`` logs this error and ends; its action ``Shutdown`` would give exit code 0.
    """
    is_tolerated = is_optional or respawns and event.returncode != INVALID
    if event.returncode and not is_tolerated and not context.is_shutdown:
        raise RuntimeError(f'{event.process_name} ended with exit code {event.returncode}')
