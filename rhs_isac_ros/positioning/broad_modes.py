"""Samples of modes that are too broad for a Gaussian, weighed with the likelihood at each.

Without the phases of the bands, only the amplitude and the curvature of the wavefront reveal the
range. A mode then extends over metres, over which the likelihood is not quadratic and the
volume element changes. The samples of the Gaussians serve as a proposal: each has the weight of
the posterior relative to the mixture of all Gaussians, so that modes may overlap.
"""

import numpy as np

from rhs_isac_ros.positioning.band_phases import BandPhases
from rhs_isac_ros.positioning.joint_modes import (
    JointModes,
    band_outputs,
    local_model,
    with_band_phases,
)
from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.samples import Samples, draw_samples
from rhs_isac_ros.positioning.unknowns import Unknowns
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Factor of the spread of the samples. Tails of the posterior may be heavier than Gaussian.
_SPREAD = 1.3
# Newton steps of the nuisance parameters at each sample.
_N_STEPS = 2
# Samples whose log-weight is lower than the best by more have no effect, whatever their phases.
_LIKELY_MARGIN = 20.0


def draw_broad_samples(
        model: WhitenedModel, unknowns: Unknowns, phases: BandPhases, received: np.ndarray,
        joint: JointModes, normal: np.ndarray) -> Samples:
    """Represent modes by samples with the weights of the posterior.

    The prior is uniform on the region of interest.

    Parameters
    ----------
    received
        Signals of one positioning phase, complex128 [N_B, N_SB F].
    normal
        Points that represent a standard Gaussian, float64 [S, 3].
    """
    samples = draw_samples(joint.modes, _SPREAD * normal, model.scenario.roi_bounds_m)
    n_samples = samples.positions.shape[1]
    inside = np.isfinite(samples.log_weights)
    points = to_polar(samples.positions[inside])
    values = np.repeat(joint.values, n_samples, axis=0)[inside.reshape(-1)]
    log_weights = np.full(inside.shape, -np.inf)
    evidence, values = _log_evidence(model, unknowns, received, points, values)
    log_weights[inside] = (
        evidence
        + np.log(np.linalg.det(jacobian(points))) - 1.5 * np.log(2 * np.pi)
        - _log_density(points, joint))
    if not phases.is_informative:
        return samples._replace(log_weights=log_weights)
    likely = log_weights[inside] >= log_weights.max() - _LIKELY_MARGIN
    outputs = band_outputs(model, unknowns, received, points[likely], values[likely])
    log_factors, offsets_m = np.zeros(len(points)), np.zeros(len(points))
    log_factors[likely], offsets_m[likely] = phases.factors(outputs.T)
    log_weights[inside] += log_factors
    positions = samples.positions.copy()
    positions[inside] = to_positions(points + offsets_m[:, None] * [1, 0, 0])
    return samples._replace(positions=positions, log_weights=log_weights)


def _log_evidence(
        model: WhitenedModel, unknowns: Unknowns, received: np.ndarray, points: np.ndarray,
        values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihood of points [P, 3], with the nuisance parameters integrated out, [P].

    Takes approximate values of the parameters [P, Q]; those of the bands' phases are replaced.
    Also returns the values that it has found.
    """
    values = with_band_phases(model, unknowns, received, points, values)
    for _ in range(_N_STEPS):
        information, gradient, value, _ = local_model(model, unknowns, received, points, values)
        nuisance, slope = information[:, 3:, 3:], gradient[:, 3:]
        step = np.linalg.solve(nuisance, slope[..., None])[..., 0]
        values += step
    evidence: np.ndarray = (
        value + np.sum(slope * step, axis=1) / 2 - np.linalg.slogdet(nuisance)[1] / 2
        - np.sum(np.log(unknowns.std)))
    return evidence, values


def _log_density(points: np.ndarray, joint: JointModes) -> np.ndarray:
    """Logarithm of the sum of the densities from which samples of the modes are drawn, [P]."""
    modes = joint.modes
    offset = points[:, None] - modes.roi_points
    exponent = -np.einsum('pma,mab,pmb->pm', offset, modes.curvature, offset) / (2 * _SPREAD**2)
    exponent += np.linalg.slogdet(modes.curvature)[1] / 2
    density: np.ndarray = (np.logaddexp.reduce(exponent, axis=1)
                           - 3 * np.log(_SPREAD) - 1.5 * np.log(2 * np.pi))
    return density
