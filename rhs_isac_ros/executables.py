"""The entry points of the executables, which handle signals before anything slow is imported.

Importing ROS, NumPy and the nodes takes a moment. A signal during that time would cause a
traceback; the handlers set here end the process with exit code 0 instead, as a later signal does.
"""

import importlib
import importlib.util
import os
import signal
import sys
from collections.abc import Callable

# Subpackage of each executable.
EXECUTABLES = {
    'bs': 'nodes',
    'channel': 'nodes',
    'demo': 'tools',
    'network': 'nodes',
    'optimizer': 'nodes',
    'positioner': 'nodes',
    'record': 'tools',
    'replay': 'tools',
    'rhs_controller': 'nodes',
    'snapshot': 'tools',
    'transmission': 'nodes',
    'user': 'nodes',
    'visualizer': 'nodes',
    'watch': 'tools',
}


def __getattr__(name: str) -> Callable[[], int]:
    """Return the main function of an executable.

    Returns
    -------
    Callable
        Imports the module of the executable, runs it and returns its exit code.

    Raises
    ------
    AttributeError
        If there is no such executable.
    """
    if name not in EXECUTABLES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')

    def main() -> int:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: os._exit(0))
        try:
            module = importlib.import_module(f'rhs_isac_ros.{EXECUTABLES[name]}.{name}')
        except ModuleNotFoundError as error:
            missing = str(error.name).partition('.')[0]
            if missing == 'rhs_isac_ros':
                raise
            print(f'error: {name} needs {_what_provides(missing)}', file=sys.stderr)
            return 1
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        code: int = module.main()
        return code
    return main


def _what_provides(missing: str) -> str:
    """Return what to install or build so that a missing top-level module is found."""
    # pip also installs the executables on systems without ROS.
    if importlib.util.find_spec('rclpy') is None:
        return 'ROS 2 Jazzy, which is not sourced or not installed (no module rclpy)'
    # colcon does not search for packages inside a package.
    if missing == 'rhs_isac_msgs':
        return ('the package rhs_isac_msgs: in the src folder of the workspace, run '
                '`ln -s rhs_isac_ros/msg_defs rhs_isac_msgs`, then repeat colcon build '
                'and source install/setup.bash')
    return f'{missing}, which is not installed'
