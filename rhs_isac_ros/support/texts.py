"""Texts for people: tables for a terminal and in Markdown, lists, and numbers of things."""

import itertools
from collections.abc import Iterable, Sequence

# Maximum number of things that a text lists.
MAX_LISTED = 8


def text_table(heads: Sequence[str], rows: Iterable[Sequence[str]], align: str) -> str:
    """Return a text table; heads may have line breaks; `align` has a ``<`` or ``>`` per column."""
    lines = itertools.zip_longest(*(head.split('\n') for head in heads), fillvalue='')
    return '\n'.join('  '.join(line).rstrip() for line in _aligned([*lines, *rows], align))


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table: the first column is left-aligned, the others right-aligned."""
    head, *others = _aligned([header, *rows], '<' + '>' * (len(header) - 1))
    rule = ['-' * len(head[0]), *('-' * (len(cell) - 1) + ':' for cell in head[1:])]
    return '\n'.join(f'| {" | ".join(line)} |' for line in (head, rule, *others))


def _aligned(lines: Sequence[Sequence[str]], align: str) -> list[list[str]]:
    """Return lines of cells, padded to the width of their columns."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [[f'{cell:{side}{width}}' for cell, side, width in zip(
        line, align, widths, strict=True)] for line in lines]


def counted(number: int, thing: str) -> str:
    """Return a number of things, such as ``1 user`` or ``2 users``."""
    return f'{number} {thing}{"s" * (number != 1)}'


def listed(things: Iterable[object]) -> str:
    """Return things as text, such as ``1, 2``; after `MAX_LISTED`, only count the others."""
    names = list(map(str, things))
    n_others = len(names) - MAX_LISTED
    others = f' and {counted(n_others, "other")}' if n_others > 0 else ''
    return f'{", ".join(names[:MAX_LISTED])}{others}'
