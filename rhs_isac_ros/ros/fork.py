"""Executables of the package as forks of this process, which has imported their modules before."""

import importlib
import os
import select
import signal
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from typing import BinaryIO, NoReturn

from rhs_isac_ros import executables


class Fork:
    """A child process with a part of the interface of `subprocess.Popen`.

    The imports of an executable take longer than everything else at its start, and a fork shares
    them. Only a process without threads may fork, so one without a ROS context.

    Parameters
    ----------
    arguments
        Command line arguments of the executable.
    log
        File for its output.
    environment
        All environment variables.

    Attributes
    ----------
    pid
        Id of the process.
    """

    def __init__(
            self, executable: str, arguments: Sequence[str], log: BinaryIO,
            environment: Mapping[str, str]) -> None:
        importlib.import_module(
            f'rhs_isac_ros.{executables.EXECUTABLES[executable]}.{executable}')
        # The child would write the buffered output once more.
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if not self.pid:
            _run(executable, arguments, log, environment)
        self._returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit code, negative after a signal; None while the process runs."""
        if self._returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._returncode = os.waitstatus_to_exitcode(status)
        return self._returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end of the process, and return its exit code.

        Raises
        ------
        subprocess.TimeoutExpired
            If it has not ended after `timeout` seconds.
        """
        if self.poll() is None:
            handle = os.pidfd_open(self.pid)
            try:
                select.select([handle], [], [], timeout)
            finally:
                os.close(handle)
        code = self.poll()
        if code is None:
            raise subprocess.TimeoutExpired([str(self.pid)], timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End the process with SIGKILL."""
        self.send_signal(signal.SIGKILL)


def _run(
        executable: str, arguments: Sequence[str], log: BinaryIO,
        environment: Mapping[str, str]) -> NoReturn:
    """Run an executable in the child process, and end the process."""
    code = 1
    try:
        os.setsid()
        for number, file in ((0, os.open(os.devnull, os.O_RDONLY)), (1, log.fileno()),
                             (2, log.fileno())):
            os.dup2(file, number)
        os.environ.clear()
        os.environ.update(environment)
        sys.argv = [executable, *arguments]
        code = getattr(executables, executable)()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        # The exit handlers belong to the parent.
        os._exit(code)
