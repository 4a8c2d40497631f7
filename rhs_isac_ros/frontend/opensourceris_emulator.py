"""An emulator of the board Open Source RIS on a pseudo-terminal."""

import os
import re
import select
import tempfile
import threading
import time
import tty
from typing import Any

from rhs_isac_ros.frontend.opensourceris import BAUD

BANNER = (b'\nOpen Source RIS\nFirmware version: 1.1\nSerial no.:   0\nRow count: 16\n'
          b'Column count: 16\n\n#READY!\n')
RESTART_S = 0.544

_COMMAND = re.compile(rb'!0X([0-9A-F]{64})')
# Characters that continue a line, by its first one; any other ends it without an answer.
_VALID = {b'': re.compile(rb'[!?]'), b'!': re.compile(rb'[0-9A-Z=-]'), b'?': re.compile(rb'[A-Z]')}
# Length of the buffer of the firmware for one line.
_BUFFER = 128
# A character has a start bit, eight bits and a stop bit.
_CHARACTER_S = 10 / BAUD


class Firmware:
    """Firmware 1.1 of the board: characters in, answers out; every error is silence.

    Attributes
    ----------
    pattern : bytes
        The 64 digits of the last pattern.
    line : bytes
        What has been received of a command, in upper case.
    """

    def __init__(self) -> None:
        self.pattern = b'0' * 64
        self.line = b''

    def receive(self, character: bytes) -> bytes:
        """Take one character, and return the answer to a valid command that it completes."""
        if character == b'\n':
            line, self.line = self.line, b''
            return self._answer(line)
        character = character.upper()
        is_valid = _VALID[self.line[:1]].fullmatch(character) and len(self.line) <= _BUFFER
        self.line = self.line + character if is_valid else b''
        return b''

    def _answer(self, line: bytes) -> bytes:
        if match := _COMMAND.fullmatch(line):
            self.pattern = match.group(1)
            return b'#OK\n'
        if line == b'!RESET':
            self.pattern = b'0' * 64
            return BANNER
        return {b'?PATTERN': b'#0X' + self.pattern + b'\n', b'?VEXT': b'#05.80 V\n',
                b'?SERIALNO': b'#SerNo:   0\n'}.get(line, b'')


class EmulatedBoard:
    """The board on a pseudo-terminal, whose path `port` stays the same; use it as a context.

    Characters and a restart take as long as with the real board.
    """

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix='rhs_isac_ros.')
        self.port = os.path.join(self._folder.name, 'opensourceris')
        self._firmware = Firmware()
        self._thread: threading.Thread | None = None
        # The thread may close the files at a fault, another thread when the board is unplugged.
        self._lock = threading.Lock()
        self._files: list[int] = []

    def __enter__(self) -> 'EmulatedBoard':
        """Plug the board in."""
        self.plug()
        return self

    def __exit__(self, *_: Any) -> None:
        """Unplug the board and remove its port."""
        self.unplug()
        self._folder.cleanup()

    def plug(self) -> None:
        """Start the board with a new port."""
        self.unplug()
        self._firmware = Firmware()
        self._open()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Let the port disappear, as if the cable was pulled."""
        with self._lock:
            if self._files:
                os.write(self._stop, b'.')
        if self._thread:
            self._thread.join()
        self._close()

    def _open(self) -> None:
        self._board, host = os.openpty()
        self._stopped, self._stop = os.pipe()
        tty.setraw(host)
        # While this process keeps the terminal open, a driver can close and open it.
        self._files = [self._board, host, self._stopped, self._stop]
        # Last, because a driver opens the port as soon as it exists.
        self._offer(os.ttyname(host))

    def _offer(self, terminal: str) -> None:
        """Let the port lead to a terminal, perhaps instead of another one."""
        os.symlink(terminal, f'{self.port}.new')
        os.replace(f'{self.port}.new', self.port)

    def _close(self) -> None:
        with self._lock:
            if self._files:
                os.unlink(self.port)
            while self._files:
                os.close(self._files.pop())

    def _serve(self) -> None:
        """Answer commands until the board is unplugged, or a fault closes the port."""
        received_s = 0.0
        while self._stopped not in select.select([self._board, self._stopped], [], [])[0]:
            received_s = max(received_s, time.monotonic())
            n_lost = 0
            for value in os.read(self._board, 4096):
                received_s += _CHARACTER_S
                # The firmware loses what arrives while it sends an answer.
                if n_lost:
                    n_lost -= 1
                    continue
                answer = self._receive(bytes([value]))
                if answer is None:
                    return
                if not answer:
                    continue
                n_lost = len(answer)
                sent_s = received_s + len(answer) * _CHARACTER_S
                if self._stops_before(sent_s + (RESTART_S if answer == BANNER else 0)):
                    return
                os.write(self._board, answer)

    def _stops_before(self, time_s: float) -> bool:
        """Wait until a time; return whether the board is unplugged before."""
        remaining_s = max(time_s - time.monotonic(), 0)
        return bool(select.select([self._stopped], [], [], remaining_s)[0])

    def _receive(self, character: bytes) -> bytes | None:
        """Return the answer of the firmware; None if the port has been closed."""
        return self._firmware.receive(character)
