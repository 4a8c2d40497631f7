"""Averages over positions of functions of quadratic forms, with their gradients."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds.compressed_rows import CompressedRows
from rhs_isac_ros.bounds.fisher import factor, information_of
from rhs_isac_ros.bounds.gradient import gradient_analog, gradient_digital
from rhs_isac_ros.bounds.rows import ExactRows, Rows, RowSource, blocks
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.surface import Beamforming

# Function of (block of items, forms [n, G, G]) that returns the items' values [n] and minus their
# derivatives by the forms, float64 [n, G, G].
Loss = Callable[[slice, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Gradient(NamedTuple):
    """An average with its gradients.

    Attributes
    ----------
    value
        The average.
    by_analog
        Derivative by C, float64 [N_B, F, N_E].
    by_digital
        d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K].
    """

    value: float
    by_analog: np.ndarray
    by_digital: np.ndarray


class Average:
    """Mean loss of items that depend on a codebook through a quadratic form each.

    The form of an item is 2 Re sum_i D_i^H Lambda_i^-1 D_i, with one column of D_i for each of its
    rows: the Fisher information if these are derivatives, twice the squared distance of two mean
    signals if they are differences.

    Parameters
    ----------
    scenario
        The scenario.
    source
        Gives the rows of some items in a band.
    n_items
        How many items there are.
    n_rows
        Rows an item, G.
    loss
        Loss of items by their forms.
    tolerance
        Relative error of the rows, see `CompressedRows`; 0 for exact ones.

    Raises
    ------
    ValueError
        If the tolerance is neither 0 nor large enough.
    """

    def __init__(self, scenario: Scenario, source: RowSource, n_items: int, n_rows: int,
                 loss: Loss, tolerance: float) -> None:
        self.scenario, self._loss = scenario, loss
        self.rows: Rows = (
            ExactRows(scenario, source, n_items, n_rows) if tolerance == 0
            else CompressedRows(scenario, source, n_items, n_rows, tolerance))

    def value(self, codebook: Beamforming) -> float:
        """Evaluate the average alone.

        Parameters
        ----------
        codebook
            Analog and digital beamforming.

        Returns
        -------
        float
            The average.
        """
        ongoing = self.rows.begin(*factor(self.scenario, codebook))
        bands = range(self.scenario.n_bands)
        total = 0.0
        for block in blocks(self.rows.n_items):
            forms = sum(information_of(ongoing.whitened(block, band)) for band in bands)
            total += float(self._loss(block, forms)[0].sum())
        return total / self.rows.n_items

    def __call__(self, codebook: Beamforming) -> Gradient:
        """Evaluate the average and its gradients.

        Parameters
        ----------
        codebook
            Analog and digital beamforming.

        Returns
        -------
        Gradient
            Value and derivatives.
        """
        patterns, whiteners = factor(self.scenario, codebook)
        ongoing = self.rows.begin(patterns, whiteners)
        bands = range(self.scenario.n_bands)
        total = 0.0
        for block in blocks(self.rows.n_items):
            whitened = [ongoing.whitened(block, band) for band in bands]
            values, weights = self._loss(block, sum(map(information_of, whitened)))
            total += float(values.sum())
            for band in bands:
                weighted = np.matmul(weights, whitened[band].view(float)).view(complex)
                ongoing.collect(block, band, weighted)
        by_mean, spread = map(np.stack, zip(*map(ongoing.collected, bands), strict=True))
        by_covariance = np.matmul(
            np.conj(measurement_correlation(self.scenario)) * spread,
            np.matmul(patterns, multipath_covariance(self.scenario)))
        by_pattern = 4 * (by_covariance - by_mean) / self.rows.n_items
        return Gradient(
            total / self.rows.n_items, gradient_analog(self.scenario, codebook, by_pattern),
            gradient_digital(self.scenario, codebook, by_pattern))
