"""Rows of a quadratic form in a basis of low rank."""

from collections.abc import Callable, Sequence

import numpy as np

from rhs_isac_ros.bounds.rows import GradientSums, Pass, RowSource, blocks
from rhs_isac_ros.model import Scenario, streams

# Least columns of the first sketch; each next one has twice as many.
_SKETCH = 128
# Gram matrices resolve no smaller relative error.
MIN_TOLERANCE = 1e-7


class CompressedRows:
    """Rows as coefficients in a basis: fewer numbers, and one large product a band.

    Over a region of interest the rows of all positions and sub-bands span, to a given accuracy,
    far fewer dimensions than there are elements and sub-bands. A randomised range finder with a
    fixed seed finds them.

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
    tolerance
        Root mean square of the rows' relative errors, from `MIN_TOLERANCE` to 1.

    Attributes
    ----------
    ranks
        Dimensions of the basis of each band.
    """

    def __init__(self, scenario: Scenario, source: RowSource, n_items: int, n_rows: int,
                 tolerance: float) -> None:
        self.n_items, self._n_rows = n_items, n_rows
        self._shape = scenario.n_subbands, scenario.n_elements
        self.coefficients, self.bases = [], []
        for band in range(scenario.n_bands):
            coefficients, basis = _compress(
                lambda block, band=band: source(block.start, block.stop, band).reshape(
                    -1, scenario.n_subbands * scenario.n_elements),
                n_items, n_rows, tolerance, _first_sketch(scenario))
            self.coefficients.append(coefficients)
            self.bases.append(basis.reshape(*self._shape, -1))

    @property
    def ranks(self) -> tuple[int, ...]:
        """Dimensions of the basis of each band."""
        return tuple(basis.shape[-1] for basis in self.bases)

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
        return _CompressedPass(self.coefficients, self.bases, self._n_rows, patterns, whiteners)


class _CompressedPass:
    """One evaluation with coefficients."""

    def __init__(self, coefficients: Sequence[np.ndarray], bases: Sequence[np.ndarray],
                 n_rows: int, patterns: np.ndarray, whiteners: np.ndarray) -> None:
        self._coefficients, self._bases, self._n_rows = coefficients, bases, n_rows
        self._whiteners = whiteners
        # Whitening is part of the filters: it costs nothing per item.
        self._filters = [
            _filters(basis, pattern) @ whitener.T
            for basis, pattern, whitener in zip(bases, patterns, whiteners, strict=True)]
        self._weights = [np.zeros_like(filters) for filters in self._filters]

    def _rows(self, block: slice, band: int) -> np.ndarray:
        return self._coefficients[band][block.start * self._n_rows:block.stop * self._n_rows]

    def whitened(self, block: slice, band: int) -> np.ndarray:
        whitened = self._rows(block, band) @ self._filters[band]
        return whitened.reshape(-1, self._n_rows, whitened.shape[1])

    def collect(self, block: slice, band: int, weighted: np.ndarray) -> None:
        weighted = weighted.reshape(-1, weighted.shape[-1])
        # The conjugate of what is wanted: coefficients stay as they lie in memory.
        self._weights[band] += self._rows(block, band).T @ np.conj(weighted)

    def collected(self, band: int) -> GradientSums:
        basis, whitener = self._bases[band], self._whiteners[band]
        n_subbands, n_elements, _ = basis.shape
        weights = np.conj(self._weights[band]) @ np.conj(whitener)
        zeta = self._filters[band] @ np.conj(whitener)
        frames = np.moveaxis(weights.reshape(len(weights), n_subbands, -1), 1, 0)
        by_mean = np.matmul(basis, frames)
        return GradientSums(np.swapaxes(by_mean, 1, 2).reshape(-1, n_elements),
                         weights.T @ np.conj(zeta))


def _first_sketch(scenario: Scenario) -> int:
    """Columns of the first sketch: about what Table I needs, and larger surfaces accordingly."""
    return max(_SKETCH, scenario.n_elements // 2)


def _filters(basis: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """What a pattern makes of the vectors of a basis: [R, N_SB F]."""
    n_subbands, n_elements, rank = basis.shape
    frames = pattern.reshape(n_subbands, -1, n_elements)
    products = np.matmul(frames, np.conj(basis))
    return np.ascontiguousarray(products.reshape(-1, rank).T)


def _compress(rows_of: Callable[[slice], np.ndarray], n_items: int, n_rows: int,
              tolerance: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients [n_items n_rows, R] and an orthonormal basis [N_SB N_E, R] of some rows."""
    if not MIN_TOLERANCE <= tolerance < 1:
        raise ValueError(
            f'tolerance: {tolerance:g}, expected {MIN_TOLERANCE:g} to 1, or 0 for exact rows')
    total = n_items * n_rows
    while True:
        basis = _sketch(rows_of, n_items, n_rows, min(size, total))
        coefficients = np.empty((total, basis.shape[1]), complex)
        norms = np.empty(total)
        for block in blocks(n_items):
            rows = rows_of(block)
            part = slice(block.start * n_rows, block.stop * n_rows)
            norms[part] = np.linalg.norm(rows, axis=1)
            coefficients[part] = rows @ basis
        relative = coefficients[norms > 0] / norms[norms > 0, None]
        values, vectors = np.linalg.eigh(np.conj(relative.T) @ relative / max(len(relative), 1))
        # Rows have unit length: what the coefficients lack of it lies outside of the basis.
        missing = max(1.0 - float(values.sum()), 0.0)
        tails = missing + np.concatenate([[0.0], np.cumsum(np.maximum(values, 0.0))])
        cut = int(np.searchsorted(tails, tolerance**2, side='right')) - 1
        if cut >= 0 or basis.shape[1] < size:
            keep = vectors[:, max(cut, 0):]
            return coefficients @ keep, basis @ keep
        size *= 2


def _sketch(rows_of: Callable[[slice], np.ndarray], n_items: int, n_rows: int,
            size: int) -> np.ndarray:
    """Orthonormal basis of random mixtures of the rows, each of which counts by its direction."""
    rng = streams.generator(0, streams.SKETCH, size)
    mixtures: np.ndarray | float = 0.0
    for block in blocks(n_items):
        rows = rows_of(block)
        norms = np.linalg.norm(rows, axis=1)
        weights = rng.normal(size=(size, len(rows))) / np.where(norms == 0, 1.0, norms)
        # A real product: a quarter of the work of a complex one.
        mixtures = mixtures + weights @ rows.view(float)
    return np.linalg.qr(np.conj(mixtures.view(complex).T))[0]
