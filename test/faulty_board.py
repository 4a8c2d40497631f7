"""An emulated board that is as fast as it can be, and has faults at chosen patterns."""

import contextlib
import fcntl
import os

import numpy as np

from rhs_isac_ros.frontend.opensourceris import to_configuration
from rhs_isac_ros.frontend.opensourceris_emulator import _COMMAND, EmulatedBoard

# Time for an answer [s]: a busy machine delays those of the emulated board. A driver waits only
# briefly while it is to receive none.
ANSWER_S, NO_ANSWER_S = 60.0, 0.05


@contextlib.contextmanager
def impatient(driver):
    """Let a driver, whose connection is synchronised, wait only briefly for an answer."""
    driver.supply_voltage_v()
    driver._timeout_s, before = NO_ANSWER_S, driver._timeout_s
    try:
        yield
    finally:
        driver._timeout_s = before


class FaultyBoard(EmulatedBoard):
    """An emulated board with faults; it takes the time of the real one only if it `is_paced`.

    Attributes
    ----------
    faults : dict[int, str]
        Faults by the number of the pattern, from 0, at which they occur. ``silence``: the board
        loses the command. ``flipped bit``: it receives another bit. ``restart``: it restarts.
        ``late``: it answers together with the next command. ``closed``: the port disappears,
        until `plug`. ``occupied``: likewise, and another process opens the port first.
    n_patterns : int
        Number of commands for a pattern so far.
    """

    def __init__(self, is_paced: bool = False) -> None:
        super().__init__()
        self.faults: dict[int, str] = {}
        self.n_patterns = 0
        self._is_paced, self._is_occupied, self._late = is_paced, False, b''

    @property
    def configuration(self) -> np.ndarray:
        """What the elements show, float64 [256] of 0 and 1."""
        return to_configuration(self._firmware.pattern)

    def plug(self) -> None:
        """Start the board with a new port; this ends the faults ``closed`` and ``occupied``."""
        self._late, self._is_occupied = b'', False
        super().plug()

    def send(self, text: bytes) -> None:
        """Send text that no command asked for."""
        os.write(self._board, text)

    def _offer(self, terminal: str) -> None:
        if self._is_occupied:
            self._files.append(os.open(terminal, os.O_RDWR | os.O_NOCTTY))
            fcntl.flock(self._files[-1], fcntl.LOCK_EX)
        super()._offer(terminal)

    def _stops_before(self, time_s: float) -> bool:
        return super()._stops_before(time_s if self._is_paced else 0.0)

    def _receive(self, character: bytes) -> bytes | None:
        """Return the answer of the firmware with the faults, or None if the port is closed."""
        firmware, fault = self._firmware, None
        if character == b'\n' and _COMMAND.fullmatch(firmware.line):
            fault = self.faults.get(self.n_patterns)
            self.n_patterns += 1
        if fault == 'closed':
            self._close()
            return None
        if fault == 'occupied':
            with self._lock:
                before, self._is_occupied = self._files, True
                self._open()
            # The driver notices this, and finds the new port.
            for file in before:
                os.close(file)
            return None
        if fault == 'silence':
            firmware.line = b''
        elif fault == 'flipped bit':
            firmware.line = firmware.line[:-1] + b'%X' % (int(firmware.line[-1:], 16) ^ 1)
        elif fault == 'restart':
            firmware.line = b'!RESET'
        answer = firmware.receive(character)
        if fault == 'late':
            self._late, answer = answer, b''
        elif answer and self._late:
            self._late, answer = b'', self._late + answer
        return answer
