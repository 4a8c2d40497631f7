"""Durations of the parts of the demonstration, from the command to its end."""

import os
import time
from pathlib import Path

_STAT_FILE = Path('/proc/self/stat')
# Index of the time of the start among the fields that follow the name of the program.
_START_FIELD = 19


def process_age_s() -> float | None:
    """Return the time since the start of this process [s]; None if the system does not provide it.

    A script that ends with ``exec`` is part of the process.
    """
    try:
        # The name of the program, in parentheses, may have spaces.
        fields = _STAT_FILE.read_text(encoding='utf-8').rpartition(')')[2].split()
        started_s = int(fields[_START_FIELD]) / os.sysconf('SC_CLK_TCK')
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - started_s, 0.0)
    except (OSError, ValueError, IndexError, AttributeError):
        return None


class Parts:
    """Consecutive parts of a duration; times are those of `time.monotonic` [s]."""

    def __init__(self, begin_s: float) -> None:
        self._begin_s = self._last_s = begin_s
        self._parts: list[tuple[str, float]] = []

    def end(self, part: str, now_s: float) -> None:
        """End a part, which began at the end of the previous one."""
        self._parts.append((part, now_s - self._last_s))
        self._last_s = now_s

    def text(self) -> str:
        """Return a line with the total and the parts, such as ``time: 2.1 s (first 0.4, ...)``."""
        parts = ', '.join(f'{name} {duration_s:.2f}' for name, duration_s in self._parts)
        return f'time: {self._last_s - self._begin_s:.2f} s ({parts})'
