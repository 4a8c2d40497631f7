"""Imports of optional libraries, which the extras of the package install."""

import contextlib
from collections.abc import Iterator


class MissingLibraryError(ImportError):
    """An optional library is not installed."""


@contextlib.contextmanager
def optional_import(purpose: str, extra: str = '', script: str = '') -> Iterator[None]:
    """Replace an ImportError inside the block by a MissingLibraryError with instructions.

    `purpose`, the task that needs the library, is the beginning of the message. `extra` is the
    extra of this package that installs the library, and `script` installs it in a clone.
    """
    try:
        yield
    except ImportError as error:
        library = (error.name or str(error)).partition('.')[0]
        in_clone = f'; in a clone: {script}' if script else ''
        hint = f" (pip install 'rhs_isac_ros[{extra}]'{in_clone})" if extra else ''
        raise MissingLibraryError(
            f'{purpose} needs {library}, which is not installed{hint}') from error
