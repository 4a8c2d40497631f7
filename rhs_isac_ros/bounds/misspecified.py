"""Bias and covariance of an estimator that assumes a model other than the true one.

Suppose that the assumed model has the mean mu(p) and the covariance L, and that the true mean is
m. The maximum-likelihood estimator then tends to the pseudo-true position p*, which minimises (m -
mu(p))^H L^-1 (m - mu(p)). Its errors about p* have the sandwich covariance A^-1 B A^-1, where A is
the expected curvature of the assumed log-likelihood at p*, and B the covariance of its gradient
under the true covariance (Fortunati, Gini, Greco and Richmond, Performance bounds for parameter
estimation under misspecified models, IEEE Signal Processing Magazine 34 (6), 2017; for
reconfigurable surfaces: Zheng, Chen, Ballal, Valkama, Wymeersch and Al-Naffouri, arXiv
2204.12783). If both models are the same, this covariance is the Cramer-Rao bound.
"""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds.fisher import inverse_information
from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.arrays import adjoint, checked_positions
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.gaussian import energy_limit, quadratic_form, step_to_maximum
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.support.threads import one_blas_thread

_MAX_STEPS, _HALVINGS = 60, 12
# Step of finite differences, and step at which the search has converged [m].
_DIFFERENCE_M, _TOLERANCE_M = 1e-4, 1e-7
# Largest coordinate in the search, which diverges if the signals contain no information [m].
_FARTHEST_M = 1e9
# Number of ranges per shortest wavelength in the search for ambiguities.
_PER_WAVELENGTH = 8
# Scale of the distance between the maximum of an ambiguity and the ray [m].
_MAX_OFFSET_M = 0.5
# 99 % quantile of the residual energy, in standard deviations above its mean.
_QUANTILE = 2.33
# Conditions for a valid result: largest share of ambiguities in the squared error, smallest
# distance from the border of the region in standard deviations, and largest relative error of the
# linearised mean.
_MAX_AMBIGUITY, _MIN_BORDER, _MAX_NONLINEARITY = 0.01, 3.0, 0.25


class Misspecified(NamedTuple):
    """Errors of the maximum-likelihood estimator of an assumed model under the true model."""

    bias: np.ndarray  #: Pseudo-true position minus true position, float64 [N, 3] [m].
    covariance: np.ndarray  #: Covariance about the pseudo-true position, [N, 3, 3] [m^2].
    #: Whether the result describes the estimator, bool [N]: the covariance is finite, confusion of
    #: ranges adds almost no error, the mean is almost linear within the errors, the border of the
    #: region is far away, and estimators accept the energy of the residual.
    valid: np.ndarray

    @property
    def mse_m2(self) -> np.ndarray:
        """Mean squared error, float64 [N] [m^2]."""
        return (np.sum(self.bias**2, axis=1)
                + np.trace(self.covariance, axis1=1, axis2=2))


@one_blas_thread
def misspecified(
        assumed: MeasurementModel, true: MeasurementModel, positions: np.ndarray) -> Misspecified:
    """Compute the errors of an estimator whose assumed model differs from the true one.

    Takes positions of the user, float64 [N, 3] [m]. Raises ValueError if they are not finite
    [N, 3], the models differ in size, or a model has nuisance parameters, such as phases.
    """
    positions = checked_positions(positions)
    if assumed.shape != true.shape:
        raise ValueError(f'true: N_B, N_SB F = {true.shape}, expected {assumed.shape}')
    for name, model in (('assumed', assumed), ('true', true)):
        if len(nuisance_of(model.scenario)) or model.scenario.user_speed_std_mps:
            raise ValueError(f'{name}: a scenario with nuisance parameters, expected none')
    target = assumed.whiten(true.mean(positions))
    places = _pseudo_true(assumed, positions, target)
    mean, slopes = assumed.mean_and_jacobian(places, whitened=True)
    residual = target - mean
    # The whitener W of the assumed model turns the true covariance into W Lambda W^H.
    white = np.matmul(assumed.whitener @ true.covariance(), adjoint(assumed.whitener))
    gradients = 2 * np.einsum('nair,irs,nbis->nab', slopes.conj(), white, slopes,
                              optimize=True).real
    curvature = quadratic_form(slopes) - _bending(assumed, places, residual)
    inverse = inverse_information(curvature)
    covariance = inverse @ gradients @ inverse
    bias = places - positions
    finite = np.isfinite(covariance).all(axis=(1, 2))
    valid = finite.copy()
    valid[finite] = _is_valid(
        assumed, places[finite], bias[finite], covariance[finite], residual[finite], white)
    return Misspecified(bias, covariance, valid)


def _projections(slopes: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Return the real parts of inner products of derivatives and signals, float64 [N, 3]."""
    return np.einsum('nair,nir->na', slopes.conj(), signals).real


def _pseudo_true(model: MeasurementModel, positions: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Search from `positions` for the mean closest to `target`, by damped Gauss-Newton steps."""
    def cost(places: np.ndarray) -> np.ndarray:
        distances = np.abs(target - model.whiten(model.mean(places)))**2
        return np.sum(distances, axis=(1, 2))

    places = positions.copy()
    costs = cost(positions)
    for _ in range(_MAX_STEPS):
        mean, slopes = model.mean_and_jacobian(places, whitened=True)
        information, gradient = quadratic_form(slopes), 2 * _projections(slopes, target - mean)
        ridge = 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        step = step_to_maximum(information + ridge, gradient)
        for _ in range(_HALVINGS):
            # The mean is defined only in front of the surface.
            trial = np.clip(places + step, -_FARTHEST_M, _FARTHEST_M)
            trial[:, 0] = np.maximum(trial[:, 0], places[:, 0] / 2)
            other = cost(trial)
            worse = other > costs
            step[worse] /= 2
            places[~worse], costs[~worse] = trial[~worse], other[~worse]
            if not worse.any():
                break
        if not len(step) or np.abs(step).max() < _TOLERANCE_M:
            break
    return places


def _bending(model: MeasurementModel, places: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return how much the second derivative of the mean reduces A, float64 [N, 3, 3]."""
    bending = np.empty((len(places), 3, 3))
    for axis in range(3):
        step = _DIFFERENCE_M * np.eye(3)[axis]
        after, before = (model.mean_and_jacobian(places + offset, whitened=True)[1]
                         for offset in (step, -step))
        bending[:, axis] = _projections(after - before, residual) / _DIFFERENCE_M
    return (bending + np.swapaxes(bending, 1, 2)) / 2


def _is_valid(model: MeasurementModel, places: np.ndarray, bias: np.ndarray,
              covariance: np.ndarray, residual: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Return whether the bias and covariance describe the estimator, bool [N]."""
    low, high = model.scenario.roi_bounds_m
    reach = _MIN_BORDER * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    valid = ((places - reach >= low) & (places + reach <= high)).all(axis=1)
    energy = np.trace(white, axis1=1, axis2=2).real.sum() + np.sum(
        np.abs(residual)**2, axis=(1, 2))
    spread = np.sum(np.abs(white)**2) + 2 * np.einsum(
        'nir,irs,nis->n', residual.conj(), white, residual).real
    limit = energy_limit(int(np.prod(model.shape)))
    valid &= energy + _QUANTILE * np.sqrt(spread) <= limit
    mean, slopes = model.mean_and_jacobian(places, whitened=True)
    values, vectors = np.linalg.eigh(covariance)
    for axis in range(3):
        step = vectors[:, :, axis] * np.sqrt(np.maximum(values[:, axis], 0))[:, None]
        linear = np.einsum('na,nair->nir', step, slopes)
        ends = places + step
        ends[:, 0] = np.maximum(ends[:, 0], places[:, 0] / 2)
        bent = model.whiten(model.mean(ends)) - mean - linear
        valid &= np.linalg.norm(bent, axis=(1, 2)) <= _MAX_NONLINEARITY * np.linalg.norm(
            linear, axis=(1, 2))
    total = np.sum(bias**2, axis=1) + np.trace(covariance, axis1=1, axis2=2)
    for row in np.flatnonzero(valid).tolist():
        excess = _ambiguities(model, places[row], mean[row], residual[row], white, covariance[row])
        valid[row] = excess <= _MAX_AMBIGUITY * total[row]
    return valid


def _ambiguities(model: MeasurementModel, place: np.ndarray, mean: np.ndarray,
                 residual: np.ndarray, white: np.ndarray, covariance: np.ndarray) -> float:
    """Estimate the squared error [m^2] from confusion with other ranges in the same direction."""
    # Each maximum adds its squared distance times its probability of being likelier than `place`.
    from scipy.special import ndtr

    scenario = model.scenario
    low, high = scenario.roi_bounds_m
    distance = float(np.linalg.norm(place))
    direction = place / distance
    step = SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz) / _PER_WAVELENGTH
    points = np.arange(step, 2 * np.linalg.norm(np.abs([low, high]).max(axis=0)), step)
    points = points[((low <= points[:, None] * direction)
                     & (points[:, None] * direction <= high)).all(axis=1)]
    means, slopes = model.mean_and_jacobian(points[:, None] * direction, whitened=True)
    # The maximum of an ambiguity lies beside the ray.
    information = quadratic_form(slopes) / 2 + np.diag([_MAX_OFFSET_M**-2] * 3)
    gradient = _projections(slopes, mean + residual - means)
    offset = step_to_maximum(information, gradient)
    difference = means + np.einsum('na,nair->nir', offset, slopes) - mean
    excess = np.sum(np.abs(difference)**2, axis=(1, 2)) - 2 * np.einsum(
        'nir,ir->n', difference.conj(), residual).real
    variance = 2 * np.einsum('nir,irs,nis->n', difference.conj(), white, difference,
                             optimize=True).real
    probability = ndtr(-excess / np.sqrt(np.maximum(variance, 1e-300)))
    is_maximum = np.r_[True, probability[1:] >= probability[:-1]] & np.r_[
        probability[:-1] >= probability[1:], True]
    # The mode at `place` itself has the local standard deviation along the range.
    own = 4 * np.sqrt(direction @ covariance @ direction) + step
    other = is_maximum & (np.abs(points - distance) > own)
    return float(np.sum(probability[other] * (points[other] - distance)**2))
