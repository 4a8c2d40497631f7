"""Joining the network: discovery by Fast DDS, and the enclave of SROS 2.

Discovery takes a tenth of a second, and a second longer for each discovery message that is missed.
It therefore starts before the modules of a node are imported, and this module imports little.
"""

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python.packages import get_package_share_directory
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from rhs_isac_ros.executables import EXECUTABLES

# Environment variable with the profile file of Fast DDS.
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
# Options for nodes that need no services; access control then need not permit any.
WITHOUT_SERVICES: Mapping[str, Any] = {
    'start_parameter_services': False,
    'parameter_overrides': [Parameter('start_type_description_service', value=False)]}
# The hidden node, if any. It keeps the participant of this process alive until other nodes exist.
_holders: list[Node] = []


def discovery_profile_file() -> Path:
    """Return the path of the Fast DDS discovery profile."""
    return Path(get_package_share_directory('rhs_isac_ros')) / 'config' / 'discovery.xml'


def use_discovery_profile() -> None:
    """Shorten the discovery times of Fast DDS in this process.

    Fast DDS reads the profile when the first node is created. A file that is already set in the
    environment takes precedence; an empty name selects the defaults of Fast DDS.
    """
    file = os.environ.setdefault(_PROFILES, str(discovery_profile_file()))
    if not file:
        # Fast DDS reports an error for an empty name.
        del os.environ[_PROFILES]


def join(args: list[str]) -> None:
    """Join the network with a hidden node; `args` is a command line with the program name."""
    use_discovery_profile()
    rclpy.init(args=prepare(args), signal_handler_options=SignalHandlerOptions.NO)
    with one_line():
        _holders.append(Node(
            f'_starting_{os.getpid()}', use_global_arguments=False, enable_rosout=False,
            **WITHOUT_SERVICES))


def leave() -> None:
    """Destroy the hidden node, if any; other nodes of the process keep the participant alive."""
    while _holders:
        _holders.pop().destroy_node()


_ENABLE, _STRATEGY, _KEYSTORE, OVERRIDE = (
    'ROS_SECURITY_ENABLE', 'ROS_SECURITY_STRATEGY', 'ROS_SECURITY_KEYSTORE',
    'ROS_SECURITY_ENCLAVE_OVERRIDE')
# Files of an enclave.
_FILES = ('identity_ca.cert.pem', 'cert.pem', 'key.pem', 'permissions_ca.cert.pem',
          'governance.p7s', 'permissions.p7s')
# The remapping rules for the name and the namespace of a node.
_RULE = re.compile(r'(?:[^:]+:)?__(node|ns):=(.*)')


class SecurityError(RuntimeError):
    """DDS security is requested, but cannot be used."""


def is_enabled() -> bool:
    """Return whether the environment switches DDS security on."""
    return os.environ.get(_ENABLE) == 'true'


def prepare(args: Sequence[str]) -> list[str]:
    """Return the command line `args`, with an enclave if DDS security is enabled.

    The command line begins with the name of the program. By default, nodes and ``replay`` have
    their full names as enclaves; all other tools share ``operator`` in their namespace. The
    environment is checked here, because ROS reports errors in it with a traceback or not at all.

    Raises
    ------
    SecurityError
        If a variable has an unknown value; with the strategy ``Enforce``, also if the keystore or
        a file is missing, or the permissions are for another domain.
    """
    for name, values in ((_ENABLE, ('', 'true', 'false')), (_STRATEGY, (
            '', 'Enforce', 'Permissive'))):
        # ROS accepts any other value, but then runs without security or does not enforce it.
        if os.environ.get(name, '') not in values:
            raise SecurityError(
                f'{name}: {os.environ[name]!r}, expected {" or ".join(values[1:])}')
    if not is_enabled():
        return list(args)
    enclave = os.environ.get(OVERRIDE) or _enclave(args)
    try:
        _check_enclave(enclave)
    except SecurityError as error:
        if os.environ.get(_STRATEGY) == 'Enforce':
            raise
        print(f'WITHOUT security, because {_STRATEGY} is not Enforce: {error}', file=sys.stderr)
    return list(args) if '--enclave' in args else [*args, '--ros-args', '--enclave', enclave]


def _enclave(args: Sequence[str]) -> str:
    """Return the enclave in a command line, or the default for its node or tool."""
    if '--enclave' in args[:-1]:
        return args[args.index('--enclave') + 1]
    rules = {match[1]: match[2] for match in map(_RULE.fullmatch, args) if match}
    program = os.path.basename(args[0])
    is_tool = EXECUTABLES.get(program, 'tools') == 'tools' and program != 'replay'
    name = 'operator' if is_tool else rules.get('node', program)
    return f'{rules.get("ns", "").rstrip("/")}/{name}'


def _check_enclave(enclave: str) -> None:
    keystore = os.environ.get(_KEYSTORE, '')
    if not (Path(keystore) / 'enclaves').is_dir():
        raise SecurityError(f'{_KEYSTORE}: {keystore!r}, expected a keystore: '
                            'ros2 security generate_artifacts')
    folder = Path(keystore) / 'enclaves' / enclave.lstrip('/')
    # A file *.p11 refers to a key on a device.
    missing = [name for name in _FILES if not (
        (folder / name).is_file() or (folder / name).with_suffix('.p11').is_file())]
    if missing:
        raise SecurityError(f'enclave {enclave}: no {missing[0]} in {folder}; generate its keys, '
                            f'or choose another with --ros-args --enclave or {OVERRIDE}')
    # The permissions are signed, but not encrypted.
    signed = (folder / 'permissions.p7s').read_text(encoding='utf-8', errors='replace')
    domains = re.findall(r'<id>\s*(\d+)\s*</id>', signed)
    domain = os.environ.get('ROS_DOMAIN_ID') or '0'
    if domains and domain not in domains:
        raise SecurityError(f'ROS_DOMAIN_ID: {domain}, expected {" or ".join({*domains})}, for '
                            f'which the permissions of {enclave} are signed')


@contextlib.contextmanager
def one_line() -> Iterator[None]:
    """If DDS security is enabled, convert an error of rcl to a `SecurityError` of one line."""
    try:
        with warnings.catch_warnings():
            # ROS warns when it destroys the incomplete node.
            warnings.simplefilter('ignore', RuntimeWarning)
            yield
    except rclpy_implementation.RCLError as error:
        if not is_enabled():
            raise
        # The end of the text is a position in the sources of ROS.
        text = str(error).partition(', at ')[0].splitlines()[0]
        if 'failed to create participant' in text:
            text = ('Fast DDS rejects the files of the enclave, which may be damaged, expired or '
                    'signed by another authority')
        if 'security libraries' in text:
            text = ('Fast DDS was built without security, as in the wheels; install the packages '
                    f'of ROS 2 Jazzy, or unset {_ENABLE}')
        raise SecurityError(f'DDS security: {text}') from None
