"""Tables on disk: computed once for a system, then mapped into memory."""

import contextlib
import hashlib
import os
import tokenize
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.positioning import templates
from rhs_isac_ros.positioning.outside import tabulate_outside
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.system import System

# Maximum number of files in a folder. Beyond it, the least recently used files are deleted.
_MAX_FILES = 32
_PREFIX = 'table-'
# Version of the contents; tables of other versions are ignored.
_FORMAT = 10


def default_folder() -> Path | None:
    """Return the folder ``rhs_isac_ros`` in the user's cache, according to the XDG convention.

    For a user without a home directory, return None with a `RuntimeWarning`.
    """
    base = os.environ.get('XDG_CACHE_HOME', '')
    try:
        return (Path(base) if os.path.isabs(base) else Path.home() / '.cache') / 'rhs_isac_ros'
    except RuntimeError:
        warnings.warn('the table is not stored: no home directory, and XDG_CACHE_HOME is not set',
                      RuntimeWarning, stacklevel=2)
        return None


def load_table(system: System, folder: str | Path | None = None,
               progress: Callable[[float], None] | None = None, *, outside: bool = False,
               model: MeasurementModel | None = None) -> Mapping[str, np.ndarray]:
    """Load the table of a system from a folder, or compute it and store it there.

    The result contains the arrays of `tabulate` or, if `outside`, those of `tabulate_outside`, for
    `model`, the projected model of the system, if it is given. If they come from a folder, they
    are read-only and mapped into memory. Without a folder, or with a `RuntimeWarning` if the
    folder cannot be written, the table is kept only in memory. During the computation, `progress`
    is called with the completed share.
    """
    tabulate = tabulate_outside if outside else templates.tabulate
    if folder is None:
        return tabulate(model or system, progress)
    key = table_key(system)
    path = Path(folder) / f'{_PREFIX}{key}{"-outside" if outside else ""}.npy'
    table = _read(path, key)
    if table is not None:
        return table
    table = tabulate(model or system, progress)
    try:
        _write(path, key, table)
    except OSError as error:
        warnings.warn(f'the table cannot be stored: {error}', RuntimeWarning, stacklevel=2)
    return _read(path, key) or table


def table_key(system: System) -> str:
    """Return a hash of everything that determines the table of a system, 32 hexadecimal digits."""
    parts = (system.scenario.unplaced.id, system.codebook.id, __version__, _FORMAT,
             *([system.surface.id] if system.surface else []))
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _write(path: Path, key: str, table: Mapping[str, np.ndarray]) -> None:
    """Write a table atomically; delete the least recently used ones beyond `_MAX_FILES`."""
    # The file has one record: key, digest and arrays.
    fields = [(name, array.dtype, array.shape) for name, array in table.items()]
    dtype = np.dtype([('key', 'S32'), ('digest', 'S32'), *fields], align=True)
    record = np.array([(key.encode(), b'', *table.values())], dtype)
    record['digest'] = _digest(record)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda stream: np.save(stream, record, allow_pickle=False))
    # Another process may delete the same files.
    with contextlib.suppress(OSError):
        tables = sorted(path.parent.glob(f'{_PREFIX}*.npy'), key=lambda one: -one.stat().st_mtime)
        for unused in tables[_MAX_FILES:]:
            unused.unlink(missing_ok=True)


def _read(path: Path, key: str) -> Mapping[str, np.ndarray] | None:
    """Map a table into memory; return None if the file is missing, damaged or has another key."""
    try:
        record = np.load(path, mmap_mode='r', allow_pickle=False)
        names = record.dtype.names or ()
        valid = record.shape == (1,) and names[:2] == ('key', 'digest')
        if not valid or record['key'][0] != key.encode() or record['digest'][0] != _digest(record):
            return None
        # The time of the last use decides which tables are deleted.
        os.utime(path)
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, tokenize.TokenError):
        return None
    return {name: record[name][0] for name in names[2:]}


def _digest(record: np.ndarray) -> bytes:
    content = hashlib.blake2b(digest_size=16)
    content.update(repr(record.dtype.descr).encode())
    content.update(record.view(np.uint8)[64:].data)
    return content.hexdigest().encode()
