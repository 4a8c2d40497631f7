"""Rows of quadratic forms in a basis of low rank."""

import functools
from collections.abc import Callable, Sequence

import numpy as np

from rhs_isac_ros.bounds.measurement_rows import (
    PLAIN,
    Evaluation,
    GradientSums,
    Pattern,
    RowSource,
    blocks,
)
from rhs_isac_ros.model import MeasurementModel, Scenario, streams

# Minimum number of columns of the first sketch. Each further sketch has twice as many.
_MIN_SKETCH = 128
# Smaller relative errors are lost in the rounding of Gram matrices.
MIN_TOLERANCE = 1e-7


class CompressedRows:
    """Rows as coefficients in a basis: less memory, and one large matrix product per band.

    Over a region of interest, the rows of all positions and sub-bands span, to a given accuracy,
    far fewer dimensions than there are elements and sub-bands. A randomised range finder with a
    fixed seed finds a basis. `tolerance` is the root mean square of the rows' relative errors.

    Raises
    ------
    ValueError
        If the tolerance is not from `MIN_TOLERANCE` to 1.
    """

    def __init__(self, scenario: Scenario, source: RowSource, n_items: int, n_rows: int,
                 tolerance: float, patterns: Sequence[Pattern] = PLAIN) -> None:
        self.n_items, self._n_rows, self._patterns = n_items, n_rows, patterns
        n_subbands, n_elements = scenario.n_subbands, scenario.n_elements

        def flat_rows(block: slice, band: int) -> np.ndarray:
            # A single item can have another memory layout, of which a view as real numbers fails.
            return np.ascontiguousarray(
                source(block, band).reshape(-1, n_subbands * n_elements))

        self.coefficients: list[np.ndarray] = []
        self.bases: list[np.ndarray] = []
        for band in range(scenario.n_bands):
            coefficients, basis = _compress(
                functools.partial(flat_rows, band=band), n_items, n_rows, tolerance,
                _first_sketch(scenario))
            self.coefficients.append(coefficients)
            self.bases.append(basis.reshape(n_subbands, n_elements, -1))

    @property
    def ranks(self) -> tuple[int, ...]:
        """Dimensions of the basis of each band."""
        return tuple(basis.shape[-1] for basis in self.bases)

    def begin(self, model: MeasurementModel) -> Evaluation:
        """Begin an evaluation with the radiation and whitening matrices of a model."""
        return _CompressedEvaluation(
            self.coefficients, self.bases, self._n_rows, self._patterns, model)


class _CompressedEvaluation:
    """One evaluation of `CompressedRows`, in the basis of each band."""

    def __init__(self, coefficients: Sequence[np.ndarray], bases: Sequence[np.ndarray],
                 n_rows: int, patterns: Sequence[Pattern], model: MeasurementModel) -> None:
        self._coefficients, self._bases, self._n_rows = coefficients, bases, n_rows
        self._patterns, self._whitener = patterns, model.whitener
        # The filters of a pattern include whitening, which therefore costs no time per item.
        self._filters: list[list[np.ndarray]] = []
        for band, (basis, whitener) in enumerate(zip(bases, model.whitener, strict=True)):
            means = _filters(basis, model.radiation[band])
            self._filters.append([
                (means if pattern is None else means * pattern[band]) @ whitener.T
                for _, pattern in patterns])
        self._weights = [[np.zeros_like(one) for one in filters] for filters in self._filters]

    def _rows(self, block: slice, band: int) -> np.ndarray:
        rows = self._coefficients[band][block.start * self._n_rows:block.stop * self._n_rows]
        return rows.reshape(-1, self._n_rows, rows.shape[1])

    def whitened(self, block: slice, band: int) -> np.ndarray:
        rows = self._rows(block, band)
        n_measurements = self._filters[band][0].shape[1]
        whitened = np.empty((*rows.shape[:2], n_measurements), complex)
        for (part, _), filters in zip(self._patterns, self._filters[band], strict=True):
            chosen = rows[:, part]
            product = chosen.reshape(-1, chosen.shape[-1]) @ filters
            whitened[:, part] = product.reshape(*chosen.shape[:2], n_measurements)
        return whitened

    def accumulate(self, block: slice, band: int, weighted: np.ndarray) -> None:
        rows = self._rows(block, band)
        for (part, _), weights in zip(self._patterns, self._weights[band], strict=True):
            chosen, of_part = rows[:, part], weighted[:, part]
            # Accumulate the conjugate, so that the coefficients need not be copied.
            weights += (chosen.reshape(-1, chosen.shape[-1]).T
                        @ np.conj(of_part.reshape(-1, of_part.shape[-1])))

    def sums(self, band: int) -> GradientSums:
        basis, whitener = self._bases[band], self._whitener[band]
        n_subbands, n_elements, _ = basis.shape
        total: np.ndarray = np.zeros(())
        covariance_term = np.zeros_like(whitener)
        for (_, pattern), filters, gathered in zip(
                self._patterns, self._filters[band], self._weights[band], strict=True):
            weights = np.conj(gathered) @ np.conj(whitener)
            covariance_term += weights.T @ np.conj(filters @ np.conj(whitener))
            total = total + (weights if pattern is None else weights * np.conj(pattern[band]))
        frames = np.moveaxis(total.reshape(len(total), n_subbands, -1), 1, 0)
        mean_term = np.swapaxes(np.matmul(basis, frames), 1, 2).reshape(-1, n_elements)
        return GradientSums(mean_term, covariance_term)


def _first_sketch(scenario: Scenario) -> int:
    """Columns of the first sketch: enough for Table I, and more for larger surfaces."""
    return max(_MIN_SKETCH, scenario.n_elements // 2)


def _filters(basis: np.ndarray, radiation: np.ndarray) -> np.ndarray:
    """Means of the vectors of a basis, complex128 [R, N_SB F]."""
    n_subbands, n_elements, rank = basis.shape
    frames = radiation.reshape(n_subbands, -1, n_elements)
    products = np.matmul(frames, np.conj(basis))
    return np.ascontiguousarray(products.reshape(-1, rank).T)


def _compress(rows_of: Callable[[slice], np.ndarray], n_items: int, n_rows: int,
              tolerance: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients [n_items n_rows, R] and an orthonormal basis [N_SB N_E, R] of the rows."""
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
        # Rows have unit length. The part that the coefficients lack lies outside the basis.
        missing = max(1.0 - float(values.sum()), 0.0)
        tails = missing + np.concatenate([[0.0], np.cumsum(np.maximum(values, 0.0))])
        cut = int(np.searchsorted(tails, tolerance**2, side='right')) - 1
        if cut >= 0 or basis.shape[1] < size:
            keep = vectors[:, max(cut, 0):]
            return coefficients @ keep, basis @ keep
        size *= 2


def _sketch(rows_of: Callable[[slice], np.ndarray], n_items: int, n_rows: int,
            size: int) -> np.ndarray:
    """Orthonormal basis of random combinations of the rows, normalised to unit length."""
    rng = streams.generator(0, streams.SKETCH, size)
    mixtures: np.ndarray = np.zeros(())
    for block in blocks(n_items):
        rows = rows_of(block)
        norms = np.linalg.norm(rows, axis=1)
        weights = rng.normal(size=(size, len(rows))) / np.where(norms == 0, 1.0, norms)
        # A real product takes a quarter of the operations of a complex one.
        mixtures = mixtures + weights @ rows.view(float)
    basis: np.ndarray = np.linalg.qr(np.conj(mixtures.view(complex).T))[0]
    return basis
