"""A surface of tiles with 512 elements that a server on the board controls, as that of OpenRIS."""

import contextlib
import socket

from rhs_isac_ros.frontend import SurfaceFault
from rhs_isac_ros.frontend.surface import checked

N_ELEMENTS, COLUMNS = 512, 16


class OpenRis:
    """One tile. The server confirms a pattern with `a`, and it has no command to read it back.

    The server takes a pattern only as one message of 1025 characters, and drops all others without
    an answer. After a fault, a new connection keeps a late answer apart from later ones.
    """

    n_elements, waits = N_ELEMENTS, True

    def __init__(self, n_elements, *, address='192.168.4.1', port=13591, tile=1, timeout_s=0.5):
        if n_elements != N_ELEMENTS:
            raise ValueError(f'n_elements: {n_elements}, expected {N_ELEMENTS}')
        self._server, self._tile, self._timeout_s = (address, port), tile, timeout_s
        self._connection = None

    def apply(self, configuration):
        """Show a configuration of 0 and 1, [512], whose rows begin at the bottom."""
        rows = checked(configuration, N_ELEMENTS, is_binary=True).reshape(-1, COLUMNS)[::-1]
        text = ';'.join(' '.join(map(str, row)) for row in rows.astype(int))
        with self._closed_after_fault():
            if self._connection is None:
                self._connection = socket.create_connection(self._server, self._timeout_s)
            self._connection.sendall(f'{self._tile:02d}{text}'.encode())
            answer = self._connection.recv(16)
            if not answer:
                raise SurfaceFault('closed', f'{self._server[0]}: the server has gone')
            if answer != b'a':
                raise SurfaceFault('garbled', f"{self._server[0]}: {answer!r}, expected b'a'")

    def close(self):
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    @contextlib.contextmanager
    def _closed_after_fault(self):
        try:
            yield
        except TimeoutError:
            self.close()
            raise SurfaceFault('silence', f'{self._server[0]}: no answer within '
                               f'{self._timeout_s:g} s') from None
        except OSError as error:
            self.close()
            raise SurfaceFault('closed', f'{self._server[0]}: {error}') from None
        except SurfaceFault:
            self.close()
            raise
