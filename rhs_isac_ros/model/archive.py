"""Files of arrays with a description, in NumPy's format ``.npz`` without pickled objects."""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.model.files import write_whole


class ArchiveError(ValueError):
    """A file cannot be read, or is not an archive of the expected kind."""


def write_archive(path: str | Path, arrays: Mapping[str, np.ndarray | float],
                  about: Mapping[str, Any]) -> None:
    """Write arrays and a description that JSON can represent.

    An existing file is replaced at the end, or kept if there is an `OSError`.
    """
    content: dict[str, Any] = {**arrays, 'about': json.dumps(about)}
    write_whole(path, lambda stream: np.savez(stream, **content))


def read_archive(path: str | Path, kind: str, version: int, names: set[str]
                 ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read arrays and their description.

    Parameters
    ----------
    kind
        What the file contains, for errors.
    version
        Expected value of ``format`` in the description, which the result lacks.
    names
        Expected names of the arrays.

    Raises
    ------
    ArchiveError
        If the file cannot be read, is damaged, or has another format or other arrays.
    """
    try:
        with open(path, 'rb') as stream:
            file = np.load(stream, allow_pickle=False)
            arrays = {key: file[key] for key in getattr(file, 'files', ())}
        about = json.loads(str(arrays.pop('about', '{}')))
    # Reading verifies the checksum that the format holds for every array.
    except (OSError, ValueError, EOFError, NotImplementedError, SyntaxError, KeyError,
            zipfile.BadZipFile) as error:
        reason = ' '.join(str(error).split())
        raise ArchiveError(f'{path}: cannot be read: {reason}') from error
    if not isinstance(about, dict) or about.pop('format', 0) != version or set(arrays) != names:
        raise ArchiveError(
            f'{path}: not a {kind}, expected a {kind} file of format {version}')
    return arrays, about
