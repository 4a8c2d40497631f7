"""Products of the radiation matrices with the rows of quadratic forms.

A row is a linear function of one band's line-of-sight gains, such as their derivative with respect
to one coordinate, or their difference between two positions. Its mean is the same function of the
mean signals; `mean_derivative`, Eq. (13), computes it. The objectives are functions of whitened
means, whose computation takes most of their time.
"""

import copy
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario, streams
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
# Minimum number of columns of the first sketch. Each further sketch has twice as many.
_MIN_SKETCH = 128
# Number of rows from which the basis of many rows is found, and the share of the tolerance that
# their error may reach.
_SKETCHED_ROWS = 2048
_SKETCH_MARGIN = 0.8
# Smaller relative errors are lost in the rounding of Gram matrices.
MIN_TOLERANCE = 1e-7


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

    def chosen(self, items: np.ndarray) -> 'CompressedRows':
        """Return the rows of some items, int [n], with coefficients in single precision.

        Products with them take half the time. Their rounding, 6e-8, is far below the relative
        error of the rows.
        """
        rows = copy.copy(self)
        rows.n_items = len(items)
        numbers = (items[:, None] * self._n_rows + np.arange(self._n_rows)).ravel()
        rows.coefficients = [
            coefficients[numbers].astype(np.complex64) for coefficients in self.coefficients]
        return rows

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
        whitened = np.empty((*rows.shape[:2], n_measurements), rows.dtype)
        for (part, _), filters in zip(self._patterns, self._filters[band], strict=True):
            chosen = rows[:, part]
            product = chosen.reshape(-1, chosen.shape[-1]) @ filters.astype(rows.dtype, copy=False)
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
    every = list(blocks(n_items))
    # A basis is found from some of many rows, and accepted if its error for all rows is small.
    used = every[::max(n_items * n_rows // _SKETCHED_ROWS, 1)]
    while True:
        wanted = tolerance if len(used) == len(every) else _SKETCH_MARGIN * tolerance
        n_used = sum(block.stop - block.start for block in used) * n_rows
        basis = _sketch(rows_of, used, min(size, n_used))
        coefficients, norms = _project(rows_of, used, basis)
        keep, error = _leading(coefficients, norms, wanted)
        if error <= wanted or basis.shape[1] < size:
            if len(used) == len(every):
                return coefficients @ keep, basis @ keep
            basis = basis @ keep
            coefficients, norms = _project(rows_of, every, basis)
            if _missing(coefficients, norms) <= tolerance**2:
                return coefficients, basis
            used = every
        else:
            size *= 2


def _project(rows_of: Callable[[slice], np.ndarray], chosen: Sequence[slice],
             basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the rows of some blocks [n, R], and the rows' norms [n]."""
    coefficients, norms = [], []
    for block in chosen:
        rows = rows_of(block)
        coefficients.append(rows @ basis)
        norms.append(np.linalg.norm(rows, axis=1))
    return np.concatenate(coefficients), np.concatenate(norms)


def _leading(coefficients: np.ndarray, norms: np.ndarray,
             tolerance: float) -> tuple[np.ndarray, float]:
    """Directions to keep [S, R], and the error with all of them, in the measure of `tolerance`."""
    relative = coefficients[norms > 0] / norms[norms > 0, None]
    values, vectors = np.linalg.eigh(np.conj(relative.T) @ relative / max(len(relative), 1))
    missing = _missing(coefficients, norms)
    tails = missing + np.concatenate([[0.0], np.cumsum(np.maximum(values, 0.0))])
    cut = int(np.searchsorted(tails, tolerance**2, side='right')) - 1
    return vectors[:, max(cut, 0):], missing**0.5


def _missing(coefficients: np.ndarray, norms: np.ndarray) -> float:
    """Mean square of the part of the rows, of unit length, that lies outside of the basis."""
    lengths = np.linalg.norm(coefficients[norms > 0], axis=1) / norms[norms > 0]
    return max(1.0 - float(np.sum(lengths**2)) / max(len(lengths), 1), 0.0)


def _sketch(
        rows_of: Callable[[slice], np.ndarray], chosen: Sequence[slice], size: int) -> np.ndarray:
    """Orthonormal basis of random combinations of the rows, normalised to unit length."""
    rng = streams.generator(0, streams.SKETCH, size)
    mixtures: np.ndarray = np.zeros(())
    for block in chosen:
        rows = rows_of(block)
        norms = np.linalg.norm(rows, axis=1)
        weights = rng.normal(size=(size, len(rows))) / np.where(norms == 0, 1.0, norms)
        # A real product takes a quarter of the operations of a complex one.
        mixtures = mixtures + weights @ rows.view(float)
    basis: np.ndarray = np.linalg.qr(np.conj(mixtures.view(complex).T))[0]
    return basis
