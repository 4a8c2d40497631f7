"""Starts a network with one process for each node: ``ros2 launch rhs_isac_ros network.launch.py``.

``--show-args`` lists the arguments. ``network.launch.xml`` starts the network in one process.
"""

from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, OrSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity

PACKAGE = 'rhs_isac_ros'
# A launch that receives SIGTERM does not end its processes, so the kernel does.
END_WITH_LAUNCH = 'setpriv --pdeathsig TERM'
ARGUMENTS = {
    'users': ('2', 'Number of users.'),
    'config': ('', 'Scenario file; empty: Table I of the paper.'),
    'codebook': ('', 'Codebook file that fits the scenario; empty: the default codebook.'),
    'seed': ('0', 'Seed of all random numbers.'),
    'estimator': ('bayes', 'Position estimator.'),
    'visualizer': ('false', 'Whether to publish markers for RViz and Foxglove.'),
    'rviz': ('false', 'Whether to start the visualizer and RViz.'),
    'record': ('', 'Recording to write (MCAP file); empty: none.'),
    'namespace': ('', 'Namespace of all nodes and topics, which separates several networks.'),
}


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
        If the number of users is not a positive integer.
    """
    text = LaunchConfiguration('users').perform(context)
    if not text.isdecimal() or not int(text):
        raise ValueError(f'users: {text!r}, expected a positive integer')
    seed = {'seed': _typed('seed', int)}
    shown = IfCondition(
        OrSubstitution(LaunchConfiguration('visualizer'), LaunchConfiguration('rviz')))
    return [
        *_recorder(context),
        _node('rhs_controller'),
        _node('positioner', estimator=_typed('estimator', str)),
        _node('transmission'),
        _node('optimizer', codebook_file=_typed('codebook', str)),
        _node('channel', **seed),
        *(_node('user', f'user_{number}', user_id=number, **seed)
          for number in range(1, int(text) + 1)),
        _node('bs', **seed),
        _node('visualizer', condition=shown),
        *_rviz(),
    ]


def _recorder(context: LaunchContext) -> list[Node]:
    """Return the recorder, which starts first because it misses earlier unlatched messages."""
    file = LaunchConfiguration('record').perform(context)
    if not file:
        return []
    return [Node(
        package=PACKAGE, executable='record', name='recorder', exec_name='record',
        output='screen', namespace=LaunchConfiguration('namespace'), prefix=END_WITH_LAUNCH,
        arguments=[file, '--config', LaunchConfiguration('config')])]


def _rviz() -> list[LaunchDescriptionEntity]:
    wanted = IfCondition(LaunchConfiguration('rviz'))
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        return [LogInfo(msg='rviz2 is not installed: apt install ros-jazzy-rviz2',
                        condition=wanted)]
    file = f'{get_package_share_directory(PACKAGE)}/config/rviz/network.rviz'
    return [Node(
        package='rviz2', executable='rviz2', name='rviz', exec_name='rviz', output='screen',
        # The topic names in the file are relative.
        namespace=LaunchConfiguration('namespace'), prefix=END_WITH_LAUNCH,
        arguments=['-d', file], condition=wanted)]


def _typed(argument: str, kind: type) -> ParameterValue:
    """Return an argument as a parameter with a type, which YAML would infer otherwise."""
    return ParameterValue(LaunchConfiguration(argument), value_type=kind)


def _node(
        executable: str, name: str = '', condition: IfCondition | None = None,
        **parameters: ParameterValue | int) -> Node:
    name = name or executable
    return Node(
        package=PACKAGE, executable=executable, name=name, exec_name=name, output='screen',
        namespace=LaunchConfiguration('namespace'), prefix=END_WITH_LAUNCH,
        condition=condition,
        parameters=[{'scenario_file': _typed('config', str), **parameters}])
