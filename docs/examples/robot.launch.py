"""A launch file of a robot, with the arguments of Nav2, that includes a network."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return the arguments of the robot, and the network in a scope of its own."""
    share = Path(get_package_share_directory('rhs_isac_ros'))
    network = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share / 'launch' / 'network.launch.py')))
    return LaunchDescription([
        DeclareLaunchArgument('namespace', default_value=''),
        DeclareLaunchArgument('use_sim_time', default_value='False'),
        DeclareLaunchArgument('params_file', default_value='nav2_params.yaml'),
        DeclareLaunchArgument('log_level', default_value='info'),
        # Without `forwarding`, the network does not see arguments of the robot that have the same
        # names, such as params_file.
        GroupAction([network], forwarding=False, launch_configurations={
            'use_sim_time': LaunchConfiguration('use_sim_time'),
            'log_level': LaunchConfiguration('log_level'),
            'namespace': 'positioning',
            'users': '1',
        }),
    ])
