"""Entry points of the executables, which handle signals before any slow import.

Importing ROS, NumPy and the nodes takes a moment. During the imports, a signal ends the process
with exit code 0; the default handler of SIGINT would print a traceback.
"""

import importlib
import importlib.util
import os
import signal
from collections.abc import Callable
from pathlib import Path

from rhs_isac_ros.support.exits import exit_code_of, on_end_signals, print_error

# All other executables are modules of `nodes`.
_TOOLS = ('calibrate', 'demo', 'record', 'replay', 'snapshot', 'view', 'watch')
EXECUTABLES = {
    **{path.stem: 'nodes' for path in (Path(__file__).parent / 'nodes').glob('[a-z]*.py')},
    **dict.fromkeys(_TOOLS, 'tools')}


def __getattr__(name: str) -> Callable[[], int]:
    """Return a main function that imports and runs an executable and returns an exit code."""
    if name not in EXECUTABLES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')

    def main() -> int:
        on_end_signals(lambda *_: os._exit(0))
        try:
            module = importlib.import_module(f'rhs_isac_ros.{EXECUTABLES[name]}.{name}')
        except ModuleNotFoundError as error:
            missing = str(error.name).partition('.')[0]
            if missing == 'rhs_isac_ros':
                raise
            print_error(f'needs {_what_provides(missing)}', name)
            return 1
        on_end_signals(signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return exit_code_of(module.main, program=name)
    return main


def _what_provides(missing: str) -> str:
    """Describe what provides a missing top-level module; without rclpy, that is always ROS 2."""
    # pip also installs the executables on systems without ROS.
    if importlib.util.find_spec('rclpy') is None:
        return 'ROS 2 Jazzy, which is not sourced or not installed (no module rclpy)'
    # colcon does not search for packages inside a package.
    if missing == 'rhs_isac_msgs':
        return ('the package rhs_isac_msgs: in the src folder of the workspace, run '
                '`ln -s rhs_isac_ros/msg_defs rhs_isac_msgs`, then repeat colcon build '
                'and source install/setup.bash')
    return f'{missing}, which is not installed'
