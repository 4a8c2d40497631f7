"""The progress of a command: a bar on the terminal, or lines if tqdm is not installed."""

import contextlib
import sys
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def progress_bar(total: int, unit: str, *, quiet: bool = False, line_every: int = 1
                 ) -> Iterator[Callable[[int, str], None] | None]:
    """Yield a function that shows the number of completed units and a text; None if `quiet`.

    Without tqdm, the function prints a line every `line_every` units.
    """
    if quiet:
        yield None
        return
    try:
        from tqdm import tqdm
    except ImportError:
        def print_line(number: int, text: str) -> None:
            if number % line_every == 0:
                print(f'{unit} {number}: {text}', file=sys.stderr)
        yield print_line
        return
    is_terminal = sys.stderr.isatty()
    with tqdm(total=total, unit=unit, disable=None if is_terminal else False,
              mininterval=0.2 if is_terminal else 10.0) as bar:
        def show(number: int, text: str) -> None:
            bar.set_description(text, refresh=False)
            bar.update(number - bar.n)
        yield show
