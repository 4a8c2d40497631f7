"""The environment of SROS 2: an enclave for each process, and errors of one line."""

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from rclpy.impl.implementation_singleton import rclpy_implementation

from rhs_isac_ros.executables import EXECUTABLES

_ENABLE, _STRATEGY, _KEYSTORE, OVERRIDE = (
    'ROS_SECURITY_ENABLE', 'ROS_SECURITY_STRATEGY', 'ROS_SECURITY_KEYSTORE',
    'ROS_SECURITY_ENCLAVE_OVERRIDE')
# Files of an enclave.
_FILES = ('identity_ca.cert.pem', 'cert.pem', 'key.pem', 'permissions_ca.cert.pem',
          'governance.p7s', 'permissions.p7s')
# The remapping rules of the name and the namespace of a node.
_RULE = re.compile(r'(?:[^:]+:)?__(node|ns):=(.*)')


class SecurityError(RuntimeError):
    """DDS security is requested and cannot be used."""


def is_enabled() -> bool:
    """Return whether the environment switches DDS security on."""
    return os.environ.get(_ENABLE) == 'true'


def prepare(args: Sequence[str]) -> list[str]:
    """Return a command line that names an enclave, if DDS security is enabled.

    By default, the enclave of a node has its full name, that of a tool is ``operator``. ROS
    reports an error of the environment with a traceback or not at all, so that it is checked here.

    Parameters
    ----------
    args
        Command line with the name of the program.

    Raises
    ------
    SecurityError
        If a variable has an unknown value, or a file is missing, or the permissions are for
        another domain.
    """
    for name, values in ((_ENABLE, ('', 'true', 'false')), (_STRATEGY, (
            '', 'Enforce', 'Permissive'))):
        # ROS ignores other values, and runs without security.
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
    """Return the enclave that a command line names, or that of its node or tool."""
    if '--enclave' in args[:-1]:
        return args[args.index('--enclave') + 1]
    rules = {match[1]: match[2] for match in map(_RULE.fullmatch, args) if match}
    program = os.path.basename(args[0])
    own = 'operator' if EXECUTABLES.get(program, 'tools') == 'tools' else program
    name = program if program == 'replay' else own
    return f'{rules.get("ns", "").rstrip("/")}/{rules.get("node", name)}'


def _check_enclave(enclave: str) -> None:
    keystore = os.environ.get(_KEYSTORE, '')
    if not (Path(keystore) / 'enclaves').is_dir():
        raise SecurityError(f'{_KEYSTORE}: {keystore!r}, expected a keystore: '
                            'ros2 security generate_artifacts')
    folder = Path(keystore) / 'enclaves' / enclave.lstrip('/')
    # A file *.p11 names a key in a device.
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
    """Convert the error of a node or an endpoint that DDS security refuses.

    Raises
    ------
    SecurityError
        Instead of an error of ROS, if DDS security is enabled.
    """
    try:
        with warnings.catch_warnings():
            # ROS destroys the incomplete node.
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
