"""What the executables begin with: before anything slow is imported, Ctrl-C gets an end.

Python takes a moment to import ROS, NumPy and the nodes. A signal that comes meanwhile would end
in a traceback; here it ends the process as it does later on, with exit code 0.
"""

import importlib
import os
import signal
import sys
from collections.abc import Callable

# Executables whose module is in `tools`; those of all others are in `nodes`.
_TOOLS = ('demo', 'record', 'replay', 'snapshot', 'watch')


def __getattr__(name: str) -> Callable[[], int]:
    """Return the main function of an executable.

    Parameters
    ----------
    name
        Its name.

    Returns
    -------
    Callable
        Imports its module, runs it and returns its exit code.

    Raises
    ------
    AttributeError
        If it has the name of no executable.
    """
    if name.startswith('_'):
        raise AttributeError(f'{__name__} has no {name}')

    def main() -> int:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: os._exit(0))
        try:
            module = importlib.import_module(
                f'rhs_isac_ros.{"tools" if name in _TOOLS else "nodes"}.{name}')
        except ModuleNotFoundError as error:
            # pip also installs the executables on systems without ROS.
            print(f'error: {name} needs ROS 2 Jazzy and rhs_isac_msgs: {error}', file=sys.stderr)
            return 1
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        code: int = module.main()
        return code
    return main
