"""The entry points of the executables, which handle signals before anything slow is imported.

Importing ROS, NumPy and the nodes takes a moment. A signal during that time would cause a
traceback; the handlers set here end the process with exit code 0 instead, as a later signal does.
"""

import importlib
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
            # pip also installs the executables on systems without ROS.
            print(f'error: {name} needs ROS 2 Jazzy and rhs_isac_msgs: {error}', file=sys.stderr)
            return 1
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        code: int = module.main()
        return code
    return main
