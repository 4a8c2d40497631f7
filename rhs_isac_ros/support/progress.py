"""The progress of a command: a bar on a terminal, or lines in a file."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

# Smallest time between two lines [s].
_LINE_S = 10.0


@contextlib.contextmanager
def progress_bar(total: int, unit: str, *, quiet: bool = False, label: str = ''
                 ) -> Iterator[Callable[..., None] | None]:
    """Yield a function that shows the progress, beside a label, on stderr; None if `quiet`.

    It takes the number of completed units, a text, and the total if this has changed.
    A terminal shows a bar if tqdm is installed. Otherwise, a line appears every ten seconds, as in
    the log of a batch job.
    """
    if quiet:
        yield None
        return
    new_bar: Any = None
    if sys.stderr.isatty():
        with contextlib.suppress(ImportError):
            from tqdm import tqdm
            new_bar = tqdm
    if not new_bar:
        begin_s = line_s = time.monotonic()

        def print_line(number: int, text: str, new_total: int = 0) -> None:
            nonlocal line_s
            now_s = time.monotonic()
            if now_s >= line_s + _LINE_S:
                line_s = now_s
                print(': '.join(filter(None, (
                    label, f'{unit} {number} of {new_total or total}', text,
                    f'{now_s - begin_s:.0f} s'))), file=sys.stderr, flush=True)
        yield print_line
        return
    with new_bar(total=total, unit=unit, mininterval=0.2, desc=label or None) as bar:
        def show(number: int, text: str, new_total: int = 0) -> None:
            bar.total = new_total or total
            if text:
                bar.set_description(text, refresh=False)
            bar.update(number - bar.n)
        yield show
