"""Statistics of trials as text."""

from collections.abc import Sequence

import numpy as np


def mean_and_std(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation of a sample.

    The mean is infinite if a value is. The deviation is NaN if it is undefined: for a single
    value, or an infinite mean.
    """
    mean = float(np.mean(values))
    if len(values) < 2 or not np.isfinite(mean):
        return mean, float('nan')
    return mean, float(np.std(values, ddof=1))


def plus_minus(mean: float, std: float, digits: int = 3) -> str:
    """Format a mean, to some significant digits, and its deviation to the same decimal place.

    A deviation of NaN is omitted.
    """
    if not np.isfinite(mean):
        return str(mean)
    magnitude = int(np.floor(np.log10(abs(mean)))) if mean else 0
    places = max(digits - 1 - magnitude, 0)
    return f'{mean:.{places}f}' + ('' if np.isnan(std) else f' ± {std:.{places}f}')


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table with aligned columns, the first to the left, others to the right.

    Each row is as long as the header.
    """
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ['-' * widths[0], *('-' * (width - 1) + ':' for width in widths[1:])]
    lines = [
        [entry.ljust(width) if column == 0 else entry.rjust(width)
         for column, (entry, width) in enumerate(zip(row, widths, strict=True))]
        for row in (header, rule, *rows)]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)
