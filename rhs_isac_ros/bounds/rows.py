"""Products with the rows that make up a quadratic form.

A row is what multiplies a beam pattern: the derivative of the line-of-sight gains of one position
by one coordinate, or the difference of the gains of two positions. The forms of all bounds are
sums of products of whitened rows, and this is where their time goes.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import mean_derivative

# Function of (start, stop, band): rows of these items, complex128 [n, G, N_SB, N_E].
RowSource = Callable[[int, int, int], np.ndarray]
# Items a block of products: what a block needs fits the cache.
_BLOCK = 128
# Memory that exact rows may keep between evaluations.
_CACHE_BYTES = 1 << 30


class GradientSums(NamedTuple):
    """What an evaluation leaves for the gradients of one band.

    Attributes
    ----------
    by_mean
        Sum of w conj(row), complex128 [N_SB F, N_E], with w = Lambda^-1 times the weighted means.
    spread
        Sum of w zeta^H, complex128 [N_SB F, N_SB F], with zeta = Lambda^-1 times the means.
    """

    by_mean: np.ndarray
    spread: np.ndarray


class Pass(Protocol):
    """One evaluation: whitened means block after block, then what their weights collect."""

    def whitened(self, block: slice, band: int) -> np.ndarray:
        """Return the whitened means of a block.

        Parameters
        ----------
        block
            Items.
        band
            Index of the band, from 0.

        Returns
        -------
        numpy.ndarray
            Complex128 [n, G, N_SB F].
        """
        ...

    def collect(self, block: slice, band: int, weighted: np.ndarray) -> None:
        """Add a block's part, after `whitened` of all bands of the same block.

        Parameters
        ----------
        block
            Items.
        band
            Index of the band, from 0.
        weighted
            Weighted whitened means, complex128 [n, G, N_SB F].
        """
        ...

    def collected(self, band: int) -> GradientSums:
        """Return what was collected.

        Parameters
        ----------
        band
            Index of the band, from 0.

        Returns
        -------
        GradientSums
            The sums over all blocks.
        """
        ...


class Rows(Protocol):
    """Rows of all items and bands.

    Attributes
    ----------
    n_items
        How many items there are.
    """

    n_items: int

    def begin(self, patterns: np.ndarray, whiteners: np.ndarray) -> Pass:
        """Begin an evaluation.

        Parameters
        ----------
        patterns
            T_i, complex128 [N_B, N_SB F, N_E].
        whiteners
            L_i^-1, complex128 [N_B, N_SB F, N_SB F].

        Returns
        -------
        Pass
            The evaluation.
        """
        ...


class ExactRows:
    """Rows as they are; kept between evaluations as long as they take little memory.

    Parameters
    ----------
    scenario
        The scenario.
    source
        Gives the rows.
    n_items
        How many items there are.
    n_rows
        Rows an item, G.
    """

    def __init__(
            self, scenario: Scenario, source: RowSource, n_items: int, n_rows: int) -> None:
        self.n_items, self._source = n_items, source
        size = 16 * n_items * n_rows * scenario.n_bands * scenario.n_subbands * scenario.n_elements
        self._keep = size <= _CACHE_BYTES
        # Without room for all, those of the last block: an evaluation asks twice for them.
        self._kept: dict[tuple[int, int], np.ndarray] = {}

    def begin(self, patterns: np.ndarray, whiteners: np.ndarray) -> Pass:
        """Begin an evaluation.

        Parameters
        ----------
        patterns
            T_i, complex128 [N_B, N_SB F, N_E].
        whiteners
            L_i^-1, complex128 [N_B, N_SB F, N_SB F].

        Returns
        -------
        Pass
            The evaluation.
        """
        return _ExactPass(self, patterns, whiteners)

    def of(self, block: slice, band: int) -> np.ndarray:
        """Return the rows of a block.

        Parameters
        ----------
        block
            Items.
        band
            Index of the band, from 0.

        Returns
        -------
        numpy.ndarray
            Complex128 [n, G, N_SB, N_E], in memory with the sub-bands first.
        """
        key = block.start, band
        if key not in self._kept:
            if not self._keep and any(start != block.start for start, _ in self._kept):
                self._kept.clear()
            rows = self._source(block.start, block.stop, band)
            # Sub-bands first in memory, so that every matrix product reads one run of it.
            rows = np.moveaxis(np.ascontiguousarray(np.moveaxis(rows, 2, 0)), 0, 2)
            self._kept[key] = rows
        return self._kept[key]


class _ExactPass:
    """One evaluation with exact rows."""

    def __init__(self, rows: ExactRows, patterns: np.ndarray, whiteners: np.ndarray) -> None:
        self._rows, self._patterns, self._whiteners = rows, patterns, whiteners
        self._by_mean, self._spread = np.zeros_like(patterns), np.zeros_like(whiteners)
        self._last: list[np.ndarray] = [np.empty(0)] * len(patterns)

    def whitened(self, block: slice, band: int) -> np.ndarray:
        means = mean_derivative(self._rows.of(block, band), self._patterns[band])
        self._last[band] = means @ self._whiteners[band].T
        return self._last[band]

    def collect(self, block: slice, band: int, weighted: np.ndarray) -> None:
        whitener = self._whiteners[band]
        n_measurements = len(whitener)
        zeta = self._last[band].reshape(-1, n_measurements) @ np.conj(whitener)
        weights = weighted.reshape(-1, n_measurements) @ np.conj(whitener)
        self._spread[band] += weights.T @ np.conj(zeta)
        rows = self._rows.of(block, band)
        n, n_rows, n_subbands, n_elements = rows.shape
        stacked = np.moveaxis(rows, 2, 0).reshape(n_subbands, n * n_rows, n_elements)
        weights = np.conj(weights).reshape(n * n_rows, n_subbands, -1).transpose(1, 2, 0)
        self._by_mean[band] += np.conj(np.matmul(weights, stacked)).reshape(-1, n_elements)

    def collected(self, band: int) -> GradientSums:
        return GradientSums(self._by_mean[band], self._spread[band])


def blocks(n_items: int) -> Iterator[slice]:
    """Split items into blocks that fit the cache.

    Parameters
    ----------
    n_items
        How many items there are.

    Returns
    -------
    Iterator of slice
        All items, in their order.
    """
    for start in range(0, n_items, _BLOCK):
        yield slice(start, min(start + _BLOCK, n_items))
