"""Averages of losses that depend on a codebook through quadratic forms, with gradients.

The average Cramer-Rao bound is one example. In this module, `by_radiation` is the gradient
d/dRe(T_i) + i d/dIm(T_i) of an average, complex128 [N_B, N_SB F, N_E].
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds.fisher import inverse_information, without_nuisance
from rhs_isac_ros.bounds.rows import (
    PLAIN,
    Evaluation,
    Pattern,
    RowSource,
    Tick,
    no_tick,
    rows_within,
)
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import checked_positions
from rhs_isac_ros.model.elements import (
    SurfaceEstimate,
    element_correlation,
    error_radiation,
    error_terms,
)
from rhs_isac_ros.model.gaussian import quadratic_form
from rhs_isac_ros.model.geometry import measurement_times_s, region_information, velocity_std_mps
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.los import los_and_derivative
from rhs_isac_ros.model.multipath import coupling, declared_covariance, measurement_correlation
from rhs_isac_ros.model.surface import NOMINAL, Beamforming, Response, ports_of
from rhs_isac_ros.support.threads import one_blas_thread

# Function of a block of n items and their forms, float64 [n, G, G]. It returns the losses [n] and
# their negative derivatives with respect to the forms, float64 [n, G, G].
Loss = Callable[[slice, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Gradient(NamedTuple):
    """An average loss and its gradients with respect to a codebook.

    `by_analog` is d/dC, float64 [N_B, F, N_E]; `by_digital` is d/dRe(S) + i d/dIm(S), complex128
    [N_B, N_SB, F, K].
    """

    value: float
    by_analog: np.ndarray
    by_digital: np.ndarray


class Combination(NamedTuple):
    """Rows of a quadratic form, each of which is a multiple of a row of the source."""

    # Index of each row's source row, int [G], and factor in each band, complex128 [N_B, G].
    sources: np.ndarray
    scale: np.ndarray

    def forward(self, band: int, whitened: np.ndarray) -> np.ndarray:
        """Compute the rows, complex [n, G, R], from the S rows of the source, [n, S, R]."""
        return whitened[:, self.sources] * self.scale[band, :, None]

    def backward(self, band: int, weighted: np.ndarray, n_rows: int) -> np.ndarray:
        """Propagate gradients from the rows, [n, G, R], back to those of the source, [n, S, R]."""
        gathered = np.zeros((len(weighted), n_rows, weighted.shape[2]), complex)
        for row, (source, scale) in enumerate(zip(self.sources, self.scale[band], strict=True)):
            gathered[:, source] += np.conj(scale) * weighted[:, row]
        return gathered


class Average:
    """Mean of losses, each of which depends on a codebook through the quadratic form of an item.

    The form of an item is 2 Re sum_i D_i^H Lambda_i^-1 D_i, where the columns of D_i are the means
    of the item's G rows. If the rows are derivatives, the form is the Fisher information. If they
    are differences, it is twice the squared distance between whitened mean signals.

    Parameters
    ----------
    tolerance
        Relative error of the rows, as in `CompressedRows`; 0 selects exact rows.
    combination
        Rows of the form, if they differ from the rows of the source.
    """

    #: An estimate of the surface that is treated as exact; None for the declared elements.
    surface: SurfaceEstimate | None = None

    @one_blas_thread
    def __init__(self, source: RowSource, loss: Loss, tolerance: float,
                 combination: Combination | None = None) -> None:
        self.scenario, self._loss, self._combination = source.scenario, loss, combination
        self.rows = rows_within(source, tolerance)

    @one_blas_thread
    def value(self, codebook: Beamforming) -> float:
        """Compute the average without its gradients."""
        return float(np.mean(self.losses(codebook)))

    def losses(self, codebook: Beamforming) -> np.ndarray:
        """Compute the loss of each item, float64 [n]."""
        evaluation = Evaluation(self.rows, self._model(codebook))
        return np.concatenate([losses for _, _, losses, _ in self._blocks(evaluation)])

    @one_blas_thread
    def __call__(self, codebook: Beamforming) -> Gradient:
        """Compute the average and its gradients."""
        model = self._model(codebook)
        evaluation = Evaluation(self.rows, model)
        bands = range(self.scenario.n_bands)
        every = []
        for block, whitened, losses, weights in self._blocks(evaluation):
            every.append(losses)
            for band in bands:
                weighted = _weighted(weights, whitened[band])
                if self._combination:
                    weighted = self._combination.backward(band, weighted, self.rows.n_rows)
                evaluation.accumulate(block, band, weighted)
        mean_terms, covariance_terms = map(
            np.stack, zip(*map(evaluation.sums, bands), strict=True))
        gradients = quadratic_gradients(
            model, codebook, mean_terms, covariance_terms, self.rows.n_items)
        return Gradient(float(np.mean(np.concatenate(every))), *gradients)

    def _model(self, codebook: Beamforming) -> MeasurementModel:
        exact = self.surface and dataclasses.replace(
            self.surface, factor=self.surface.factor[:, :0])
        return MeasurementModel(self.scenario, codebook, exact)

    def _blocks(self, evaluation: Evaluation
                ) -> Iterator[tuple[slice, list[np.ndarray], np.ndarray, np.ndarray]]:
        """Yield each block, whitened means [n, G, N_SB F] by band, and the results of `Loss`."""
        for block in self.rows.blocks():
            whitened = [evaluation.whitened(block, i) for i in range(self.scenario.n_bands)]
            if self._combination:
                whitened = [self._combination.forward(band, rows)
                            for band, rows in enumerate(whitened)]
            forms = np.sum([quadratic_form(means) for means in whitened], axis=0, dtype=float)
            yield block, whitened, *self._loss(block, forms)


def average_crlb(
        scenario: Scenario, codebook: Beamforming, positions: np.ndarray) -> Gradient:
    """Compute the average bound, Eq. (17), with its gradients by Propositions 2 and 3.

    Takes positions of the user, float64 [N, 3] [m]. The value and its derivative with respect to C
    are in m^2; the derivative with respect to S is in m^2/sqrt(W).
    Raises ValueError if `positions` is not a finite [N, 3] array, or contains no position.

    Examples
    --------
    >>> users = np.array([[8.0, 1.0, 0.2], [12.0, -2.0, 0.5]])
    >>> value_m2, by_analog, by_digital = average_crlb(Scenario(), Codebook.default(), users)
    >>> by_analog.shape, by_digital.shape
    ((2, 4, 100), (2, 8, 4, 3))
    """
    return AverageCrlb(scenario, positions)(codebook)


class AverageCrlb(Average):
    """Average of `crlb` over fixed positions, float64 [N, 3] [m], for use with many codebooks.

    Nuisance parameters, errors of the elements and `region_prior` are treated as in `crlb`.
    `tolerance` is the same as in `Average`. `tick` is called repeatedly while rows are
    computed, and may raise an exception to end it. Raises ValueError as `average_crlb` does.
    """

    def __init__(self, scenario: Scenario, positions: np.ndarray, tolerance: float = 0.0, *,
                 region_prior: bool = False, tick: Tick = no_tick) -> None:
        self.positions = checked_positions(positions)
        if not len(self.positions):
            raise ValueError('positions: none given, expected at least one')
        self._prior = region_information(scenario) if region_prior else np.zeros((3, 3))
        patterns, combination = _structure(scenario)
        moving = np.flatnonzero(velocity_std_mps(scenario))
        n_gains = len(patterns) - (len(moving) > 0)
        n_rows = 3 + max(n_gains, 0) + len(moving)

        def source(block: slice, band: int) -> np.ndarray:
            gain, derivative = los_and_derivative(scenario, self.positions[block], band)
            return np.concatenate([
                derivative, *[gain[:, None]] * n_gains, derivative[:, moving]], axis=1)

        super().__init__(
            RowSource(scenario, source, len(self.positions), n_rows, patterns or PLAIN, tick),
            self._bounds, tolerance, combination)

    def _bounds(self, _: slice, joint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds [n] and their negative derivatives with respect to the forms."""
        marginal = without_nuisance(joint, self.scenario)
        inverse = inverse_information(marginal.information + self._prior)
        values = np.trace(inverse, axis1=1, axis2=2)
        # If the signals do not determine the position, the value is infinite and the slope zero.
        finite = np.where(np.isfinite(values)[:, None, None], inverse, 0.0)
        slopes = np.matmul(finite, finite)
        if joint.shape[1] == 3:
            return values, slopes
        # W = [I; regression] minimises W^T J W, the Schur complement, so W counts as constant.
        identity = np.broadcast_to(np.eye(3), (len(joint), 3, 3))
        whole = np.concatenate([identity, marginal.regression], axis=1)
        return values, whole @ slopes @ np.swapaxes(whole, 1, 2)


def _structure(scenario: Scenario) -> tuple[list[Pattern], Combination | None]:
    """Return patterns of the source rows, and their combination into rows of all parameters."""
    # If a parameter's pattern is constant in each band, its row is a multiple of the gain. Others
    # have their own source rows. Without nuisance parameters, the derivative suffices. Rows of the
    # velocity are those of the position times the times of the measurements, and come last.
    scaled = nuisance_of(scenario).scaled_patterns
    n_moving = np.count_nonzero(velocity_std_mps(scenario))
    if not len(scaled) and not n_moving:
        return [], None
    patterns: list[Pattern] = [(slice(0, 4), None)]
    index = [0, 1, 2]
    scale = np.ones((scenario.n_bands, 3 + len(scaled) + n_moving), complex)
    for row, pattern in enumerate(scaled, 3):
        if np.ptp(pattern, axis=1).any():
            index.append(3 + len(patterns))
            patterns.append((slice(index[-1], index[-1] + 1), pattern))
        else:
            index.append(3)
            scale[:, row] = pattern[:, 0]
    if n_moving:
        rows = slice(3 + len(patterns), 3 + len(patterns) + n_moving)
        index.extend(range(rows.start, rows.stop))
        patterns.append((rows, scenario.user_speed_std_mps * measurement_times_s(scenario)))
    return patterns, Combination(np.array(index), scale)


def _weighted(weights: np.ndarray, whitened: np.ndarray) -> np.ndarray:
    """Multiply weights [n, G, G] by rows [n, G, R], in the precision of the rows."""
    parts = whitened.view(whitened.real.dtype)
    weights = weights.astype(parts.dtype, copy=False)
    # Matrix products of single rows take many times as long as one elementwise product.
    product = weights * parts if parts.shape[1] == 1 else np.matmul(weights, parts)
    return product.view(whitened.dtype)


def quadratic_gradients(
        model: MeasurementModel, codebook: Beamforming, mean_terms: np.ndarray,
        covariance_terms: np.ndarray, n_items: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the gradients of an average, as in `Gradient`, from sums over all items.

    The sums are results of `Evaluation.sums` for all bands, complex128 [N_B, N_SB F, N_E] and
    [N_B, N_SB F, N_SB F].
    """
    scenario = model.scenario
    correlation = np.conj(measurement_correlation(scenario))
    declared = declared_covariance(scenario)
    through_covariance = np.matmul(
        correlation * covariance_terms, declared.scatter(model.radiation))
    if measured := scenario.multipath:
        to_survey = coupling(scenario, model.radiation, measured.radiation)
        through_covariance += np.matmul(
            correlation * (covariance_terms @ to_survey @ measured.excess),
            declared.scatter(measured.radiation))
    by_radiation = 4 * (through_covariance - mean_terms) / n_items
    terms = [(model.elements.response, by_radiation)]
    if not model.elements.is_exact:
        radiation = error_radiation(scenario, codebook)
        terms += [
            ((slope, constant, 1.0), _by_error(scenario, of_term, covariance_terms, n_items))
            for (constant, slope), of_term in zip(
                error_terms(scenario), radiation, strict=True)]
    by_analog, by_digital = (
        np.sum([gradient(scenario, codebook, by_term, response) for response, by_term in terms],
               axis=0) for gradient in (gradient_analog, gradient_digital))
    return by_analog, by_digital


def _by_error(scenario: Scenario, radiation: np.ndarray, covariance_terms: np.ndarray,
              n_items: int) -> np.ndarray:
    """Return the derivative with respect to a term of `error_radiation`, [N_B, N_SB F, N_E]."""
    return np.stack([
        4 / n_items * np.einsum(
            'rsm,sm->rm', np.conj(element_correlation(scenario, band)) * terms[..., None], columns)
        for band, (terms, columns) in enumerate(zip(covariance_terms, radiation, strict=True))])


def gradient_analog(
        scenario: Scenario, codebook: Beamforming, by_radiation: np.ndarray,
        response: Response = NOMINAL) -> np.ndarray:
    """Implements Proposition 2. Derivative with respect to C_i, float64 [N_B, F, N_E].

    The paper writes the chain rule for every pair of coordinates. Here, the derivative with
    respect to T_i already contains the sum over these pairs.
    """
    slope, _, gains = response
    by_radiation = np.reshape(np.conj(gains), (-1, 1, 1)) * by_radiation
    return scenario.board.by_tunings(
        ports_of(scenario), codebook.analog, codebook.digital,
        _frames(scenario, np.conj(slope) * by_radiation))


def gradient_digital(
        scenario: Scenario, codebook: Beamforming, by_radiation: np.ndarray,
        response: Response = NOMINAL) -> np.ndarray:
    """Implements Proposition 3. Derivative d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K]."""
    slope, offset, gains = response
    by_radiation = np.reshape(np.conj(gains), (-1, 1, 1)) * by_radiation
    return scenario.board.by_digital(
        ports_of(scenario), codebook.analog, _frames(scenario, by_radiation), slope, offset)


def _frames(scenario: Scenario, by_radiation: np.ndarray) -> np.ndarray:
    return by_radiation.reshape(
        scenario.n_bands, scenario.n_subbands, -1, scenario.n_elements)
