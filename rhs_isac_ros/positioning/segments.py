"""Arrays whose rows belong together: rows of several arrays, and consecutive rows of a segment."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar

import numpy as np

# A named tuple of arrays with equal first dimensions.
_Rows = TypeVar('_Rows', bound=tuple[np.ndarray, ...])


def select(rows: _Rows, chosen: Any) -> _Rows:
    """Select rows of a named tuple of arrays by a slice, by their indices or by a mask."""
    kind: Any = type(rows)
    if isinstance(chosen, slice):
        return kind._make([field[chosen] for field in rows])
    # This is several times as fast as an index of an array with several dimensions.
    chosen = np.asarray(chosen)
    places = chosen.nonzero()[0] if chosen.dtype == bool else chosen
    return kind._make([field.take(places, axis=0) for field in rows])


def concatenate(*parts: _Rows) -> _Rows:
    """Concatenate the fields of named tuples of arrays."""
    kind: Any = type(parts[0])
    if len(parts) == 1:
        return parts[0]
    return kind._make(map(np.concatenate, zip(*parts, strict=True)))


class Segments(NamedTuple):
    """A division of M rows into N segments of consecutive rows, such as the points of each shot.

    `sum`, `max` and `first` require that no segment is empty.
    """

    starts: np.ndarray  # Index of the first row of each segment, int [N].
    counts: np.ndarray  # Number of rows in each segment, int [N].

    @classmethod
    def of_counts(cls, counts: np.ndarray) -> 'Segments':
        """Return segments with these numbers of rows, int [N]."""
        return cls(np.cumsum(counts) - counts, counts)

    @classmethod
    def of_keys(cls, keys: np.ndarray) -> 'Segments':
        """Return the segments of rows with equal keys [M], which are in ascending order."""
        is_edge = np.ones(len(keys) + 1, bool)
        np.not_equal(keys[1:], keys[:-1], out=is_edge[1:-1])
        (edges,) = is_edge.nonzero()
        return cls(edges[:-1], edges[1:] - edges[:-1])

    @classmethod
    def as_long_as(cls, fits: Callable[[int, int], bool], n: int) -> 'Segments':
        """Divide n rows into segments from a start to an end, each as long as `fits` allows.

        A segment has at least one row.
        """
        starts = [0] if n else []
        for end in range(2, n + 1):
            if not fits(starts[-1], end):
                starts.append(end - 1)
        return cls(np.array(starts, int), np.diff(starts, append=n).astype(int))

    @property
    def ends(self) -> np.ndarray:
        """Index after the last row of each segment, int [N]."""
        return self.starts + self.counts

    @property
    def slices(self) -> Iterator[slice]:
        """The rows of each segment."""
        return map(slice, self.starts.tolist(), self.ends.tolist())

    @property
    def places(self) -> np.ndarray:
        """Number of rows before each row in its segment, int [M]."""
        return np.arange(int(self.counts.sum())) - self.repeat(self.starts)

    def sum(self, values: np.ndarray) -> np.ndarray:
        """Add up values of the rows, [M, ...], in each segment, [N, ...]."""
        return np.add.reduceat(values, self.starts)

    def max(self, values: np.ndarray) -> np.ndarray:
        """Return the largest value [M] in each segment, [N]."""
        return np.maximum.reduceat(values, self.starts)

    def first(self, values: np.ndarray) -> np.ndarray:
        """Return the value of the first row of each segment, [N, ...]."""
        return values[self.starts]

    def repeat(self, values: np.ndarray) -> np.ndarray:
        """Repeat a value of each segment, [N, ...], for each of its rows, [M, ...]."""
        return values.repeat(self.counts, axis=0)
