"""Processes that are killed, measured, or started with a prefix of their command."""

import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

from rhs_isac_ros.ros.processes import Processes


class TrialProcesses(Processes):
    """Processes of a trial.

    `command_prefix` takes the name of a process, and returns a prefix of its command, such as ``ip
    netns exec lab``.
    """

    def __init__(self, logs: Path, environment: dict[str, str],
                 command_prefix: Callable[[str], Sequence[str]] = lambda name: ()) -> None:
        super().__init__(logs, environment)
        self._command_prefix = command_prefix

    def _spawn(self, name: str) -> None:
        own = self._commands[name]
        self._commands[name] = [*self._command_prefix(name), *own]
        super()._spawn(name)
        self._commands[name] = own

    def kill(self, name: str) -> None:
        """End a process with SIGKILL, as a crash would."""
        process = self._running.pop(name)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def restart(self, name: str) -> None:
        """Start a process again, with the same command and the same log."""
        self._spawn(name)

    def memory_bytes(self) -> dict[str, int]:
        """Return the resident memory of the running processes by name [bytes]."""
        page = os.sysconf('SC_PAGE_SIZE')
        return {name: int(text.split()[1]) * page for name, text in self._facts('statm')}

    def cpu_s(self) -> dict[str, float]:
        """Return the CPU time of the running processes by name [s]."""
        # User and system time; the name of the program, in parentheses, may contain blanks.
        ticks = {name: map(int, text.rpartition(')')[2].split()[11:13])
                 for name, text in self._facts('stat')}
        return {name: sum(both) / os.sysconf('SC_CLK_TCK') for name, both in ticks.items()}

    def _facts(self, file: str) -> list[tuple[str, str]]:
        return [(name, Path(f'/proc/{process.pid}/{file}').read_text(encoding='utf-8'))
                for name, process in self._running.items() if process.poll() is None]
