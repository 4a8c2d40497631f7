"""Tables on disk: built once for a scenario and codebook, then mapped into memory."""

import contextlib
import dataclasses
import hashlib
import os
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.model.files import write_whole
from rhs_isac_ros.positioning import templates
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Tables that a folder keeps; of more, the oldest go.
_MOST = 16
_PREFIX = 'table-'
# Of what a table holds; another one makes tables of before unknown.
_FORMAT = 2


def default_folder() -> Path:
    """Return where tables are kept unless another folder is given.

    Returns
    -------
    Path
        ``rhs_isac_ros`` in the user's folder for caches, by the XDG convention.
    """
    base = os.environ.get('XDG_CACHE_HOME', '')
    return (Path(base) if os.path.isabs(base) else Path.home() / '.cache') / 'rhs_isac_ros'


def table_of(model: WhitenedModel, folder: Path | None = None) -> Mapping[str, np.ndarray]:
    """Return the table of a model: from a folder if it is there, or else built and put there.

    Parameters
    ----------
    model
        The whitened model.
    folder
        Where tables are kept; None: nowhere.

    Returns
    -------
    Mapping
        What `tabulate` returns; from a folder, read-only and mapped into memory.

    Warns
    -----
    RuntimeWarning
        If the folder cannot be written; the table then is in memory.
    """
    if folder is None:
        return templates.tabulate(model)
    key = table_key(model)
    path = folder / f'{_PREFIX}{key}.npy'
    table = _read(path, key)
    if table is not None:
        return table
    table = templates.tabulate(model)
    try:
        _write(path, key, table)
    except OSError as error:
        warnings.warn(f'the table is not kept: {error}', RuntimeWarning, stacklevel=2)
        return table
    return _read(path, key) or table


def table_key(model: WhitenedModel) -> str:
    """Return what tells tables apart: a hash of all that they depend on.

    Parameters
    ----------
    model
        The whitened model.

    Returns
    -------
    str
        32 hexadecimal digits.
    """
    parts = (dataclasses.astuple(model.scenario), model.codebook.id, __version__, _FORMAT,
             templates.RANGE_CELL_M, templates.DIRECTION_STEP)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _write(path: Path, key: str, table: Mapping[str, np.ndarray]) -> None:
    """Write a table aside and rename it: at no time is it there in part."""
    # One record of an .npy file: key and digest, then the arrays. Wide numbers come first, so
    # that all are aligned.
    names = sorted(table, key=lambda name: -table[name].real.itemsize)
    dtype = np.dtype([('key', 'S32'), ('digest', 'S32')]
                     + [(name, table[name].dtype, table[name].shape) for name in names])
    record = np.zeros(1, dtype)
    for name in names:
        record[name] = table[name]
    record['key'] = key.encode()
    record['digest'] = _digest(record)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda stream: np.save(stream, record, allow_pickle=False))
    _prune(path.parent)


def _read(path: Path, key: str) -> Mapping[str, np.ndarray] | None:
    """Map a table; None if there is none, or one that is damaged or of something else."""
    try:
        record = np.load(path, mmap_mode='r', allow_pickle=False)
        names = record.dtype.names or ()
        known = record.shape == (1,) and names[:2] == ('key', 'digest')
        if not known or record['key'][0] != key.encode() or record['digest'][0] != _digest(record):
            return None
        # A table in use is not the oldest.
        os.utime(path)
    except (OSError, ValueError, EOFError, SyntaxError, TypeError):
        return None
    return {name: record[name][0] for name in names[2:]}


def _digest(record: np.ndarray) -> bytes:
    content = hashlib.blake2b(digest_size=16)
    content.update(repr(record.dtype.descr).encode())
    content.update(record.view(np.uint8)[64:])
    return content.hexdigest().encode()


def _prune(folder: Path) -> None:
    # Another process may be at the same.
    with contextlib.suppress(OSError):
        tables = sorted(folder.glob(f'{_PREFIX}*.npy'), key=lambda path: -path.stat().st_mtime)
        for path in tables[_MOST:]:
            path.unlink(missing_ok=True)
