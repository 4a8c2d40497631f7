"""Running quartiles of several figures."""

import numpy as np


class RunningQuartiles:
    """Quartiles of the newest rows of figures, exact over a bounded window.

    The window bounds memory and time and lets the quartiles follow a network that changes; up to
    its length they are those of all rows.

    Parameters
    ----------
    n_figures
        Figures of a row.
    window
        Rows that count; older ones are forgotten.

    Raises
    ------
    ValueError
        If a size is not positive.
    """

    def __init__(self, n_figures: int, window: int = 1000) -> None:
        if n_figures < 1 or window < 1:
            raise ValueError(f'n_figures, window: {n_figures}, {window}, expected at least 1 each')
        self._rows = np.empty((window, n_figures))
        self._added = 0

    def __len__(self) -> int:
        """Return how many rows count."""
        return min(self._added, len(self._rows))

    def add(self, row: np.ndarray) -> None:
        """Take a row, in place of the oldest where the window is full.

        Parameters
        ----------
        row
            Figures, float64 [n_figures].

        Raises
        ------
        ValueError
            If the row has another shape or is not finite.
        """
        row = np.asarray(row, dtype=float)
        if row.shape != self._rows.shape[1:] or not np.isfinite(row).all():
            raise ValueError(f'row: {row}, expected {self._rows.shape[1]} finite figures')
        self._rows[self._added % len(self._rows)] = row
        self._added += 1

    def quartiles(self) -> np.ndarray:
        """Return lower quartile, median and upper quartile of each figure.

        Between two rows they are interpolated linearly.

        Returns
        -------
        numpy.ndarray
            Float64 [n_figures, 3].

        Raises
        ------
        ValueError
            If there is no row yet.
        """
        if not len(self):
            raise ValueError('quartiles: no row, expected at least one')
        return np.quantile(self._rows[:len(self)], (0.25, 0.5, 0.75), axis=0).T
