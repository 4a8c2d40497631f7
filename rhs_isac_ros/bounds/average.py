"""Averages of losses that depend on a codebook through quadratic forms, with gradients."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds.compressed_rows import CompressedRows
from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.bounds.gradient import gradient_analog, gradient_digital
from rhs_isac_ros.bounds.measurement_rows import ExactRows, MeasurementRows, RowSource, blocks
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.surface import Beamforming

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


class Average:
    """Mean loss of items, each of which depends on a codebook through a quadratic form.

    The form of an item is 2 Re sum_i D_i^H Lambda_i^-1 D_i, where the G = `n_rows` columns of D_i
    are the means of the item's rows. With derivatives as rows it is the Fisher information; with
    differences, it is twice the squared distance of two mean signals. `tolerance` is the
    relative error of the rows, see `CompressedRows`; 0 selects exact ones.

    Raises
    ------
    ValueError
        If the tolerance is neither 0 nor large enough.
    """

    def __init__(self, scenario: Scenario, source: RowSource, n_items: int, n_rows: int,
                 loss: Loss, tolerance: float) -> None:
        self.scenario, self._loss = scenario, loss
        self.rows: MeasurementRows = (
            ExactRows(scenario, source, n_items, n_rows) if tolerance == 0
            else CompressedRows(scenario, source, n_items, n_rows, tolerance))

    def value(self, codebook: Beamforming) -> float:
        """Compute the average without its gradients."""
        evaluation = self.rows.begin(MeasurementModel(self.scenario, codebook))
        total = 0.0
        for block in blocks(self.rows.n_items):
            whitened = [evaluation.whitened(block, i) for i in range(self.scenario.n_bands)]
            total += float(self._loss(block, _sum_of_forms(whitened))[0].sum())
        return total / self.rows.n_items

    def __call__(self, codebook: Beamforming) -> Gradient:
        """Compute the average and its gradients."""
        model = MeasurementModel(self.scenario, codebook)
        evaluation = self.rows.begin(model)
        bands = range(self.scenario.n_bands)
        total = 0.0
        for block in blocks(self.rows.n_items):
            whitened = [evaluation.whitened(block, band) for band in bands]
            losses, weights = self._loss(block, _sum_of_forms(whitened))
            total += float(losses.sum())
            for band in bands:
                weighted = np.matmul(weights, whitened[band].view(float)).view(complex)
                evaluation.accumulate(block, band, weighted)
        mean_terms, covariance_terms = map(
            np.stack, zip(*map(evaluation.sums, bands), strict=True))
        through_covariance = np.matmul(
            np.conj(measurement_correlation(self.scenario)) * covariance_terms,
            np.matmul(model.radiation, multipath_covariance(self.scenario)))
        by_radiation = 4 * (through_covariance - mean_terms) / self.rows.n_items
        return Gradient(
            total / self.rows.n_items, gradient_analog(self.scenario, codebook, by_radiation),
            gradient_digital(self.scenario, codebook, by_radiation))


def _sum_of_forms(whitened: list[np.ndarray]) -> np.ndarray:
    """Sum of the bands' quadratic forms [n, G, G]."""
    total: np.ndarray = np.sum([quadratic_form(means) for means in whitened], axis=0)
    return total
