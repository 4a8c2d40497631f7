"""The modes of the posterior of position and nuisance parameters, reduced to the position.

Scoring steps maximise over both. Around a mode, the posterior is Gaussian, so that the
marginal of the position has the Schur complement of the curvature, and its mass contains the
determinant of the nuisance parameters' curvature: Laplace's method.
"""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.positioning.joint_search import find_starts
from rhs_isac_ros.positioning.modes import (
    MAX_MODES,
    MIN_GAIN,
    STEP_LIMITS,
    TABLE_MARGIN,
    Modes,
)
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import likelihood_loss, offset_to_roi
from rhs_isac_ros.positioning.table import MIN_CURVATURE, TemplateTable
from rhs_isac_ros.positioning.unknowns import Unknowns
from rhs_isac_ros.positioning.whitened import WhitenedModel

_MAX_STARTS = 96
# Maximum difference between the best log-likelihood and that of a mode, after an exact step.
_EXACT_MARGIN = 9.0
_N_STEPS = 5
# Limit of a step in range if the phases of the bands carry no information about it.
_COARSE_STEP_M = 0.7
# Squared distance, in units of the curvature, below which modes have converged to the same one.
_SAME_MODE = 0.5


class JointModes(NamedTuple):
    """Modes of the marginal posterior of the position.

    Attributes
    ----------
    modes
        Their log-likelihood is that of the marginal, without the factors 2 pi that all modes have
        in common.
    residual
        Energy of the whitened residual at each mode, float64 [M].
    values
        Nuisance parameters at each mode, float64 [M, Q].
    """

    modes: Modes
    residual: np.ndarray
    values: np.ndarray

    def select(self, chosen: np.ndarray) -> 'JointModes':
        """Return the modes with the given indices."""
        return JointModes(self.modes.select(chosen), self.residual[chosen], self.values[chosen])


def find_joint_modes(
        model: WhitenedModel, table: TemplateTable, unknowns: Unknowns, received: np.ndarray,
        aligned: np.ndarray) -> JointModes:
    """Find the modes with a substantial weight in the posterior, the most likely first.

    Parameters
    ----------
    received
        Signals of one positioning phase, complex128 [N_B, N_SB F].
    aligned
        Values [Q] of the parameters that `Alignment` determines, 0 for the others.
    """
    whitened = model.whiten((received * unknowns.factors(aligned))[None])[0]
    starts = find_starts(table, unknowns, whitened, _MAX_STARTS, TABLE_MARGIN)
    joint, gain = _step(model, unknowns, received, starts.points, starts.values + aligned)
    for _ in range(_N_STEPS - 1):
        joint, gain = _prune(joint, gain)
        (moving,) = np.nonzero(gain > MIN_GAIN)
        if not len(moving):
            break
        moved, gain[moving] = _step(
            model, unknowns, received, joint.modes.roi_points[moving], joint.values[moving])
        for field, new in zip((*joint.modes, joint.residual, joint.values),
                              (*moved.modes, moved.residual, moved.values), strict=True):
            field[moving] = new
    # A step that has not converged may predict any likelihood.
    joint, gain = _prune(joint, gain)
    return _prune(*_step(
        model, unknowns, received, joint.modes.points, joint.values, moves=False))[0]


def _prune(joint: JointModes, gain: np.ndarray) -> tuple[JointModes, np.ndarray]:
    """Sort by likelihood; drop improbable modes and repetitions.

    The likelihood of a mode is a prediction. The best is at most the one before the last step,
    which is computed.
    """
    value = joint.modes.roi_log_likelihood
    order = np.argsort(-value)
    best = min(value.max(), (value - gain).max())
    order = order[value[order] >= best - _EXACT_MARGIN - np.maximum(gain[order], 0)]
    points, curvature = joint.modes.roi_points, joint.modes.curvature
    kept: list[int] = []
    for index in order.tolist():
        offset = points[kept] - points[index]
        distance = np.einsum('mp,pq,mq->m', offset, curvature[index], offset)
        if not (distance < _SAME_MODE).any():
            kept.append(index)
        if len(kept) == MAX_MODES:
            break
    chosen = np.array(kept)
    return joint.select(chosen), gain[chosen]


def _step(
        model: WhitenedModel, unknowns: Unknowns, received: np.ndarray, points: np.ndarray,
        values: np.ndarray, moves: bool = True) -> tuple[JointModes, np.ndarray]:
    """Take one scoring step; also return the gain of log-likelihood in the region, [M].

    If it does not move the points, the result is the likelihood there, and the gain is 0.
    """
    coarse = unknowns.is_coarse
    if coarse:
        # Steps of the range turn the phases many times.
        values = with_band_phases(model, unknowns, received, points, values)
    curvature, gradient, value, residual = local_model(
        model, unknowns, received, points, values)
    nuisance = curvature[:, 3:, 3:]
    coupling = np.linalg.solve(nuisance, curvature[:, 3:, :3])
    marginal = curvature[:, :3, :3] - np.matmul(curvature[:, :3, 3:], coupling)
    marginal = (marginal + np.swapaxes(marginal, 1, 2)) / 2
    reduced = gradient[:, :3] - np.einsum('mqp,mq->mp', coupling, gradient[:, 3:])
    limits = STEP_LIMITS.copy()
    if coarse:
        limits[0] = _COARSE_STEP_M
    step = np.linalg.solve(marginal, reduced[..., None])[..., 0]
    step = np.clip(step, -limits, limits)
    of_values = (np.linalg.solve(nuisance, gradient[:, 3:, None])[..., 0]
                 - np.einsum('mqp,mp->mq', coupling, step))
    if not moves:
        step, of_values = np.zeros_like(step), np.zeros_like(of_values)
    whole = np.hstack([step, of_values])
    change = np.sum(gradient * whole, axis=1) - likelihood_loss(whole, curvature)
    evidence = value - np.linalg.slogdet(nuisance)[1] / 2 - np.sum(np.log(unknowns.std))
    points = points + step
    roi_offset = offset_to_roi(points, marginal, model.scenario.roi_bounds_m)
    modes = Modes(points, marginal, evidence + change, roi_offset)
    predicted = residual - change
    gain = modes.roi_log_likelihood - evidence if moves else np.zeros(len(points))
    return JointModes(modes, predicted, values + of_values), gain


def with_band_phases(
        model: WhitenedModel, unknowns: Unknowns, received: np.ndarray, points: np.ndarray,
        values: np.ndarray) -> np.ndarray:
    """Replace the phases of the bands, in values [M, Q], by the most likely ones at points."""
    phases = [q for q, name in enumerate(unknowns.names) if name == 'band_phase']
    values = values.copy()
    values[:, phases] = np.angle(band_outputs(model, unknowns, received, points, values))
    return values


def band_outputs(
        model: WhitenedModel, unknowns: Unknowns, received: np.ndarray, points: np.ndarray,
        values: np.ndarray) -> np.ndarray:
    """Compute the outputs of the matched filters at points, complex128 [M, N_B].

    They contain the phases of the bands, but not the effect of the other values [M, Q].
    """
    others = np.array([name != 'band_phase' for name in unknowns.names])
    mean = model.mean(to_positions(points))
    whitened = model.whiten(received * unknowns.factors(values * others))
    outputs: np.ndarray = np.sum(mean.conj() * whitened, axis=2)
    return outputs


def local_model(
        model: WhitenedModel, unknowns: Unknowns, received: np.ndarray, points: np.ndarray,
        values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Information [M, 3 + Q, 3 + Q], gradient, value of the log-likelihood, and residual [M].

    The information is the expected one. Observed curvatures of range and phase differ by noise,
    and would spoil the marginal, in which the two nearly cancel.
    """
    n = len(points)
    mean, by_position = model.mean_and_jacobian(to_positions(points))
    by_point = np.matmul(np.swapaxes(jacobian(points), 1, 2), by_position.reshape(n, 3, -1))
    whitened = model.whiten(received * unknowns.factors(values))
    residual = (whitened - mean).reshape(n, -1)
    expected = np.concatenate([by_point, unknowns.whitened_slopes(mean)], axis=1)
    information = quadratic_form(expected)
    information += np.diag(np.concatenate([MIN_CURVATURE, unknowns.precision]))
    information[:, 3:, 3:] += unknowns.information
    slopes = np.concatenate([by_point, unknowns.whitened_slopes(whitened)], axis=1).view(float)
    gradient = 2 * np.matmul(slopes, residual.view(float)[..., None])[..., 0]
    gradient[:, 3:] -= unknowns.precision * values
    energy = np.sum(np.abs(residual)**2, axis=1)
    value = -energy - values**2 @ unknowns.precision / 2
    if unknowns.gain is not None:
        # The volume of the signals changes with the gain.
        gradient[:, 3 + unknowns.gain] -= 2 * received.size
        value -= 2 * received.size * values[:, unknowns.gain]
    return information, gradient, value, energy
