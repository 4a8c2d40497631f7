"""Files that are there whole or not at all."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_whole(path: str | Path, content: str | bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file aside and rename it: at no time is it there in part.

    Parameters
    ----------
    path
        The file.
    content
        All of it, or a function that writes it to a stream.

    Raises
    ------
    OSError
        If it cannot be written; an old file is kept.
    """
    path = Path(path)
    descriptor, aside = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(descriptor, 'wb') as stream:
            if callable(content):
                content(stream)
            else:
                stream.write(content.encode() if isinstance(content, str) else content)
        os.chmod(aside, 0o644)
        os.replace(aside, path)
    except BaseException:
        os.unlink(aside)
        raise


def check_writable(path: Path) -> None:
    """Raise OSError unless the directory of a file exists and can be written."""
    if not os.access(path.parent, os.W_OK):
        raise OSError(f'{path}: expected a file in a directory that can be written')
