"""Translation of exceptions: each layer raises its own kind, with the place of the error."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def translated(
        caught: type[Exception] | tuple[type[Exception], ...], kind: type[Exception],
        place: object = '') -> Iterator[None]:
    """Convert exceptions in a block to another kind, with `place` (a file or field) as prefix."""
    try:
        yield
    except caught as error:
        raise kind(f'{place}: {error}' if place else str(error)) from None
