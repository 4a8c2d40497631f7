"""Fisher information of the received signals and the Cramer-Rao lower bound of positioning.

The signals are those of one surface, or of several surfaces of a site.
"""

from collections.abc import Iterable

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import blocks, checked_states, numbers
from rhs_isac_ros.model.gaussian import Marginal, marginalise, quadratic_form
from rhs_isac_ros.model.geometry import measurement_times_s, region_information, velocity_std_mps
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.surface import Beamforming
from rhs_isac_ros.support.threads import map_blocks, one_blas_thread

# A normalised matrix with a pivot below this is singular up to rounding.
_MIN_PIVOT = 1e-14
# Number of positions evaluated at a time. Arrays of many more positions do not fit in the cache.
_BLOCK = 32


@one_blas_thread
def crlb(scenario: Scenario, codebook: Beamforming, positions: np.ndarray, *,
         region_prior: bool = False) -> np.ndarray:
    """Implements Eq. (11). Cramer-Rao lower bound on the mean squared positioning error.

    Takes positions of the user, float64 [N, 3] [m]. Returns float64 [N] [m^2], infinite where the
    information is singular. Declared nuisance parameters are unknown, with their distributions as
    priors; the result is then the hybrid bound. So is a declared velocity; the bound is then that
    for a user who happens to stand still, or, for positions with velocities, [N, 6], for one who
    moves. Errors of the elements add their covariance, averaged over the region. The prior of a
    phase is that of the wrapped density, and an unknown parameter has none. `region_prior` adds a
    Gaussian prior that has the variances of the region, size^2 / 12. Raises
    ValueError if `positions` is not a finite array [N, 3] or [N, 6].

    Examples
    --------
    >>> users = np.array([[8.0, 1.0, 0.2], [12.0, -2.0, 0.5]])
    >>> np.sqrt(crlb(Scenario(), Codebook.default(), users)).round(2)  # [m]
    array([0.11, 0.25])
    """
    return crlb_of(MeasurementModel(scenario, codebook), positions, region_prior=region_prior)


@one_blas_thread
def crlb_of(model: MeasurementModel, positions: np.ndarray, *,
            region_prior: bool = False) -> np.ndarray:
    """Compute `crlb` for a measurement model, which keeps its whitener for further calls."""
    information = without_nuisance(
        joint_information_of(model, positions), model.scenario).information
    if region_prior:
        information = information + region_information(model.scenario)
    return np.trace(inverse_information(information), axis1=1, axis2=2)


def without_nuisance(joint: np.ndarray, scenario: Scenario) -> Marginal:
    """Integrate `joint_information_of` over nuisance parameters with their priors."""
    prior = np.ones(joint.shape[1])
    prior[:3], precision = 0.0, nuisance_of(scenario).precision
    prior[3:3 + len(precision)] = precision
    return marginalise(joint + np.diag(prior), np.zeros(joint.shape[:2]))


def inverse_information(information: np.ndarray) -> np.ndarray:
    """Invert Fisher information matrices, float64 [N, 3, 3] [1/m^2].

    If a matrix is not positive definite up to rounding, the diagonal of its inverse is infinite.
    """
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    # With a unit diagonal, rounding does not depend on the units of the axes.
    scale = scale[:, :, None] * scale[:, None, :]
    normal = information / scale
    # An explicit L D L^T factorisation is as accurate as the condition number allows, and much
    # faster than a LAPACK call per matrix.
    first, third = normal[:, 1, 0], normal[:, 2, 0]
    pivot = 1.0 - first**2
    regular = (diagonal > 0).all(axis=1) & (pivot > _MIN_PIVOT)
    pivot = np.where(regular, pivot, 1.0)
    second = (normal[:, 2, 1] - first * third) / pivot
    last = normal[:, 2, 2] - third**2 - second**2 * pivot
    regular &= last > _MIN_PIVOT * (1 + second**2)
    last = np.where(regular, last, 1.0)
    root = np.zeros_like(normal)
    root[:, 0, 0] = 1.0
    root[:, 1, 0], root[:, 1, 1] = -first, 1.0
    root[:, 2, 0], root[:, 2, 1], root[:, 2, 2] = first * second - third, -second, 1.0
    root[:, 1] /= np.sqrt(pivot)[:, None]
    root[:, 2] /= np.sqrt(last)[:, None]
    inverse = np.matmul(np.swapaxes(root, 1, 2), root) / scale
    inverse[~regular] = np.diag([np.inf] * 3)
    return inverse


def fisher_information(model: MeasurementModel, positions: np.ndarray) -> np.ndarray:
    """Implements Eq. (12). Fisher information about the position, with known nuisance parameters.

    Takes positions of the user, float64 [N, 3] [m]. Returns I_FIM, float64 [N, 3, 3] [1/m^2].
    """
    return joint_information_of(model, positions)[:, :3, :3]


def joint_information_of(model: MeasurementModel, positions: np.ndarray) -> np.ndarray:
    """Compute the information about position and nuisance parameters, without any prior.

    Returns float64 [N, 3 + Q, 3 + Q], for Q nuisance parameters scaled to unit variance. Those of
    the velocity come last; users of positions without velocities stand still.
    """
    states, std = checked_states(positions), velocity_std_mps(model.scenario)
    patterns, moving = nuisance_of(model.scenario).scaled_patterns, std > 0
    times_s = measurement_times_s(model.scenario)
    information = np.empty((len(states), *[3 + len(patterns) + np.count_nonzero(moving)] * 2))

    def fill(block: slice) -> None:
        mean, slopes = model.mean_and_jacobian(states[block])
        by_velocity = slopes[:, 3:] if slopes.shape[1] > 3 else slopes * times_s
        rows = np.concatenate([
            slopes[:, :3], patterns * mean[:, None],
            std[moving, None, None] * by_velocity[:, moving]], axis=1)
        whitened = np.matmul(np.swapaxes(rows, 1, 2), np.swapaxes(model.whitener, 1, 2))
        information[block] = np.sum([
            quadratic_form(whitened[:, band]) for band in range(len(model.whitener))], axis=0)

    map_blocks(fill, blocks(len(positions), _BLOCK))
    return information


@one_blas_thread
def site_information(surfaces: Iterable[MeasurementModel], positions: np.ndarray) -> np.ndarray:
    """Add up the Fisher information of the surfaces, float64 [N, 3, 3] [1/m^2].

    Each surface has the pose of its scenario. Takes positions of the user, float64 [N, 3] [m], or
    with columns for the velocity, [N, 6] [m, m/s], in the frame of the site, in front of every
    surface. A declared velocity is unknown, and the same for all surfaces; its prior is that of
    the first one. Noise, multipath, other nuisance parameters and errors of the poses are
    independent for each surface and cycle. Raises ValueError if a position is not in front of a
    surface.
    """
    states = numbers('positions', positions, shapes=[('N', 3), ('N', 6)])
    total = np.zeros((len(states), 6, 6))
    # How position and velocity depend on the position and a velocity of unit variance.
    by_prior = np.eye(6)[:, :3]
    for number, model in enumerate(surfaces):
        total += _information_in_site(model, states)
        if not number:
            std = velocity_std_mps(model.scenario)
            by_velocity = np.vstack([np.zeros((3, 3)), model.scenario.pose.rotation * std])
            by_prior = np.hstack([by_prior, by_velocity[:, std > 0]])
    scaled = by_prior.T @ total @ by_prior + np.diag(np.arange(by_prior.shape[1]) > 2)
    found = marginalise(scaled, np.zeros(scaled.shape[:2])).information
    return (found + np.swapaxes(found, 1, 2)) / 2


def _information_in_site(model: MeasurementModel, states: np.ndarray) -> np.ndarray:
    """Return the information of one surface about position and velocity, float64 [N, 6, 6]."""
    pose, std = model.scenario.pose, velocity_std_mps(model.scenario)
    joint = joint_information_of(model, pose.states_to_surface(states))
    precision, moving = nuisance_of(model.scenario).precision, std > 0
    others = np.arange(3, 3 + len(precision))
    joint[:, others, others] += precision
    kept = np.setdiff1d(np.arange(joint.shape[1]), others)
    order = np.append(kept, others)
    known = marginalise(
        joint[:, order[:, None], order], np.zeros(joint.shape[:2]), len(kept)).information
    by_site = np.zeros((len(kept), 6))
    by_site[:3, :3] = pose.rotation.T
    by_site[3:, 3:] = pose.rotation.T[moving] / std[moving, None]
    information = by_site.T @ known @ by_site
    # The errors of the pose add their covariance to the inverse of the information.
    widened = np.tile(np.eye(6), (len(states), 1, 1))
    widened[:, :, :3] += np.matmul(information[:, :, :3], pose.spread(states[:, :3]))
    return np.linalg.solve(widened, information)


def site_crlb(surfaces: Iterable[MeasurementModel], positions: np.ndarray) -> np.ndarray:
    """Compute the bound on the mean squared positioning error, float64 [N] [m^2].

    Takes the arguments of `site_information`. The bound is infinite where the information is
    singular.
    """
    information = site_information(surfaces, positions)
    return np.trace(inverse_information(information), axis1=1, axis2=2)
