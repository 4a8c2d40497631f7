"""Translation of exceptions: each layer raises its own kind, with the place of the error."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def translated(
        caught: type[Exception] | tuple[type[Exception], ...], kind: type[Exception],
        place: object = '') -> Iterator[None]:
    """Raise exceptions of the block as another kind, after the name of a file or a field."""
    try:
        yield
    except caught as error:
        raise kind(f'{place}: {error}' if place else str(error)) from None
