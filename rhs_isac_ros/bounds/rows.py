"""Products of the radiation matrices with the rows of quadratic forms.

A row is a linear function of the line-of-sight gains of one band, such as their derivative with
respect to a coordinate, or their difference between two positions. Its mean is the same function
of the mean signals, as in Eq. (13). Most of the time of an evaluation goes into whitened means.
"""

import copy
import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.support import streams

# Function that long computations call repeatedly; it may raise an exception to end them.
Tick = Callable[[], None]
# Some of the rows, and the factor of their means in each band and measurement, complex128
# [N_B, N_SB F], or None for 1. The slices of all patterns cover all rows.
Pattern = tuple[slice, np.ndarray | None]
PLAIN: Sequence[Pattern] = ((slice(None), None),)
# Items in a block, three times as many if each has one row. Their means fit into the cache.
_BLOCK = 128
# Largest number of complex numbers in the uncompressed rows of a block of several items.
_BLOCK_NUMBERS = 1 << 21
# Memory for exact rows that are kept between evaluations [bytes].
_CACHE_BYTES = 1 << 30
# Largest useful rank. With more basis vectors, a small number of exact rows is as fast.
_MAX_RANK = 192
# Minimum number of columns of the first sketch. The number doubles from sketch to sketch.
_MIN_SKETCH = 128
# Approximate number of rows used to find a basis for many rows, and the share of the tolerance
# that their error may reach.
_SKETCHED_ROWS = 2048
_SKETCH_MARGIN = 0.8
# Smaller relative errors would be lost in the rounding of Gram matrices.
MIN_TOLERANCE = 1e-7


def no_tick() -> None:
    """Do nothing; this is the default `Tick`."""


@dataclasses.dataclass(frozen=True)
class RowSource:
    """G rows of each of n items, computed in blocks."""

    scenario: Scenario
    #: Function of a block of n items and a band; returns rows, complex128 [n, G, N_SB, N_E].
    rows: Callable[[slice, int], np.ndarray]
    n_items: int
    n_rows: int  #: Number G of rows of an item.
    patterns: Sequence[Pattern] = PLAIN
    tick: Tick = no_tick
    block: int = _BLOCK  #: Items of three rows in a block.

    @property
    def width(self) -> int:
        """Number of complex numbers in a row."""
        return self.scenario.n_subbands * self.scenario.n_elements

    def blocks(self) -> list[slice]:
        """Split the items, in order, into blocks, smaller ones if rows are very wide."""
        return _blocks(self.n_items, self.n_rows, self.width, self.block)

    def flat(self, block: slice, band: int) -> np.ndarray:
        """Return the rows of a block, complex128 [n G, N_SB N_E]."""
        self.tick()
        # The memory layout of a single item may not allow a view as real numbers.
        return np.ascontiguousarray(self.rows(block, band).reshape(-1, self.width))


class MeasurementRows:
    """Rows of all items and bands, as coefficients of basis vectors.

    The sub-bands of a band form J groups of S sub-bands: one group with a basis, complex128
    [N_SB, N_E, R], or N_SB groups with None, as the coefficients are the rows, with R = N_E.
    """

    def __init__(self, source: RowSource, n_groups: int, width: int = 0) -> None:
        self.n_items, self.n_rows, self.patterns = source.n_items, source.n_rows, source.patterns
        self.n_groups, self._n_subbands = n_groups, source.scenario.n_subbands
        self._width, self._block = width, source.block
        self.bases: list[np.ndarray | None] = [None] * source.scenario.n_bands

    def blocks(self) -> list[slice]:
        """Split the items, in order, into blocks of a suitable size."""
        return _blocks(self.n_items, self.n_rows, self._width, self._block)

    def in_block(self, block: slice, band: int) -> np.ndarray:
        """Return the coefficients of a block of n items, complex [J, n, G, R]."""
        raise NotImplementedError

    def means(self, band: int, radiation: np.ndarray) -> np.ndarray:
        """Return the means of the basis vectors of a band, complex128 [J, R, S F]."""
        frames = radiation.reshape(self._n_subbands, -1, radiation.shape[-1])
        basis = self.bases[band]
        means = frames if basis is None else np.matmul(frames, np.conj(basis))
        return np.ascontiguousarray(
            np.swapaxes(means.reshape(self.n_groups, -1, means.shape[-1]), 1, 2))

    def sums(self, band: int, weights: np.ndarray) -> np.ndarray:
        """Sum the basis vectors with weights [J, R, S F]; return complex128 [N_SB F, N_E]."""
        frames = np.swapaxes(weights, 1, 2).reshape(self._n_subbands, -1, weights.shape[1])
        basis = self.bases[band]
        sums = frames if basis is None else np.matmul(frames, np.swapaxes(basis, 1, 2))
        return sums.reshape(-1, sums.shape[-1])


class Evaluation:
    """Whitened means for one measurement model, and sums for a gradient, in blocks of items."""

    def __init__(self, rows: MeasurementRows, model: MeasurementModel) -> None:
        self._rows, self._whitener = rows, model.whitener
        # With a single group, the filters include patterns and whitening, which then cost no time
        # per item. With several groups, both are applied after the means are joined.
        self._is_folded = rows.n_groups == 1
        self._patterns = rows.patterns if self._is_folded else PLAIN
        self._filters = [
            [self._filter(rows.means(band, radiation), band, pattern)
             for _, pattern in self._patterns]
            for band, radiation in enumerate(model.radiation)]
        self._weights = [[np.zeros_like(one) for one in filters] for filters in self._filters]
        self._last = [np.empty(0)] * len(self._whitener)
        # Sums of products of weighted whitened means and whitened means.
        self._products = np.zeros_like(self._whitener)

    def _filter(self, means: np.ndarray, band: int, pattern: np.ndarray | None) -> np.ndarray:
        if pattern is not None:
            means = means * pattern[band]
        return np.matmul(means, self._whitener[band].T) if self._is_folded else means

    def whitened(self, block: slice, band: int) -> np.ndarray:
        """Compute the whitened means of a block of n items, complex [n, G, N_SB F]."""
        rows = self._rows.in_block(block, band)
        n_groups, n, n_rows, rank = rows.shape
        means = np.empty((n, n_rows, n_groups, self._filters[band][0].shape[2]), rows.dtype)
        for (part, _), filters in zip(self._patterns, self._filters[band], strict=True):
            chosen = means[:, part]
            product = np.matmul(rows[:, :, part].reshape(n_groups, -1, rank),
                                filters.astype(rows.dtype, copy=False))
            chosen[...] = np.moveaxis(
                product.reshape(n_groups, *chosen.shape[:2], -1), 0, 2)
        whitened = means.reshape(n, n_rows, -1)
        if not self._is_folded:
            for part, pattern in self._rows.patterns:
                if pattern is not None:
                    whitened[:, part] *= pattern[band]
            whitened = self._last[band] = np.matmul(whitened, self._whitener[band].T)
        return whitened

    def accumulate(self, block: slice, band: int, weighted: np.ndarray) -> None:
        """Add a block's weighted whitened means, complex [n, G, N_SB F], to the sums.

        The last call of `whitened` for this band must have been for the same block.
        """
        if not self._is_folded:
            flat, last = (one.reshape(-1, one.shape[2]) for one in (weighted, self._last[band]))
            self._products[band] += flat.T @ np.conj(last)
            weighted = np.matmul(weighted, np.conj(self._whitener[band]))
            for part, pattern in self._rows.patterns:
                if pattern is not None:
                    weighted[:, part] *= np.conj(pattern[band])
        rows = self._rows.in_block(block, band)
        n_groups, n, n_rows, rank = rows.shape
        # Accumulate the conjugate, so that the coefficients need not be copied.
        grouped = np.conj(weighted, dtype=rows.dtype, casting='same_kind').reshape(
            n, n_rows, n_groups, -1)
        for (part, _), weights in zip(self._patterns, self._weights[band], strict=True):
            chosen = rows[:, :, part].reshape(n_groups, -1, rank)
            weights += np.matmul(
                np.swapaxes(chosen, 1, 2),
                np.moveaxis(grouped[:, part], 2, 0).reshape(n_groups, chosen.shape[1], -1))

    def sums(self, band: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of w conj(row) [N_SB F, N_E] and of w zeta^H [N_SB F, N_SB F].

        They include all blocks passed to `accumulate`. Here, zeta is Lambda^-1 times the means,
        and w is Lambda^-1 times the weighted means.
        """
        whitener, products = self._whitener[band], self._products[band]
        total = np.zeros(())
        for (_, pattern), filters, gathered in zip(
                self._patterns, self._filters[band], self._weights[band], strict=True):
            weights = np.conj(gathered)
            if self._is_folded:
                products = products + weights[0].T @ np.conj(filters[0])
                weights = np.matmul(weights, np.conj(whitener))
            if pattern is not None:
                weights = weights * np.conj(pattern[band])
            total = total + weights
        return self._rows.sums(band, total), np.conj(whitener.T) @ products @ whitener


def rows_within(source: RowSource, tolerance: float) -> MeasurementRows:
    """Return rows with a relative error of at most `tolerance`; see `CompressedRows`.

    If the tolerance is 0, the rows are exact. If there are few rows and they would need a large
    basis, they are stored in single precision without compression.
    """
    if tolerance == 0:
        return ExactRows(source)
    if source.n_items * source.n_rows <= _SKETCHED_ROWS and any(
            _rank_of_some(source, tolerance, band) > _MAX_RANK
            for band in range(source.scenario.n_bands)):
        return ExactRows(source, np.complex64)
    return CompressedRows(source, tolerance)


def _rank_of_some(source: RowSource, tolerance: float, band: int) -> int:
    """Return the rank, within a tolerance, of some rows and columns; 0 for a small source."""
    size, n_rows = 2 * _MAX_RANK, source.n_items * source.n_rows
    if n_rows <= size or source.width <= 3 * size:
        return 0
    columns = streams.generator(0, streams.SKETCH, size).permutation(source.width)[:size]
    step = max(n_rows // size, 1)
    some = np.concatenate([
        source.flat(slice(block.start, block.stop, step), band)[:, columns]
        for block in source.blocks()])
    norms = np.linalg.norm(some, axis=1)
    coefficients = some[norms > 0] / norms[norms > 0, None]
    values = np.linalg.eigvalsh(np.conj(coefficients.T) @ coefficients / max(len(some), 1))
    return int(np.sum(np.cumsum(values) > tolerance**2))


class ExactRows(MeasurementRows):
    """Uncompressed rows, kept between evaluations unless they need too much memory."""

    def __init__(
            self, source: RowSource, kind: type[np.complexfloating] = np.complex128) -> None:
        super().__init__(source, source.scenario.n_subbands, source.width)
        self._source, self._kind = source, kind
        n_numbers = source.n_items * source.n_rows * source.scenario.n_bands * source.width
        self._keeps_all = np.dtype(kind).itemsize * n_numbers <= _CACHE_BYTES
        # Beyond the limit, only the current block is kept: an evaluation uses its rows twice.
        self._kept: dict[tuple[int, int], np.ndarray] = {}

    def in_block(self, block: slice, band: int) -> np.ndarray:
        """Return the rows of a block, complex [N_SB, n, G, N_E]."""
        key = block.start, band
        if key not in self._kept:
            self._source.tick()
            if not self._keeps_all and any(start != block.start for start, _ in self._kept):
                self._kept.clear()
            # With sub-bands first, every matrix product reads contiguous memory.
            self._kept[key] = np.ascontiguousarray(
                np.moveaxis(self._source.rows(block, band), 2, 0), self._kind)
        return self._kept[key]


class CompressedRows(MeasurementRows):
    """Rows as coefficients in a basis, which saves memory and allows large matrix products.

    To a given accuracy, the rows of all positions in a region span far fewer dimensions than a row
    has entries. A randomised range finder with a fixed seed finds a basis. `tolerance` limits the
    root mean square of the relative errors of the rows. Raises ValueError if it is less than
    `MIN_TOLERANCE`, or not less than 1.
    """

    def __init__(self, source: RowSource, tolerance: float) -> None:
        super().__init__(source, n_groups=1)
        scenario = source.scenario
        # Enough for Table I, and more for larger surfaces.
        n_columns = max(_MIN_SKETCH, min(scenario.n_elements // 2, _MAX_RANK))
        self.coefficients: list[np.ndarray] = []
        for band in range(scenario.n_bands):
            coefficients, basis = _compress(
                functools.partial(source.flat, band=band), source.blocks(),
                source.n_items * source.n_rows, tolerance, n_columns)
            self.coefficients.append(coefficients)
            self.bases[band] = basis.reshape(scenario.n_subbands, scenario.n_elements, -1)

    def chosen(self, items: np.ndarray) -> 'CompressedRows':
        """Return the rows of some items, int [n], with coefficients in single precision.

        This halves the time of products. The rounding, 6e-8, is less than any valid tolerance.
        """
        rows = copy.copy(self)
        rows.n_items = len(items)
        numbers = (items[:, None] * self.n_rows + np.arange(self.n_rows)).ravel()
        rows.coefficients = [
            coefficients[numbers].astype(np.complex64) for coefficients in self.coefficients]
        return rows

    @property
    def ranks(self) -> tuple[int, ...]:
        """Number of basis vectors in each band."""
        return tuple(coefficients.shape[1] for coefficients in self.coefficients)

    def in_block(self, block: slice, band: int) -> np.ndarray:
        """Return the coefficients of a block, complex [1, n, G, R]."""
        rows = self.coefficients[band][block.start * self.n_rows:block.stop * self.n_rows]
        return rows.reshape(1, -1, self.n_rows, rows.shape[1])


def _blocks(n_items: int, n_rows: int, width: int, block: int) -> list[slice]:
    size = max(3 // n_rows, 1) * block
    size = max(min(size, _BLOCK_NUMBERS // max(n_rows * width, 1)), 1)
    return [slice(start, min(start + size, n_items)) for start in range(0, n_items, size)]


def _compress(rows_of: Callable[[slice], np.ndarray], every: list[slice], n_rows: int,
              tolerance: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows as coefficients [n_rows, R] in an orthonormal basis [N_SB N_E, R]."""
    if not MIN_TOLERANCE <= tolerance < 1:
        raise ValueError(
            f'tolerance: {tolerance:g}, expected {MIN_TOLERANCE:g} to 1, or 0 for exact rows')
    # The basis is found from some rows if there are many, and kept if its error for all is small.
    used = every[::max(n_rows // _SKETCHED_ROWS, 1)]
    while True:
        wanted = tolerance if len(used) == len(every) else _SKETCH_MARGIN * tolerance
        n_used = sum(block.stop - block.start for block in used) * n_rows // every[-1].stop
        basis = _sketch(rows_of, used, min(size, n_used))
        coefficients, relative = _project(rows_of, used, basis)
        keep, error = _leading(relative, wanted)
        if error > wanted and basis.shape[1] == size:
            size *= 2
            continue
        if len(used) == len(every):
            return coefficients @ keep, basis @ keep
        basis = basis @ keep
        coefficients, relative = _project(rows_of, every, basis)
        if _missing(relative) <= tolerance**2:
            return coefficients, basis
        used = every


def _project(rows_of: Callable[[slice], np.ndarray], chosen: Sequence[slice],
             basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients [n, R] of the rows, and of the nonzero rows scaled to unit length."""
    coefficients, norms = [], []
    for block in chosen:
        rows = rows_of(block)
        coefficients.append(rows @ basis)
        norms.append(np.linalg.norm(rows, axis=1))
    whole, lengths = np.concatenate(coefficients), np.concatenate(norms)
    return whole, whole[lengths > 0] / lengths[lengths > 0, None]


def _leading(relative: np.ndarray, tolerance: float) -> tuple[np.ndarray, float]:
    """Return the basis directions to keep [S, R], and the relative error if all were kept."""
    values, vectors = np.linalg.eigh(np.conj(relative.T) @ relative / max(len(relative), 1))
    missing = _missing(relative)
    tails = missing + np.concatenate([[0.0], np.cumsum(np.maximum(values, 0.0))])
    cut = int(np.searchsorted(tails, tolerance**2, side='right')) - 1
    return vectors[:, max(cut, 0):], missing**0.5


def _missing(relative: np.ndarray) -> float:
    """Return the mean square of the part of unit-length rows outside the span of the basis."""
    lengths = np.linalg.norm(relative, axis=1)
    return max(1.0 - float(np.sum(lengths**2)) / max(len(lengths), 1), 0.0)


def _sketch(
        rows_of: Callable[[slice], np.ndarray], chosen: Sequence[slice], size: int) -> np.ndarray:
    """Return an orthonormal basis of random mixtures of rows that are scaled to unit length."""
    rng = streams.generator(0, streams.SKETCH, size)
    mixtures = np.zeros(())
    for block in chosen:
        rows = rows_of(block)
        norms = np.linalg.norm(rows, axis=1)
        weights = rng.normal(size=(size, len(rows))) / np.where(norms == 0, 1.0, norms)
        # A product with real weights takes half as many operations as with complex ones.
        mixtures = mixtures + weights @ rows.view(float)
    return np.linalg.qr(np.conj(mixtures.view(complex).T))[0]
