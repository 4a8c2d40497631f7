"""The choice of points that are separate from each other."""

import numpy as np

# Number of points to compare with each other at a time.
_BLOCK = 64
# Number of lists from which their treatment at once is faster than one after the other.
_FEW_LISTS = 4
# Number of points up to which a comparison of all pairs is faster than that with each choice.
_SHORT_LIST = 48


def separate(points: np.ndarray, max_points: int) -> list[int]:
    """Return indices of points that are separate from each other; of close points, the first.

    Points, float64 [N, D], are separate if they are at least 1 apart in some coordinate.
    """
    kept: list[int] = []
    for start in range(0, len(points), _BLOCK):
        block = np.arange(start, min(start + _BLOCK, len(points)))
        if kept:
            block = block[~_close(points[block], points[kept]).any(axis=1)]
        close = _close(points[block], points[block])
        free = np.ones(len(block), bool)
        for row, index in enumerate(block.tolist()):
            if free[row]:
                kept.append(index)
                free &= ~close[row]
        if len(kept) >= max_points:
            break
    return kept[:max_points]


def separate_each(
        points: np.ndarray, valid: np.ndarray, max_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Apply `separate` to each of many lists of points at once.

    Parameters
    ----------
    points
        Float64 [L, N, D].
    valid
        Which points belong to the lists, bool [L, N].

    Returns
    -------
    tuple of numpy.ndarray
        List and index of each chosen point, int [C], list after list.
    """
    if len(points) < _FEW_LISTS:
        own = [np.flatnonzero(row) for row in valid]
        kept = [index[separate(one[index], max_points)]
                for one, index in zip(points, own, strict=True)]
        lists = np.repeat(np.arange(len(kept)), [len(one) for one in kept])
        return lists, np.concatenate(kept or [np.empty(0, int)])
    if points.shape[1] <= _SHORT_LIST:
        return _separate_short(points, valid, max_points)
    free, rows = valid.copy(), np.arange(len(points))
    coordinates = np.ascontiguousarray(np.moveaxis(points, 2, 0))
    chosen = []
    for _ in range(max_points):
        first = free.argmax(axis=1)
        found = free[rows, first]
        if not found.any():
            break
        chosen.append(np.where(found, first, -1))
        close = free
        for coordinate in coordinates:
            close = close & (np.abs(coordinate - coordinate[rows, first][:, None]) < 1)
        free ^= close
        # The distance of a point with an infinite coordinate from itself is undefined.
        free[rows, first] = False
    indices = np.stack(chosen, axis=1) if chosen else np.empty((len(points), 0), int)
    lists, place = np.nonzero(indices >= 0)
    return lists, indices[lists, place]


def _separate_short(
        points: np.ndarray, valid: np.ndarray, max_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Apply `separate_each` to lists of few points, with arrays of all pairs."""
    # Whether a point is close to an earlier one, [L, N, N].
    close = np.tri(points.shape[1], k=-1, dtype=bool) & valid[:, None]
    for coordinate in np.ascontiguousarray(np.moveaxis(points, 2, 0)):
        close &= np.abs(coordinate[:, :, None] - coordinate[:, None]) < 1
    # Each round settles at least one more point, because only earlier ones matter; a few suffice.
    chosen, previous = valid, None
    while previous is None or not np.array_equal(chosen, previous):
        chosen, previous = valid & ~(close & chosen[:, None]).any(axis=2), chosen
    lists, indices = np.nonzero(chosen & (np.cumsum(chosen, axis=1) <= max_points))
    return lists, indices


def _close(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return which points are closer than 1 in all coordinates, bool [N, M]."""
    close = np.ones((len(points), len(others)), bool)
    # A reduction over the coordinates takes several times as long.
    for axis in range(points.shape[1]):
        close &= np.abs(points[:, axis, None] - others[:, axis]) < 1
    return close
