"""Admittances of a board from a Touchstone file of a simulator or an analyser."""

import re
from pathlib import Path

import numpy as np

from rhs_isac_ros.model.arrays import numbers
from rhs_isac_ros.model.board import BoardError
from rhs_isac_ros.support.optional import optional_import

_COMMENT = re.compile(r'!.*')


def read_touchstone(path: str | Path, n_feeds: int) -> dict[str, np.ndarray]:
    """Read a file with the ports of the feeds, and then those of the elements.

    Returns arrays of a file for `network`, without its loads. Raises BoardError if the file cannot
    be read, or its meaning is uncertain, and MissingLibraryError without scikit-rf.
    """
    with optional_import('Touchstone', extra='touchstone'):
        import skrf
    try:
        lines = [_COMMENT.sub('', line).strip().lower()
                 for line in Path(path).read_text(encoding='utf-8', errors='replace').splitlines()]
        _check_dialect(lines)
        network = skrf.Network(str(path))
        admittances = numbers('Y', network.y, complex)
    # The library raises various exceptions for malformed files.
    except Exception as error:
        raise BoardError(f'{path}: cannot be read: {error}') from error
    n_ports = admittances.shape[1]
    if not 0 < n_feeds < n_ports:
        raise BoardError(f'{path}: {n_ports} ports with {n_feeds} feeds, expected more ports than '
                         'feeds')
    return {'frequency_hz': np.array(network.f), 'y_tt': admittances[:, :n_feeds, :n_feeds],
            'y_st': admittances[:, n_feeds:, :n_feeds], 'y_ss': admittances[:, n_feeds:, n_feeds:]}


def _check_dialect(lines: list[str]) -> None:
    """Raise BoardError for files that scikit-rf 2.2.0 misreads without an error."""
    options = next((line[1:].split() for line in lines if line.startswith('#')), [])
    version = next((line for line in lines if line.startswith('[version]')), '')
    kind = next((option for option in options if option in ('s', 'y', 'z', 'h', 'g')), 's')
    if not version and kind not in ('s', 'z'):
        raise BoardError(f'parameter {kind.upper()} of version 1, expected S or Z, or version 2: '
                         'the normalisation is ambiguous')
    formats = [line for line in lines if line.startswith('[matrix format]')]
    if any('full' not in line for line in formats):
        raise BoardError('a lower or upper matrix, expected full matrices')
