"""Libraries that only experiments need, so that the package works without them."""

import contextlib
from collections.abc import Iterator


class MissingLibraryError(Exception):
    """A library is not installed."""


@contextlib.contextmanager
def needed_for(purpose: str) -> Iterator[None]:
    """Say in plain words what is missing if an import inside fails.

    Parameters
    ----------
    purpose
        What the library is for.

    Yields
    ------
    None
        Nothing.

    Raises
    ------
    MissingLibraryError
        If an import fails.
    """
    try:
        yield
    except ImportError as error:
        raise MissingLibraryError(
            f'{purpose} needs {error.name}, which is not installed (pip install {error.name})'
        ) from error
