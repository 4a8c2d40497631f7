"""Products of the radiation matrices with the rows of quadratic forms.

A row is a linear function of one band's line-of-sight gains, such as their derivative with respect
to one coordinate, or their difference between two positions. Its mean is the same function of the
mean signals; `mean_derivative`, Eq. (13), computes it. The objectives are functions of whitened
means, whose computation takes most of their time.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.measurement import mean_derivative

# Callable that takes (block of n items, band) and returns the items' rows, complex128
# [n, G, N_SB, N_E].
RowSource = Callable[[slice, int], np.ndarray]
# Rows and the factor of their means in each band and measurement, complex128 [N_B, N_SB F]; None
# for 1. Together, the slices cover all rows.
Pattern = tuple[slice, np.ndarray | None]
PLAIN: Sequence[Pattern] = ((slice(None), None),)
# Items of three rows per block: the arrays of a block fit into the cache.
_BLOCK = 128
# Memory for exact rows that are kept between evaluations.
_CACHE_BYTES = 1 << 30


class GradientSums(NamedTuple):
    """Sums over all items from which the gradients of one band are computed.

    Here, zeta is Lambda^-1 times the means, and w is Lambda^-1 times the weighted means.

    Attributes
    ----------
    mean_term
        Sum of w conj(row), complex128 [N_SB F, N_E].
    covariance_term
        Sum of w zeta^H, complex128 [N_SB F, N_SB F].
    """

    mean_term: np.ndarray
    covariance_term: np.ndarray


class Evaluation(Protocol):
    """Whitened means for one measurement model and the sums for its gradient, in blocks."""

    def whitened(self, block: slice, band: int) -> np.ndarray:
        """Compute the whitened means of a block of n items, complex128 [n, G, N_SB F]."""
        ...

    def accumulate(self, block: slice, band: int, weighted: np.ndarray) -> None:
        """Add a block's weighted whitened means, complex128 [n, G, N_SB F], to the sums.

        The last call of `whitened` for this band must have been for the same block.
        """
        ...

    def sums(self, band: int) -> GradientSums:
        """Return the sums over the blocks that were accumulated."""
        ...


class MeasurementRows(Protocol):
    """Rows of all items and bands."""

    n_items: int

    def begin(self, model: MeasurementModel) -> Evaluation:
        """Begin an evaluation with the radiation and whitening matrices of a model."""
        ...


class ExactRows:
    """Rows without approximation, kept between evaluations if they fit within the memory limit."""

    def __init__(
            self, scenario: Scenario, source: RowSource, n_items: int, n_rows: int,
            patterns: Sequence[Pattern] = PLAIN) -> None:
        self.n_items, self._source, self.patterns = n_items, source, patterns
        size = 16 * n_items * n_rows * scenario.n_bands * scenario.n_subbands * scenario.n_elements
        self._keeps_all = size <= _CACHE_BYTES
        # Beyond the limit, only the current block is kept: an evaluation uses its rows twice.
        self._kept: dict[tuple[int, int], np.ndarray] = {}

    def begin(self, model: MeasurementModel) -> Evaluation:
        """Begin an evaluation with the radiation and whitening matrices of a model."""
        return _ExactEvaluation(self, model)

    def rows(self, block: slice, band: int) -> np.ndarray:
        """Return the rows of a block, complex128 [n, G, N_SB, N_E], sub-bands first in memory."""
        key = block.start, band
        if key not in self._kept:
            if not self._keeps_all and any(start != block.start for start, _ in self._kept):
                self._kept.clear()
            rows = self._source(block, band)
            # With sub-bands first, every matrix product reads contiguous memory.
            rows = np.moveaxis(np.ascontiguousarray(np.moveaxis(rows, 2, 0)), 0, 2)
            self._kept[key] = rows
        return self._kept[key]


class _ExactEvaluation:
    """One evaluation of `ExactRows`; keeps the whitened means of the last block."""

    def __init__(self, rows: ExactRows, model: MeasurementModel) -> None:
        self._rows, self._radiation, self._whitener = rows, model.radiation, model.whitener
        self._mean_term = np.zeros_like(self._radiation)
        self._covariance_term = np.zeros_like(self._whitener)
        self._last: list[np.ndarray] = [np.empty(0)] * len(self._radiation)

    def whitened(self, block: slice, band: int) -> np.ndarray:
        means = mean_derivative(self._rows.rows(block, band), self._radiation[band])
        for rows, pattern in self._rows.patterns:
            if pattern is not None:
                means[:, rows] *= pattern[band]
        self._last[band] = means @ self._whitener[band].T
        return self._last[band]

    def accumulate(self, block: slice, band: int, weighted: np.ndarray) -> None:
        whitener = self._whitener[band]
        n_measurements = len(whitener)
        zeta = self._last[band].reshape(-1, n_measurements) @ np.conj(whitener)
        weights = weighted.reshape(-1, n_measurements) @ np.conj(whitener)
        self._covariance_term[band] += weights.T @ np.conj(zeta)
        rows = self._rows.rows(block, band)
        n, n_rows, n_subbands, n_elements = rows.shape
        for part, pattern in self._rows.patterns:
            if pattern is not None:
                weights.reshape(n, n_rows, -1)[:, part] *= np.conj(pattern[band])
        stacked = np.moveaxis(rows, 2, 0).reshape(n_subbands, n * n_rows, n_elements)
        weights = np.conj(weights).reshape(n * n_rows, n_subbands, -1).transpose(1, 2, 0)
        self._mean_term[band] += np.conj(np.matmul(weights, stacked)).reshape(-1, n_elements)

    def sums(self, band: int) -> GradientSums:
        return GradientSums(self._mean_term[band], self._covariance_term[band])


def blocks(n_items: int, n_rows: int = 3) -> Iterator[slice]:
    """Split items of `n_rows` rows each, in order, into blocks that fit into the cache."""
    size = max(3 // n_rows, 1) * _BLOCK
    for start in range(0, n_items, size):
        yield slice(start, min(start + size, n_items))
