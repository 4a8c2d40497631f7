"""Discovery of other processes while a node imports its modules; this one imports little.

Fast DDS takes a tenth of a second, and a second longer for each message that it misses.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python.packages import get_package_share_directory
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from rhs_isac_ros.ros.security import is_enabled, one_line, prepare

# Environment variable with the profile file of Fast DDS.
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
# Options of nodes that need no services, so that access control need not permit any.
WITHOUT_SERVICES: Mapping[str, Any] = {
    'start_parameter_services': False,
    'parameter_overrides': [Parameter('start_type_description_service', value=False)]}
# Keeps the participant of this process until its nodes do.
_holders: list[Node] = []


def discovery_profile_file() -> Path:
    """Return the path of the Fast DDS discovery profile, which depends on DDS security."""
    name = 'discovery_security.xml' if is_enabled() else 'discovery.xml'
    return Path(get_package_share_directory('rhs_isac_ros')) / 'config' / name


def use_discovery_profile() -> None:
    """Shorten the discovery times of Fast DDS in this process.

    Fast DDS reads the profile when the first node is created. A file that the environment already
    names takes precedence; an empty name selects the defaults of Fast DDS.
    """
    file = os.environ.setdefault(_PROFILES, str(discovery_profile_file()))
    if not file:
        # Fast DDS reports an error for an empty name.
        del os.environ[_PROFILES]


def join(args: list[str]) -> None:
    """Join the network with a hidden node, for a command line that begins with the program."""
    use_discovery_profile()
    rclpy.init(args=prepare(args), signal_handler_options=SignalHandlerOptions.NO)
    with one_line():
        _holders.append(Node(
            f'_starting_{os.getpid()}', use_global_arguments=False, enable_rosout=False,
            **WITHOUT_SERVICES))


def leave() -> None:
    """Destroy the hidden node, if there is one; nodes of the process keep its participant."""
    while _holders:
        _holders.pop().destroy_node()
