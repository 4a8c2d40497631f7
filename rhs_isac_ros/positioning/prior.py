"""The update of a mixture with the signals of a phase: a prior times a likelihood.

Mixtures are Gaussian in the coordinates of the site. A mode of the likelihood is a sheet around
its surface: in x, y and z, its Gaussian would be flat, and the product would be at a wrong place.
Components therefore become Gaussians in range and direction cosines for the update, with the
moments that they have in these coordinates, and return afterwards. Coordinates after the third
one, such as velocities, remain those of the site.

Every mode updates every component. The likelihood is then evaluated at the heaviest products,
because errors of the modes' Gaussians accumulate over successive phases and favour wrong modes.
"""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.gaussian import likelihood_loss, moments, step_to_maximum, symmetric
from rhs_isac_ros.model.geometry import (
    jacobian,
    polar_derivative,
    to_polar,
    to_positions,
)
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.positioning.estimate import regular
from rhs_isac_ros.positioning.lattice import PHASE_ERROR, Grid, Resolution
from rhs_isac_ros.positioning.likelihood import Likelihood, Signals
from rhs_isac_ros.positioning.mixture import Mixture, log_volume
from rhs_isac_ros.positioning.region import Restricted, move_inside
from rhs_isac_ros.positioning.search import EXACT_MARGIN, Modes
from rhs_isac_ros.positioning.segments import concatenate, select

# Probability that a prior does not hold.
WRONG = 0.1
# Smallest extent of the region of which modes are part without a prior [m].
MIN_EXTENT_M = 1.0


class _Limits(NamedTuple):
    """Numbers that trade the speed of an update for its accuracy; weights are logarithms."""

    # Reach of a component in the search, in standard deviations of each coordinate. Components
    # whose squared Mahalanobis distance is below a limit are searched together.
    reach: float = 4.0
    boxes: int = 12
    same_box: float = 9.0
    # Maximum number of products of a component and a mode, and of those at which the likelihood is
    # evaluated.
    products: int = 160
    exact: int = 16
    # Components with a smaller weight, or with a smaller density in the region relative to their
    # largest one, do not contribute to moments.
    weight: float = -9.0
    density: float = 0.01
    # Smallest x of a position [m], and smallest cosine of its angle from boresight in curvatures;
    # no user is behind the surface.
    x_m: float = 1e-3
    cosine: float = 0.05
    # Share of true priors that are doubted.
    doubt: float = 0.02


_LIMITS = _Limits()
# Negative logarithm of the density at the end of a component's reach, by which modes there may be
# less likely than others.
PRIOR_MARGIN = _LIMITS.reach**2 / 2
# Log-likelihood of a mode that the search has missed, relative to the best mode. The search finds
# all modes above this value.
_FLOOR = -(EXACT_MARGIN + PRIOR_MARGIN)


def bend(mixture: Mixture, pose: Pose) -> Mixture:
    """Convert a mixture of the site to (r [m], u, v) around a surface; other coordinates stay."""
    positions = pose.to_surface(mixture.means[:, :3])
    positions[:, 0] = np.maximum(positions[:, 0], _LIMITS.x_m)
    points = to_polar(positions)
    bent = _converted(mixture, points, polar_derivative(points) @ pose.rotation.T)
    # The second derivative of the range is the projection across the line of sight over the range.
    sight = positions / points[:, :1]
    across = np.eye(3) - sight[:, :, None] * sight[:, None, :]
    longer_m, variance_m2 = _moments_of_square(
        across / points[:, :1, None],
        pose.covariances_to_surface(mixture.covariances[:, :3, :3]))
    bent.means[:, 0] += longer_m
    bent.covariances[:, 0, 0] += variance_m2
    return bent


def flatten(bent: Mixture, pose: Pose) -> Mixture:
    """Convert a mixture from (r [m], u, v) back to the coordinates of the site."""
    points, cosines = bent.means[:, :3], bent.means[:, 1:3]
    mixture = _converted(
        bent, pose.to_site(to_positions(points)), pose.rotation @ jacobian(points))
    # Of the position, only x = r (1 - u^2 - v^2)^(1/2) is curved in u and v.
    w = np.sqrt(np.maximum(1 - np.sum(cosines**2, axis=1), _LIMITS.cosine**2))[:, None, None]
    bending = -points[:, :1, None] * (
        np.eye(2) / w + cosines[:, :, None] * cosines[:, None, :] / w**3)
    shift_m, variance_m2 = _moments_of_square(bending, bent.covariances[:, 1:3, 1:3])
    outward = pose.rotation[:, 0]
    mixture.means[:, :3] += shift_m[:, None] * outward
    mixture.covariances[:, :3, :3] += variance_m2[:, None, None] * np.outer(outward, outward)
    return mixture


def _converted(mixture: Mixture, points: np.ndarray, derivative: np.ndarray) -> Mixture:
    """Replace the first three coordinates, which have the given derivative, [C, 3, 3]."""
    means, covariances = mixture.means.copy(), mixture.covariances.copy()
    means[:, :3] = points
    covariances[:, :3] = derivative @ covariances[:, :3]
    covariances[:, :, :3] = covariances[:, :, :3] @ np.swapaxes(derivative, 1, 2)
    return mixture._replace(means=means, covariances=covariances)


def _moments_of_square(matrices: np.ndarray, covariances: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance, [C], of d^T H d / 2 for Gaussian d of covariance [C, n, n]."""
    product = matrices @ covariances
    return (np.trace(product, axis1=1, axis2=2) / 2,
            np.einsum('cpq,cqp->c', product, product) / 2)


def cells_of(bent: Mixture, grid: Grid, resolution: Resolution) -> np.ndarray:
    """Mark the cells in which a prior in (r [m], u, v) requires a search, bool [C]."""
    half = np.column_stack([
        grid.widths_m[grid.range_bin] / 2,
        np.tile(PHASE_ERROR * resolution.direction, (len(grid.node), 1))])
    merged = bent.position().reduce(_LIMITS.boxes, _LIMITS.same_box)
    points, chosen = grid.points, np.zeros(len(grid.node), bool)
    for mean, covariance in zip(merged.means, merged.covariances, strict=True):
        reach = _LIMITS.reach * np.sqrt(np.diagonal(covariance))
        chosen |= (np.abs(points - mean) <= reach + half).all(axis=1)
    return chosen


class Products(NamedTuple):
    """Products of T pairs of a component of the prior and a mode, and components without a mode.

    The mixture is not normalised: its mass is the average of the likelihood over the prior.
    """

    bent: Mixture  #: In (r [m], u, v); the products come first.
    #: Energy of the residual at the heaviest product inside the region, plus half of the squared
    #: Mahalanobis distance from its component.
    energy: float
    is_last: bool  #: Whether the heaviest product is that of the last component.


def multiply(bent: Mixture, modes: Modes, share: float, likelihood: Likelihood | None,
             signals: Signals, bounds_m: np.ndarray) -> Products:
    """Multiply a prior in (r [m], u, v) by the likelihood of the signals of one phase, N = 1.

    `likelihood`, if given, is evaluated at the heaviest products. Each component is also kept
    without an update, for an unlikely mode that the search may have missed; it is assumed to be as
    wide as the best mode. `share`, from 0 to 1, is an exponent of the likelihood: below 1 if
    successive multipath is similar.
    """
    spread = np.linalg.inv(modes.curvature) / share
    offsets = modes.centres[:, None] - bent.means[:, :3]
    log_weights, precision = _evidence(offsets, bent.covariances[:, :3, :3], spread[:, None])
    log_weights += share * modes.log_likelihood[:, None] + bent.log_weights
    mode, component = np.unravel_index(
        np.argsort(-log_weights, axis=None, kind='stable')[:_LIMITS.products], log_weights.shape)
    chosen = select(bent, component)._replace(log_weights=log_weights[mode, component])
    found = _shifted(chosen, precision[mode, component], offsets[mode, component])
    if likelihood is not None:
        # The heaviest products come first.
        n = _LIMITS.exact
        exact = _exact(
            select(bent, component[:n]), found.means[:n, :3], share, likelihood, signals)
        found = concatenate(exact, select(found, slice(n, None)))
    # The best mode comes first.
    floor, _ = _evidence(np.zeros(3), bent.covariances[:, :3, :3], spread[0])
    floor += share * (modes.log_likelihood[0] + _FLOOR)
    best = int(np.argmax(found.log_weights))
    energy = _energy(found.means[best, :3], select(bent, component[[best]]),
                     select(modes, mode[[best]]), bounds_m)
    return Products(concatenate(found, bent.weighted(floor)), energy,
                    bool(component[best] == len(bent.log_weights) - 1))


def _energy(point: np.ndarray, component: Mixture, mode: Modes, bounds_m: np.ndarray) -> float:
    """Return `Products.energy` for the product of a component and a mode at a point [3]."""
    precision = np.linalg.inv(component.covariances[:, :3, :3])
    point = move_inside(point[None], precision + mode.curvature, bounds_m)
    losses = mode.residual + likelihood_loss(point - mode.centres, mode.curvature) + (
        likelihood_loss(point - component.means[:, :3], precision))
    return float(losses[0])


def _exact(bent: Mixture, points: np.ndarray, share: float, likelihood: Likelihood,
           signals: Signals) -> Mixture:
    """Update each component with the likelihood expanded at its own point (r, u, v), [C, 3]."""
    value, gradient, curvature, _ = likelihood.local(
        points, np.zeros((len(points), 0)), signals)
    step = step_to_maximum(curvature, gradient)
    offsets = points + step - bent.means[:, :3]
    log_weights, precision = _evidence(
        offsets, bent.covariances[:, :3, :3], np.linalg.inv(curvature) / share)
    log_weights += share * (value + np.sum(gradient * step, axis=1) / 2)
    return _shifted(bent.weighted(log_weights), precision, offsets)


def _evidence(
        offsets: np.ndarray, predicted: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the product of a Gaussian density and a Gaussian with the maximum 1.

    Takes the differences of the means, float64 [..., 3], and both covariances. Returns the
    logarithm, float64 [...], and the precision of the offset, float64 [..., 3, 3].
    """
    total = predicted + spread
    precision = np.linalg.inv(total)
    distance = np.einsum('...p,...pq,...q->...', offsets, precision, offsets)
    log_value = (np.linalg.slogdet(spread)[1] - np.linalg.slogdet(total)[1] - distance) / 2
    return log_value, precision


def _shifted(mixture: Mixture, precision: np.ndarray, offsets: np.ndarray) -> Mixture:
    """Apply the Kalman update with innovations [C, 3] and their precision [C, 3, 3]."""
    gain = np.matmul(mixture.covariances[:, :, :3], precision)
    means = mixture.means + np.matmul(gain, offsets[..., None])[..., 0]
    covariances = mixture.covariances - np.matmul(gain, mixture.covariances[:, :3])
    return mixture._replace(means=means, covariances=symmetric(covariances))


def is_doubtful(energy: float, n: int) -> bool:
    """Return whether an energy of `Products`, of n numbers, is unusual for a true prior."""
    from scipy.special import gammainccinv

    return energy > float(gammainccinv(n, _LIMITS.doubt))


def uniform(modes: Modes, bounds_m: np.ndarray, share: float = 1.0) -> Mixture:
    """Multiply the likelihood by a uniform prior on the region with bounds [2, 3] [m].

    Returns a mixture in (r [m], u, v) that is not normalised, D = 3.
    """
    covariances = np.linalg.inv(modes.curvature) / share
    extent_m = np.maximum(np.ptp(bounds_m, axis=0), MIN_EXTENT_M)
    log_mass = (np.log(np.linalg.det(jacobian(modes.points))) + log_volume(covariances)
                - np.log(extent_m).sum())
    return Mixture(share * modes.log_likelihood + log_mass, modes.points, covariances)


def inside(bent: Mixture, bounds_m: np.ndarray, normal: np.ndarray
           ) -> tuple[Mixture, np.ndarray, np.ndarray]:
    """Restrict a mixture in (r [m], u, v) to the region with bounds [2, 3] [m].

    Returns the normalised mixture without components outside of the region, and the mean [3] [m]
    and covariance of the position inside. `normal`, float64 [S, 3], contains points that represent
    a standard Gaussian.
    """
    heavy = bent.log_weights >= bent.log_mass + _LIMITS.weight
    bent, light = select(bent, heavy), select(bent, ~heavy)
    precision = np.linalg.inv(bent.covariances[:, :3, :3])
    points = to_polar(np.clip(to_positions(bent.means[:, :3]), *bounds_m))
    offsets = bent.means[:, :3] - points
    gaussians = Restricted.of(
        points, np.matmul(precision, offsets[..., None])[..., 0], precision, bounds_m)
    peaks = gaussians.logarithm(gaussians.nearest()[:, None])[:, 0]
    reaches = peaks - likelihood_loss(offsets, precision) >= np.log(_LIMITS.density)
    chosen = reaches if reaches.any() else np.ones(len(reaches), bool)
    bent, gaussians = select(bent, chosen), select(gaussians, chosen)
    positions, log_ratio = gaussians.sample(normal)
    # The density of a position is that of (r, u, v) divided by the volume element.
    log_weights = bent.log_weights[:, None] + gaussians.logarithm(positions) + log_ratio
    log_density = np.linalg.slogdet(precision)[1] / 2 - likelihood_loss(offsets, precision)
    log_weights += log_density[chosen, None]
    flat = positions.reshape(-1, 3)
    log_weights -= np.log(np.linalg.det(jacobian(to_polar(flat)))).reshape(log_weights.shape)
    weights, _ = mixture_weights(log_weights.ravel())
    mean, covariance = moments(weights, flat)
    return concatenate(bent, light).normalised(), mean, regular(covariance)
