"""Atomic writing of files."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_whole(path: str | Path, content: str | bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file atomically: write a temporary file, then rename it to `path`.

    The content is complete, or a callable that writes it to a binary stream.

    Raises
    ------
    OSError
        If the file cannot be written; an existing file is left as it was.
    """
    path = Path(path)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(descriptor, 'wb') as stream:
            if callable(content):
                content(stream)
            else:
                stream.write(content.encode() if isinstance(content, str) else content)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def check_writable(path: Path) -> None:
    """Raise OSError unless the directory of a file exists and can be written."""
    if not os.access(path.parent, os.W_OK):
        raise OSError(f'{path}: expected a file in a directory that can be written')
