"""Imports of optional libraries, which the extras of the package install."""

import contextlib
from collections.abc import Iterator

# Groups of scripts/setup that install the libraries of extras.
_GROUPS = {'experiments': 'experiments', 'genetic': 'experiments', 'neural': 'experiments',
           'recording': 'recording', 'samples': 'samples', 'touchstone': 'experiments',
           'view': 'view'}


class MissingLibraryError(ImportError):
    """An optional library is not installed."""


@contextlib.contextmanager
def optional_import(purpose: str, extra: str = '') -> Iterator[None]:
    """Replace an ImportError in a block with a MissingLibraryError, which mentions the library.

    The message begins with `purpose`, the task that needs the library. With `extra`, the extra of
    this package that installs the library, the message contains the command to install it.
    """
    try:
        yield
    except ImportError as error:
        library = (error.name or str(error)).partition('.')[0]
        in_clone = f'; in a clone: scripts/setup {_GROUPS[extra]}' if extra in _GROUPS else ''
        hint = f" (pip install 'rhs_isac_ros[{extra}]'{in_clone})" if extra else ''
        raise MissingLibraryError(
            f'{purpose} needs {library}, which is not installed{hint}') from error
