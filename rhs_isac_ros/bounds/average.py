"""Averages of losses that depend on a codebook through quadratic forms, with gradients."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds.compressed_rows import CompressedRows
from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.bounds.measurement_rows import (
    PLAIN,
    Evaluation,
    ExactRows,
    MeasurementRows,
    Pattern,
    RowSource,
    blocks,
)
from rhs_isac_ros.bounds.quadratic_gradient import quadratic_gradients
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.surface import Beamforming
from rhs_isac_ros.model.surface_estimate import SurfaceEstimate
from rhs_isac_ros.model.threads import one_blas_thread

# Callable that takes a block of n items and their forms, float64 [n, G, G], and returns the losses
# [n] and their negative derivatives with respect to the forms, float64 [n, G, G].
Loss = Callable[[slice, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Gradient(NamedTuple):
    """An average with its gradients.

    Attributes
    ----------
    by_analog
        Derivative with respect to C, float64 [N_B, F, N_E].
    by_digital
        d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K].
    """

    value: float
    by_analog: np.ndarray
    by_digital: np.ndarray


class Combination(NamedTuple):
    """Rows of a quadratic form, each a multiple of one of the rows of the source.

    Attributes
    ----------
    sources
        Index of the source's row, int [G].
    scale
        Factor of the row in each band, complex128 [N_B, G].
    """

    sources: np.ndarray
    scale: np.ndarray

    def forward(self, band: int, whitened: np.ndarray) -> np.ndarray:
        """Return the rows, complex128 [n, G, R], from those of the source, [n, S, R]."""
        rows: np.ndarray = whitened[:, self.sources] * self.scale[band, :, None]
        return rows

    def backward(self, band: int, weighted: np.ndarray, n_rows: int) -> np.ndarray:
        """Return derivatives with respect to the source's rows, [n, S, R], from [n, G, R]."""
        gathered = np.zeros((len(weighted), n_rows, weighted.shape[2]), complex)
        for row, (source, scale) in enumerate(zip(self.sources, self.scale[band], strict=True)):
            gathered[:, source] += np.conj(scale) * weighted[:, row]
        return gathered


class Average:
    """Mean loss of items, each of which depends on a codebook through a quadratic form.

    The form of an item is 2 Re sum_i D_i^H Lambda_i^-1 D_i, where the G = `n_rows` columns of D_i
    are the means of the item's rows. With derivatives as rows it is the Fisher information; with
    differences, it is twice the squared distance of two mean signals.

    Parameters
    ----------
    tolerance
        Relative error of the rows, see `CompressedRows`; 0 selects exact ones.
    patterns
        Factors of the rows' means.
    combination
        The form's rows, if they are not those of the source.

    Attributes
    ----------
    surface
        An estimate of the surface that is taken as exact; None for that of the scenario.

    Raises
    ------
    ValueError
        If the tolerance is neither 0 nor large enough.
    """

    @one_blas_thread
    def __init__(self, scenario: Scenario, source: RowSource, n_items: int, n_rows: int,
                 loss: Loss, tolerance: float, patterns: Sequence[Pattern] = PLAIN,
                 combination: Combination | None = None) -> None:
        self.scenario, self._loss = scenario, loss
        self._n_rows, self._combination = n_rows, combination
        self.surface: SurfaceEstimate | None = None
        self.rows: MeasurementRows = (
            ExactRows(scenario, source, n_items, n_rows, patterns) if tolerance == 0
            else CompressedRows(scenario, source, n_items, n_rows, tolerance, patterns))

    @one_blas_thread
    def value(self, codebook: Beamforming) -> float:
        """Compute the average without its gradients."""
        total = sum(float(losses.sum()) for losses, _ in self._losses(codebook))
        return total / self.rows.n_items

    @one_blas_thread
    def __call__(self, codebook: Beamforming) -> Gradient:
        """Compute the average and its gradients."""
        model = self._model(codebook)
        evaluation = self.rows.begin(model)
        bands = range(self.scenario.n_bands)
        total = 0.0
        for block in self._blocks():
            whitened = self._whitened(evaluation, block)
            losses, weights = self._loss(block, _sum_of_forms(whitened))
            total += float(losses.sum())
            for band in bands:
                weighted = _weighted(weights, whitened[band])
                if self._combination:
                    weighted = self._combination.backward(band, weighted, self._n_rows)
                evaluation.accumulate(block, band, weighted)
        mean_terms, covariance_terms = map(
            np.stack, zip(*map(evaluation.sums, bands), strict=True))
        gradients = quadratic_gradients(
            model, codebook, mean_terms, covariance_terms, self.rows.n_items, self.surface)
        return Gradient(total / self.rows.n_items, *gradients)

    def _losses(self, codebook: Beamforming) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Results of the loss for each block."""
        evaluation = self.rows.begin(self._model(codebook))
        for block in self._blocks():
            yield self._loss(block, _sum_of_forms(self._whitened(evaluation, block)))

    def _blocks(self) -> Iterator[slice]:
        return blocks(self.rows.n_items, self._n_rows)

    def _model(self, codebook: Beamforming) -> MeasurementModel:
        exact = self.surface.without_errors() if self.surface else None
        return MeasurementModel(self.scenario, codebook, exact)

    def _whitened(self, evaluation: Evaluation, block: slice) -> list[np.ndarray]:
        """Whitened means of the form's rows, [n, G, N_SB F] of each band."""
        whitened = [evaluation.whitened(block, i) for i in range(self.scenario.n_bands)]
        if self._combination is None:
            return whitened
        return [self._combination.forward(band, rows) for band, rows in enumerate(whitened)]


def _sum_of_forms(whitened: list[np.ndarray]) -> np.ndarray:
    """Sum of the bands' quadratic forms [n, G, G]."""
    total: np.ndarray = np.sum([quadratic_form(means) for means in whitened], axis=0, dtype=float)
    return total


def _weighted(weights: np.ndarray, whitened: np.ndarray) -> np.ndarray:
    """Weights [n, G, G] times rows [n, G, R], in the precision of the rows."""
    parts = whitened.view(whitened.real.dtype)
    weights = weights.astype(parts.dtype, copy=False)
    # Products of single rows take many times as long as one product of arrays.
    product: np.ndarray = weights * parts if parts.shape[1] == 1 else np.matmul(weights, parts)
    return product.view(whitened.dtype)
