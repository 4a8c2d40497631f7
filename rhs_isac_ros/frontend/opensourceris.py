"""The board Open Source RIS: 16 x 16 elements of one bit, on a serial port.

A command is one line, and so is its answer. The board answers only valid commands, and loses a
command that arrives before the previous answer has been sent. The driver therefore sends one
command at a time.

After a fault, answers to earlier commands may still arrive. The driver then asks for the supply
voltage and drops all lines before this answer: as answers keep the order of the commands, none of
the lines after it confirms an earlier pattern.
"""

import contextlib
import errno
import fcntl
import os
import re
import select
import termios
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from rhs_isac_ros.frontend.surface import FaultKind, SurfaceFault, checked
from rhs_isac_ros.support.fields import finite

ROWS, COLUMNS = 16, 16
BAUD = 115_200

_OK = re.compile(rb'#OK')
_PATTERN = re.compile(rb'#0X([0-9A-F]{64})')
_VOLTAGE = re.compile(rb'#(\d+\.\d+) V')
_SERIAL_NUMBER = re.compile(rb'#SerNo: *(\d+)')
# Lines that the board sends when it starts.
_BANNER = re.compile(rb'Open Source RIS|#READY!')
# A longer line is garbage; no answer has as many characters.
_LONGEST_LINE = 256


class OpenSourceRis:
    """Driver of the board; it opens the port when it first needs it, and after each failure.

    Raises ValueError if the board has another number of elements, or a number is out of range.

    Parameters
    ----------
    n_elements : int
        Number of elements that the caller expects.
    port : str
        Device, such as ``/dev/ttyUSB0``.
    timeout_s : float
        Time for an answer. The board takes 7 ms, and a USB adapter may take 16 ms more.
    read_back : bool
        Whether `apply` also asks the board for its pattern. Without this, a bit that changes on
        the line remains unnoticed.
    """

    waits = True

    def __init__(self, n_elements: int = ROWS * COLUMNS, *, port: str, timeout_s: float = 0.1,
                 read_back: bool = True) -> None:
        if n_elements != ROWS * COLUMNS:
            raise ValueError(f'n_elements: {n_elements}, expected {ROWS * COLUMNS}, the elements '
                             'of the board')
        self.n_elements = n_elements
        self._port = _Port(str(port))
        self._timeout_s = finite('timeout_s', timeout_s, 0.0)
        self._read_back = read_back
        # The digits that were read back last; empty if the board may show others.
        self._shown = b''
        # Whether every line from the board so far belongs to a known command.
        self._is_synchronised = False

    def apply(self, configuration: ArrayLike) -> None:
        """Set a pattern: 0 or 1 for each element, [256]."""
        digits = to_digits(checked(configuration, self.n_elements, is_binary=True))
        # A pattern that is shown already is only read back, which also finds that it was lost.
        before, self._shown = self._shown, b''
        if digits != before:
            self._ask(b'!0x' + digits, _OK)
        if not self._read_back:
            return
        if (shown := self._ask(b'?Pattern', _PATTERN)) != digits:
            different = np.flatnonzero(to_configuration(shown) != to_configuration(digits))
            self._is_synchronised = False
            raise self._fault('mismatch', f'{different.size} of {self.n_elements} elements differ '
                              f'from the pattern that was set, first element {different[0]}')
        self._shown = digits

    def read(self) -> np.ndarray:
        """Return the last pattern that the board has accepted, float64 [256] of 0 and 1.

        This is a copy in the memory of the board, not the state of its switches.
        """
        return to_configuration(self._ask(b'?Pattern', _PATTERN))

    def serial_number(self) -> int:
        """Return the serial number of the board; firmware 1.0 does not answer."""
        return int(self._ask(b'?SerialNo', _SERIAL_NUMBER))

    def supply_voltage_v(self) -> float:
        """Return the voltage of the external supply [V]."""
        return float(self._ask(b'?Vext', _VOLTAGE))

    def close(self) -> None:
        """Close the port, which another process may then open."""
        self._is_synchronised, self._shown = False, b''
        self._port.close()

    def _ask(self, command: bytes, expected: re.Pattern[bytes]) -> bytes:
        """Send a command; return the first group of its answer, or raise SurfaceFault."""
        with self._lost_connection():
            if not self._is_synchronised:
                self._synchronise()
            # Any exception in between, also Ctrl-C, leaves an answer that may still arrive.
            self._is_synchronised = False
            if stray := self._port.waiting():
                raise self._unexpected('stray', stray, 'no message before the next command')
            line = self._exchange(command)
        match = expected.fullmatch(line)
        if not match:
            raise self._unexpected('garbled', line, f'{expected.pattern!r} as answer to '
                                   f'{command[:9]!r}')
        self._is_synchronised = True
        return match.group(match.lastindex or 0)

    def _synchronise(self) -> None:
        """Open the port if necessary, and drop all lines that belong to earlier commands."""
        self._port.open()
        self._port.waiting()
        # The first line break ends a command that was sent only in part.
        line = self._exchange(b'\n?Vext')
        deadline_s = time.monotonic() + self._timeout_s
        while not _VOLTAGE.fullmatch(line):
            line = self._next_line(b'?Vext', deadline_s)
        self._is_synchronised = True

    def _exchange(self, command: bytes) -> bytes:
        deadline_s = time.monotonic() + self._timeout_s
        if not self._port.write(command + b'\n', deadline_s):
            raise self._fault('silence', f'does not accept {command.strip()[:9]!r} within '
                              f'{self._timeout_s:g} s')
        return self._next_line(command, deadline_s)

    def _next_line(self, command: bytes, deadline_s: float) -> bytes:
        # No answer is an empty line, but the board sends one when it starts.
        while (line := self._port.line(deadline_s)) == b'':
            pass
        if line is None:
            raise self._fault('silence', f'no answer to {command.strip()[:9]!r} within '
                              f'{self._timeout_s:g} s')
        return line

    def _unexpected(self, kind: FaultKind, found: bytes, expected: str) -> SurfaceFault:
        if _BANNER.search(found):
            return self._fault('restart', 'the board has restarted and lost its pattern')
        return self._fault(kind, f'{found[:80]!r}, expected {expected}')

    def _fault(self, kind: FaultKind, text: str) -> SurfaceFault:
        return SurfaceFault(kind, f'{self._port.name}: {text}')

    @contextlib.contextmanager
    def _lost_connection(self) -> Iterator[None]:
        """Close the port after an error of the operating system, and raise SurfaceFault."""
        try:
            yield
        # termios.error is no OSError; its arguments are those of one.
        except (OSError, termios.error) as error:
            self.close()
            number, text = (*error.args, '')[:2]
            if number in (errno.EBUSY, errno.EWOULDBLOCK):
                raise self._fault('occupied', 'another process uses the port') from None
            raise self._fault('closed', f'the port cannot be used: {text or error}') from None


def to_digits(configuration: np.ndarray) -> bytes:
    """Convert a configuration to 64 digits: the first bit is the top left element, then by rows.

    As `element_positions` does, a configuration begins with the lowest row. Seen from the front,
    both orders begin a row at the left.
    """
    rows = configuration.reshape(ROWS, COLUMNS)[::-1]
    return np.packbits(rows.astype(bool)).tobytes().hex().upper().encode()


def to_configuration(digits: bytes) -> np.ndarray:
    """Convert the 64 digits of a pattern to a configuration, float64 [256]."""
    bits = np.unpackbits(np.frombuffer(bytes.fromhex(digits.decode()), np.uint8))
    return bits.reshape(ROWS, COLUMNS)[::-1].ravel().astype(float)


class _Port:
    """A serial port that one process has opened; its methods raise OSError and termios.error."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._file: int | None = None
        self._received = bytearray()

    def open(self) -> None:
        """Open and configure the port, unless it is open."""
        if self._file is not None:
            return
        file = os.open(self.name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        # The lock refuses other drivers, also those of root; TIOCEXCL refuses programs without it.
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(file)
            raise
        self._file = file
        fcntl.ioctl(self._file, termios.TIOCEXCL)
        mode = termios.tcgetattr(self._file)
        mode[0] = mode[1] = mode[3] = 0
        mode[2] = termios.CS8 | termios.CREAD | termios.CLOCAL | termios.CRTSCTS
        mode[4] = mode[5] = termios.B115200
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
        termios.tcsetattr(self._file, termios.TCSANOW, mode)
        termios.tcflush(self._file, termios.TCIOFLUSH)

    def close(self) -> None:
        """Close the port, without an error."""
        file, self._file = self._file, None
        self._received.clear()
        if file is None:
            return
        with contextlib.suppress(OSError, termios.error):
            # Otherwise, closing waits until a board without power has taken the output.
            termios.tcflush(file, termios.TCOFLUSH)
            fcntl.ioctl(file, termios.TIOCNXCL)
        with contextlib.suppress(OSError):
            os.close(file)

    def write(self, text: bytes, deadline_s: float) -> bool:
        """Send text, and return whether the port has accepted all of it in time."""
        while text:
            if not self._wait(select.POLLOUT, deadline_s):
                return False
            with contextlib.suppress(BlockingIOError):
                text = text[os.write(self._open_file, text):]
        return True

    def line(self, deadline_s: float) -> bytes | None:
        """Return the next line without its line break, or None if none is complete in time."""
        while b'\n' not in self._received:
            if not self._wait(select.POLLIN, deadline_s):
                return None
            self._receive()
            if b'\n' not in self._received:
                del self._received[:-_LONGEST_LINE]
        line, _, rest = bytes(self._received).partition(b'\n')
        self._received[:] = rest
        return line

    def waiting(self) -> bytes:
        """Return and drop what has arrived so far."""
        if self._wait(select.POLLIN, 0):
            self._receive()
        found = bytes(self._received)
        self._received.clear()
        return found

    def _receive(self) -> None:
        received = os.read(self._open_file, 4096)
        if not received:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        self._received += received

    def _wait(self, event: int, deadline_s: float) -> bool:
        """Wait until the port can be read or written, and return whether it can in time."""
        poll = select.poll()
        poll.register(self._open_file, event)
        return bool(poll.poll(max(deadline_s - time.monotonic(), 0) * 1000))

    @property
    def _open_file(self) -> int:
        if self._file is None:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return self._file
