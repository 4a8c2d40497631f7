"""Entry points of the executables, which handle signals before any slow import."""

import contextlib
import functools
import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from rhs_isac_ros.support.exits import exit_code_of, import_main, print_error

# All other executables are modules of `nodes`.
_TOOLS = ('calibrate', 'demo', 'record', 'replay', 'snapshot', 'view', 'watch')
EXECUTABLES = {
    **{path.stem: 'nodes' for path in (Path(__file__).parent / 'nodes').glob('[a-z]*.py')},
    **dict.fromkeys(_TOOLS, 'tools')}


def __getattr__(name: str) -> Callable[[], int]:
    """Return a main function that imports and runs an executable and returns an exit code."""
    if name not in EXECUTABLES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return functools.partial(run, f'rhs_isac_ros.{EXECUTABLES[name]}.{name}', name)


def run(module: str, program: str) -> int:
    """Import a module, call its function ``main`` and return the exit code."""
    with missing_named(program):
        main = import_main(module)
    return exit_code_of(main, program=program)


@contextlib.contextmanager
def missing_named(program: str) -> Iterator[None]:
    """If a package is missing in a block, print a line and raise SystemExit with the code 1."""
    try:
        yield
    except ModuleNotFoundError as error:
        missing = str(error.name).partition('.')[0]
        if missing == 'rhs_isac_ros':
            raise
        print_error(f'needs {_what_provides(missing)}', program)
        sys.exit(1)


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
