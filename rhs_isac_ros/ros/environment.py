"""Environment variables of ROS: their checks, their defaults, and domains for private networks."""

import argparse
import atexit
import contextlib
import os
import re
import socket
import sys
import xml.etree.ElementTree as ElementTree

from rhs_isac_ros.support.exits import print_error

LOCALHOST = 'LOCALHOST'
_DOMAIN, _RANGE = 'ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# Above domain 101, the ports may collide with the ephemeral ports of Linux.
_DOMAINS = 101
# Environment variable with the profile file of Fast DDS.
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
SECURITY, STRATEGY = 'ROS_SECURITY_ENABLE', 'ROS_SECURITY_STRATEGY'
# Valid values of variables of which rcl accepts, and reads differently, any others.
_VALID = {
    # rcl reads 010 as 8; a higher domain has no valid port numbers.
    _DOMAIN: ('0|[1-9][0-9]?|1[0-9]{2}|2[0-2][0-9]|23[0-2]', 'an integer from 0 to 232'),
    _RANGE: (
        'OFF|LOCALHOST|SUBNET|SYSTEM_DEFAULT', 'OFF, LOCALHOST, SUBNET or SYSTEM_DEFAULT'),
    'ROS_STATIC_PEERS': (r'[^,\s]+', 'addresses or host names with ; between them'),
    SECURITY: ('true|false', 'true or false'),
    STRATEGY: ('Enforce|Permissive', 'Enforce or Permissive')}


def check_middleware() -> None:
    """Exit with code 2 if the middleware that the environment selects is not installed.

    Called before rclpy is imported, which would end the process with another code.
    """
    if not (name := os.environ.get('RMW_IMPLEMENTATION')):
        return
    try:
        from ament_index_python import get_resources
    except ModuleNotFoundError:
        # The command itself says that ROS is missing.
        return
    installed = sorted({*get_resources('rmw_typesupport')} - {'rmw_implementation'})
    if name not in installed:
        print_error(f'environment variable RMW_IMPLEMENTATION: {name!r}, expected '
                    f'{", ".join(installed)}', 'rhs_isac_ros')
        sys.exit(2)


def check_environment(parser: argparse.ArgumentParser) -> None:
    """Exit with a usage error if an environment variable of ROS is invalid."""
    for name, (pattern, expected) in _VALID.items():
        if (value := os.environ.get(name, '')) and not re.fullmatch(pattern, value):
            parser.error(f'environment variable {name}: {value!r}, expected {expected}')
    # Fast DDS would run without the profile.
    if file := os.environ.get(_PROFILES):
        try:
            ElementTree.parse(file)
        except (OSError, ElementTree.ParseError) as error:
            parser.error(f'environment variable {_PROFILES}: {file!r}, expected an XML file: '
                         f'{getattr(error, "strerror", None) or error}')


def is_secure() -> bool:
    """Return whether the environment switches DDS security on."""
    return os.environ.get(SECURITY) == 'true'


def use_discovery_profile() -> None:
    """Shorten the discovery times of Fast DDS in this process.

    Fast DDS reads the profile when the first node is created. A file that is already set in the
    environment takes precedence; an empty name selects the defaults of Fast DDS.
    """
    from ament_index_python.packages import get_package_share_directory

    folder = get_package_share_directory('rhs_isac_ros')
    if not os.environ.setdefault(_PROFILES, f'{folder}/config/discovery.xml'):
        # Fast DDS reports an error for an empty name.
        del os.environ[_PROFILES]


def log_arguments() -> list[str]:
    """Return ROS arguments that disable log files if their default folder cannot be written.

    rcl would refuse to start, for instance in a container whose user has no home directory.
    """
    if os.environ.get('ROS_LOG_DIR') or os.environ.get('ROS_HOME'):
        return []
    home = os.environ.get('HOME', '')
    with contextlib.suppress(OSError):
        if home:
            os.makedirs(f'{home}/.ros/log', exist_ok=True)
            if os.access(f'{home}/.ros/log', os.W_OK):
                return []
    print(f'no log files: {home!r} is no home directory that can be written; choose a folder with '
          'ROS_LOG_DIR', file=sys.stderr)
    return ['--ros-args', '--disable-external-lib-logs']


def private_domain() -> dict[str, str]:
    """Return environment variables that isolate a network; existing values are kept."""
    return {_DOMAIN: os.environ.get(_DOMAIN) or claim_domain(),
            _RANGE: discovery_range()}


def discovery_range() -> str:
    """Return the discovery range of networks that `private_domain` isolates."""
    # The older variable takes precedence in rcl.
    return (LOCALHOST if os.environ.get('ROS_LOCALHOST_ONLY') == '1'
            else os.environ.get(_RANGE, LOCALHOST))


def claim_domain() -> str:
    """Claim a ROS domain until this process ends; raise RuntimeError if none is unclaimed."""
    for offset in range(_DOMAINS):
        domain = 1 + (os.getpid() + offset) % _DOMAINS
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            # An abstract name of Linux, which disappears with the socket.
            claim.bind(f'\0rhs_isac_ros.domain.{domain}')
        except OSError:
            claim.close()
        else:
            atexit.register(claim.close)
            return str(domain)
    raise RuntimeError(f'all {_DOMAINS} ROS domains are claimed by other processes')
