"""Ends of commands: signals, errors of one line, exit codes, and streams that are closed."""

import importlib
import io
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

from rhs_isac_ros.support.plugins import PluginError, trace_of


def on_end_signals(handler: Callable[[int, Any], Any] | signal.Handlers) -> None:
    """Install a handler for SIGINT, SIGTERM and SIGHUP, which end a command.

    SIGHUP, which a closed terminal sends, remains ignored under ``nohup``.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def import_main(module: str) -> Callable[[], int]:
    """Import a module and return its function ``main``.

    During the import, which may take a second, a signal ends the process with exit code 0; the
    default handler of SIGINT would print a traceback.
    """
    on_end_signals(lambda *_: os._exit(0))
    main: Callable[[], int] = importlib.import_module(module).main
    on_end_signals(signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return main


def print_error(error: object, program: str = '') -> None:
    """Print an error to stderr after the prefix `program`, by default the name of this command.

    The traceback of the code of a plug-in follows.
    """
    if not program:
        spec = getattr(sys.modules['__main__'], '__spec__', None)
        program = (f'python3 -m {spec.name.removesuffix(".__main__")}' if spec
                   else os.path.basename(sys.argv[0]))
    trace = trace_of(error.__cause__) if isinstance(error, PluginError) else ''
    print(f'{program}: error: {error}{trace}', file=sys.stderr)


def exit_code_of(
        work: Callable[[], int | None], errors: tuple[type[Exception], ...] = (),
        program: str = '', *, failures: tuple[type[Exception], ...] = (),
        interrupted: int = 130) -> int:
    """Do the work of a command and return the exit code, even if a standard stream is closed.

    The code is the result of `work` (0 for None), 1 after one of the `failures` or if a file or
    the output cannot be written, 2 after one of the `errors`, `interrupted` after Ctrl-C, or 0 if
    the reader of the output closes it early, as ``head`` does. Failures and errors are printed
    after the name of the program. Other exceptions propagate.
    """
    # If a standard stream is closed, the next file to be opened would take its descriptor.
    for name, mode in (('stdin', 'r'), ('stdout', 'w'), ('stderr', 'w')):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding='utf-8'))
    if isinstance(sys.stdout, io.TextIOWrapper):
        # The encoding of a locale may lack characters of a table.
        sys.stdout.reconfigure(errors='backslashreplace')
    failures = (OSError, *failures)
    try:
        try:
            return work() or 0
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:
        return interrupted
    except BrokenPipeError:
        _discard_output()
        return 0
    except errors as error:
        print_error(error, program)
        return 2
    except failures as error:
        _discard_output()
        print_error(error, program)
        return 1


def _discard_output() -> None:
    """Discard the output if it cannot be written, so that Python can flush it at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
