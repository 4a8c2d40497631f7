"""Atomic writing of files."""

import contextlib
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
    """Raise OSError unless a file can be written, without writing it.

    Devices are refused because `write_whole` would replace them by a file.
    """
    if path.is_dir():
        raise IsADirectoryError(f'{path}: a directory, expected a file')
    if path.exists() and not path.is_file():
        raise OSError(f'{path}: expected a regular file')
    try:
        # Permissions do not show whether the file system is read-only.
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError:
        raise OSError(f'{path}: expected a file in a directory that exists and can be '
                      'written') from None
    # The name of the temporary file is longer and may exceed the limit of the file system.
    with contextlib.suppress(FileNotFoundError):
        os.lstat(path.parent / f'.{path.name}.{"x" * 8}')
