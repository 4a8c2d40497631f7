"""Starts a network for each surface of a site, and their fusion.

``ros2 launch rhs_isac_ros site.launch.py site:=FILE`` takes the other arguments of
``network.launch.py``.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return the required argument and the launch of all networks."""
    source = PythonLaunchDescriptionSource(str(Path(__file__).with_name('network.launch.py')))
    return LaunchDescription([
        DeclareLaunchArgument('site', description='Site file.'),
        IncludeLaunchDescription(source)])
