"""Modes weighed with the covariance of element errors at their position.

The search whitens with the average covariance over the region and over surfaces. The errors of the
direct path, however, are stronger for near users, and a surface has a whole number of failed
elements: given k failures, their covariance is k / E[k] times the average one. The likelihood of a
mode is the average over k.
"""

import dataclasses

import numpy as np

from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.imperfections import has_element_errors
from rhs_isac_ros.model.surface_estimate import SurfaceEstimate
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import likelihood_loss, offset_to_roi
from rhs_isac_ros.positioning.table import MIN_CURVATURE
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Numbers of failures whose probability is relevant.
_MIN_PROBABILITY = 1e-5
_MAX_COUNTS = 12
_STEP_LIMITS = np.array([0.02, 0.03, 0.03])
# Share of the errors of an estimate in the whitened signals from which their position matters.
_MIN_ERROR_SHARE = 0.05


class ElementErrorModel:
    """Likelihood of modes under the errors of the elements that remain unknown.

    These are the errors that a scenario declares, or those of an estimate of the surface.
    """

    def __init__(self, model: WhitenedModel) -> None:
        scenario = model.scenario
        self._model = model
        if model.surface is not None:
            # The number of failures is known.
            scenario = dataclasses.replace(scenario, failed_element_share=0.0)
        self._average = MeasurementModel(scenario, model.codebook, model.surface)
        self._intact = MeasurementModel(
            dataclasses.replace(scenario, failed_element_share=0.0), model.codebook,
            model.surface)
        roots = np.linalg.cholesky(self._average.covariance())
        self._log_volume = 2 * np.log(np.diagonal(roots, axis1=1, axis2=2).real).sum()
        self._scales, self._log_weights = _failures(
            scenario.n_elements, scenario.failed_element_share)

    @classmethod
    def of(cls, model: WhitenedModel) -> 'ElementErrorModel | None':
        """Return the errors of a model, or None if they are absent or negligible."""
        if model.surface is None:
            return cls(model) if has_element_errors(model.scenario) else None
        if not isinstance(model.surface, SurfaceEstimate):
            return None
        errors = model.surface.error_covariance(model.scenario, model.codebook)
        share = model.whitened_power(errors) / float(np.prod(model.shape))
        return cls(model) if share > _MIN_ERROR_SHARE else None

    def refine(self, modes: Modes, signals: np.ndarray, step: bool) -> tuple[Modes, np.ndarray]:
        """Weigh modes; also return the energy of their residuals, float64 [M].

        Parameters
        ----------
        signals
            Signals without nuisance parameters at each mode, not whitened, complex128
            [M, N_B, N_SB F].
        step
            Whether to move the modes and replace their curvature, too.
        """
        points = modes.roi_points
        positions = to_positions(points)
        mean, slopes = self._average.mean_and_jacobian(positions)
        by_point = np.matmul(np.swapaxes(jacobian(points), 1, 2),
                             slopes.reshape(len(points), 3, -1)).reshape(slopes.shape)
        columns = np.concatenate([(signals - mean)[:, None], by_point], axis=1)
        intact = self._intact.covariance_at(positions)
        average = self._average.covariance_at(positions)
        shape = len(self._scales), len(points)
        value, residual = np.empty(shape), np.empty(shape)
        curvature, gradient = np.empty((*shape, 3, 3)), np.empty((*shape, 3))
        for k, scale in enumerate(self._scales):
            roots = np.linalg.cholesky(intact + scale * (average - intact))
            white = np.linalg.solve(roots, np.moveaxis(columns, 1, 3))
            white = np.moveaxis(white, 3, 1).reshape(len(points), 4, -1)
            residual[k] = np.sum(np.abs(white[:, 0])**2, axis=1)
            volume = 2 * np.log(np.diagonal(roots, axis1=2, axis2=3).real).sum(axis=(1, 2))
            value[k] = self._log_weights[k] - residual[k] - volume + self._log_volume
            curvature[k] = quadratic_form(white[:, 1:])
            gradient[k] = 2 * np.einsum('mgs,ms->mg', white[:, 1:].conj(), white[:, 0]).real
        highest = value.max(axis=0)
        weights = np.exp(value - highest)
        total = highest + np.log(weights.sum(axis=0))
        weights /= weights.sum(axis=0)
        best = np.take_along_axis(residual, value.argmax(axis=0)[None], axis=0)[0]
        if not step:
            # The modes keep their terms of the nuisance parameters.
            change = total + self._searched_energy(signals, mean)
            return modes._replace(log_likelihood=modes.log_likelihood + change), best
        mixed = np.einsum('km,kmpq->mpq', weights, curvature) + np.diag(MIN_CURVATURE)
        slope = np.einsum('km,kmp->mp', weights, gradient)
        shift = np.linalg.solve(mixed, slope[..., None])[..., 0]
        shift = np.clip(shift, -_STEP_LIMITS, _STEP_LIMITS)
        total += np.sum(slope * shift, axis=1) - likelihood_loss(shift, mixed)
        points = points + shift
        offset = offset_to_roi(points, mixed, self._model.scenario.roi_bounds_m)
        refined = Modes(points, mixed, total, offset)
        order = np.argsort(-refined.roi_log_likelihood)
        return refined.select(order), best[order]

    def _searched_energy(self, signals: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Energy of the residuals with the covariance of the search, float64 [M]."""
        energy: np.ndarray = np.sum(np.abs(self._model.whiten(signals - mean))**2, axis=(1, 2))
        return energy


def _failures(n_elements: int, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of failures relative to their mean, and the logarithm of their probability."""
    if share == 0:
        return np.zeros(1), np.zeros(1)
    from scipy.stats import binom

    counts = np.arange(n_elements + 1)
    probability = binom.pmf(counts, n_elements, share)
    likely = counts[probability > _MIN_PROBABILITY]
    if len(likely) > _MAX_COUNTS:
        likely = np.unique(np.linspace(likely[0], likely[-1], _MAX_COUNTS).round().astype(int))
    weights = probability[likely] / probability[likely].sum()
    return likely / (n_elements * share), np.log(weights)
