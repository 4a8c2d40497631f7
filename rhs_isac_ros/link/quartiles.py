"""Running quartiles of several values."""

import numpy as np


class RunningQuartiles:
    """Quartiles of the newest rows of values, exact over a bounded window.

    The window bounds memory and time, and lets the quartiles follow a changing network.
    A row has `n_values` values; rows older than the last `window` are discarded.

    Raises
    ------
    ValueError
        If a size is not positive.
    """

    def __init__(self, n_values: int, window: int = 1000) -> None:
        if n_values < 1 or window < 1:
            raise ValueError(f'n_values, window: {n_values}, {window}, expected at least 1 each')
        self._rows = np.empty((window, n_values))
        self._n_added = 0

    def __len__(self) -> int:
        """Return the number of rows in the window."""
        return min(self._n_added, len(self._rows))

    def add(self, row: np.ndarray) -> None:
        """Add a row, float64 [n_values]; it replaces the oldest one if the window is full.

        Raises
        ------
        ValueError
            If the row has another shape or is not finite.
        """
        row = np.asarray(row, dtype=float)
        if row.shape != self._rows.shape[1:] or not np.isfinite(row).all():
            raise ValueError(f'row: {row}, expected {self._rows.shape[1]} finite values')
        self._rows[self._n_added % len(self._rows)] = row
        self._n_added += 1

    def quartiles(self) -> np.ndarray:
        """Return lower quartile, median and upper quartile of each value, float64 [n_values, 3].

        Quartiles between two rows are interpolated linearly.

        Raises
        ------
        ValueError
            If no row has been added yet.
        """
        if not len(self):
            raise ValueError('quartiles: no rows, expected at least one')
        result: np.ndarray = np.quantile(self._rows[:len(self)], (0.25, 0.5, 0.75), axis=0).T
        return result
