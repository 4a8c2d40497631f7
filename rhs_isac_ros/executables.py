"""Entry points of the executables; they install signal handlers before any slow import.

Importing ROS, NumPy and the nodes takes a moment. During the imports, SIGINT and SIGTERM end the
process with exit code 0; the default handler of SIGINT would print a traceback.
"""

import importlib
import importlib.util
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

# Environment variable with the process id of a parent that its children must not outlive.
PARENT_ID = 'RHS_ISAC_ROS_PARENT_ID'
_PR_SET_PDEATHSIG = 1
# Executables in `tools`; all other executables are modules of `nodes`.
_TOOLS = ('calibrate', 'demo', 'record', 'replay', 'snapshot', 'view', 'watch')
# Subpackage of each executable.
EXECUTABLES = {
    **{path.stem: 'nodes' for path in (Path(__file__).parent / 'nodes').glob('[a-z]*.py')},
    **dict.fromkeys(_TOOLS, 'tools')}


def __getattr__(name: str) -> Callable[[], int]:
    """Return a main function that imports and runs an executable and returns an exit code."""
    if name not in EXECUTABLES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')

    def main() -> int:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: os._exit(0))
        _end_with_parent()
        try:
            _join_network(name)
            module = importlib.import_module(f'rhs_isac_ros.{EXECUTABLES[name]}.{name}')
        except ModuleNotFoundError as error:
            missing = str(error.name).partition('.')[0]
            if missing == 'rhs_isac_ros':
                raise
            print_error(f'needs {_what_provides(missing)}', name)
            return 1
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
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


def _join_network(name: str) -> None:
    """If a node starts, join the network early: discovery then runs while modules are imported."""
    arguments = sys.argv[1:]
    if EXECUTABLES[name] != 'nodes' or arguments[:1] not in ([], ['--ros-args']):
        return
    # This import limits the threads of NumPy, so it must precede ROS, which imports NumPy.
    importlib.import_module('rhs_isac_ros.nodes')
    try:
        importlib.import_module('rhs_isac_ros.ros.startup').join([name, *arguments])
    except RuntimeError:
        # Invalid ROS arguments or security settings, which the executable reports later.
        return


def _end_with_parent() -> None:
    """Make the kernel send SIGTERM to this process when its parent dies, if `PARENT_ID` is set.

    The parent may have several threads, so it cannot safely make the call between fork and exec.
    """
    parent = os.environ.pop(PARENT_ID, '')
    if parent:
        # Imported here, because most processes do not need it.
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        # The parent may have died before the call.
        if os.getppid() != int(parent):
            os._exit(0)


def print_error(error: object, program: str = '') -> None:
    """Print an error to stderr after the prefix `program`, by default the name of this command."""
    if not program:
        spec = getattr(sys.modules['__main__'], '__spec__', None)
        program = (f'python3 -m {spec.name.removesuffix(".__main__")}' if spec
                   else os.path.basename(sys.argv[0]))
    print(f'{program}: error: {error}', file=sys.stderr)


def exit_code_of(
        main: Callable[[], int | None], errors: tuple[type[Exception], ...] = (),
        program: str = '') -> int:
    """Run a main function and return the exit code, even if a standard stream is closed or fails.

    The code is the result of `main` (0 for None); 0 if the reader of the output closes it early,
    as ``head`` does; 1 if the output cannot be written; or 2 if `main` raises one of the `errors`.
    In the last two cases, the error is printed. Other exceptions propagate.
    """
    # If a standard stream is closed, the next file to be opened would take its descriptor.
    for name, mode in (('stdin', 'r'), ('stdout', 'w'), ('stderr', 'w')):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding='utf-8'))
    try:
        try:
            return main() or 0
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        discard_stdout()
        return 0
    except errors as error:
        print_error(error, program)
        return 2
    except OSError as error:
        # Errors about a file have a file name; errors about the output do not.
        if error.filename is not None:
            raise
        discard_stdout()
        print_error(error, program)
        return 1


def discard_stdout() -> None:
    """Redirect the standard output to `os.devnull`, so that Python can flush it at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
