"""Figures over trials, as people read them."""

from collections.abc import Sequence

import numpy as np


def mean_and_std(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation of a sample.

    Parameters
    ----------
    values
        The sample.

    Returns
    -------
    tuple of float
        The mean, infinite if a value is; and the deviation, NaN where there is none: of one
        value, or around an infinite mean.
    """
    mean = float(np.mean(values))
    if len(values) < 2 or not np.isfinite(mean):
        return mean, float('nan')
    return mean, float(np.std(values, ddof=1))


def plus_minus(mean: float, std: float, digits: int = 3) -> str:
    """Write a mean and its standard deviation.

    Parameters
    ----------
    mean, std
        What to write; a deviation of NaN is left out.
    digits
        Significant digits of the mean.

    Returns
    -------
    str
        Both, to the same decimal place.
    """
    if not np.isfinite(mean):
        return str(mean)
    magnitude = int(np.floor(np.log10(abs(mean)))) if mean else 0
    places = max(digits - 1 - magnitude, 0)
    return f'{mean:.{places}f}' + ('' if np.isnan(std) else f' ± {std:.{places}f}')


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out a table that is legible as it is, too.

    Parameters
    ----------
    header
        Titles of the columns.
    rows
        Entries, each row as long as the header.

    Returns
    -------
    str
        Lines of Markdown; the columns after the first are flush right.
    """
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ['-' * widths[0], *('-' * (width - 1) + ':' for width in widths[1:])]
    lines = [
        [entry.ljust(width) if column == 0 else entry.rjust(width)
         for column, (entry, width) in enumerate(zip(row, widths, strict=True))]
        for row in (header, rule, *rows)]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)
