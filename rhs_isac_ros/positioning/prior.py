"""The update of a mixture with the signals of a phase: a prior times a likelihood.

Mixtures are Gaussian in the coordinates of the site. A mode of the likelihood is a sheet around
its surface: in x, y and z, its Gaussian would be flat, and the product would be at a wrong place.
Components therefore become Gaussians in range and direction cosines for the update, with the
moments that they have in these coordinates, and return afterwards. Coordinates after the third
one, such as velocities, remain those of the site.

Every mode updates every component. The likelihood is then evaluated at the heaviest products,
because errors of the modes' Gaussians accumulate over successive phases and favour wrong modes.

Errors of elements turn the same signals in each phase, and are counted once. Their share of the
variance of a position is known, because the signals are linear in them. A track is therefore that
of a position with these errors, which nearly move along with the user while the track remembers;
their covariance is added to its result. Between modes, the evidence of phases with the same error
grows more slowly than their number. `fusion` treats errors of poses in the same way.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.gaussian import likelihood_loss, moments, quadratic_form
from rhs_isac_ros.model.geometry import jacobian, region_information, to_polar
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.pose import Pose
from rhs_isac_ros.positioning.estimate import regular
from rhs_isac_ros.positioning.lattice import PHASE_ERROR, Grid, Resolution
from rhs_isac_ros.positioning.likelihood import Conditional, Likelihood, Signals
from rhs_isac_ros.positioning.mixture import Mixture, overlap, velocity_variance
from rhs_isac_ros.positioning.search import EXACT_MARGIN, Modes, expanded_at
from rhs_isac_ros.positioning.segments import concatenate, select
from rhs_isac_ros.positioning.sheets import Sheets, move_inside
from rhs_isac_ros.support import streams

# Probability that a prior does not hold.
WRONG = 0.1
# Probability that a user is anywhere in the region although a posterior is far outside.
ELSEWHERE = 1e-12
# Smallest extent of the region of which modes are part without a prior [m].
MIN_EXTENT_M = 1.0
# Reach of a component in the search, in standard deviations of each coordinate. Components whose
# squared Mahalanobis distance is below a limit are searched together.
_REACH = 4.0
_BOXES = 12
_SAME_BOX = 9.0
# Maximum number of products of a component and a mode, and of those at which the likelihood is
# evaluated.
_PRODUCTS = 160
_EXACT = 16
# Components with a smaller log-weight, or with a smaller density in the region relative to their
# largest one, do not contribute to moments.
_WEIGHT = -9.0
_DENSITY = 0.01
# Maximum number of components of a posterior of mixtures, each of which meets all of a phase.
_COMPONENTS = 24
# Share of true priors that are doubted.
_DOUBT = 0.02
# Shares of variances that errors of elements cause: number of positions over which they are
# averaged, and the largest share.
_NODES = 32
_MOST = 0.98
# Negative logarithm of the density at the end of a component's reach, by which modes there may be
# less likely than others.
PRIOR_MARGIN = _REACH**2 / 2
# Log-likelihood of a mode that the search has missed, relative to the best mode. The search finds
# all modes above this value.
_FLOOR = -(EXACT_MARGIN + PRIOR_MARGIN)


def cells_of(bent: Sheets, grid: Grid, resolution: Resolution) -> np.ndarray:
    """Mark the cells in which a prior in (r [m], u, v) requires a search, bool [C]."""
    if not len(bent.means):  # All of the prior is behind the surface.
        return np.zeros(len(grid.node), bool)
    merged = bent.position().reduce(_BOXES, _SAME_BOX)
    reach = _REACH * np.sqrt(np.diagonal(merged.covariances, axis1=1, axis2=2))[:, None]
    offsets_m = np.abs(grid.ranges_m - merged.means[:, :1])
    in_range = offsets_m <= reach[..., 0] + grid.widths_m / 2
    offsets = np.abs(grid.nodes[:, 1:] - merged.means[:, None, 1:])
    beside = (offsets <= reach[..., 1:] + PHASE_ERROR * resolution.direction).all(axis=2)
    return (in_range[:, grid.range_bin] & beside[:, grid.node]).any(axis=0)


class Users(NamedTuple):
    """What is known of users without signals, in the frame of the site."""

    centre_m: np.ndarray  # Of the region, float64 [3].
    squares_m2: np.ndarray  # Squared edges of the region as a covariance, float64 [3, 3].
    log_volume: float
    velocity: np.ndarray  # Covariance of velocities in a cycle, float64 [3, 3] [m^2/s^2].

    @classmethod
    def of(cls, scenario: Scenario, bounds_m: np.ndarray, pose: Pose) -> 'Users':
        """Take the bounds of the region around a pose, float64 [2, 3] [m]."""
        size_m = np.ptp(bounds_m, axis=0)
        size_m = np.where(size_m > 0, size_m, MIN_EXTENT_M)
        return cls(pose.to_site(bounds_m.mean(axis=0)),
                   pose.covariances_to_site(np.diag(size_m**2)), float(np.log(size_m).sum()),
                   pose.covariances_to_site(
                       velocity_variance(scenario.user_speed_std_mps, bounds_m)))

    def updated(self, prior: Mixture, likelihood: Mixture, missing: float, share: float,
                wrong: float) -> Mixture:
        """Multiply a prior by a likelihood of positions, or also of velocities.

        A likelihood of velocities contains their declared density, which a prior of positions
        takes over. `missing` is the probability that the likelihood does not contain the position,
        `share` its exponent, and `wrong` the probability that the prior does not hold.
        """
        likelihood = likelihood.fresh
        if likelihood.means.shape[1] > 3:
            prior = prior.at_velocities(self.velocity)
            likelihood = likelihood.without_prior(self.velocity)
        prior = prior.or_within(self.centre_m, self.squares_m2, wrong)
        seen = prior.product(likelihood.powered(share)).weighted(np.log1p(-missing))
        unseen = prior.weighted(np.log(missing) - self.log_volume)
        return concatenate(seen, unseen).normalised().reduce(_COMPONENTS)


class Products(NamedTuple):
    """Products of T pairs of a component of the prior and a mode, and components without a mode.

    The density is not normalised: its mass is the average of the likelihood over the prior.
    """

    bent: Sheets  #: The products come first.
    #: Energy of the residual at the heaviest product inside the region, plus half of the squared
    #: Mahalanobis distance from its component.
    energy: float
    is_last: bool  #: Whether the heaviest product is that of the last component.
    best: Sheets  #: The mode of the heaviest product, with all errors.


def multiply(bent: Sheets, modes: Modes, share: float, conditionals: Sequence[Conditional],
             likelihood: Likelihood, signals: Signals, bounds_m: np.ndarray,
             constant: np.ndarray, n_before: float = 0.0) -> Products:
    """Multiply a prior by the likelihood of the signals of one phase, N = 1.

    The likelihoods for the states of the surface, `conditionals`, are evaluated at the heaviest
    products. Each component is also kept without an update, for an unlikely mode that the search
    may have missed; it is assumed to be as wide as the best mode. `share`, from 0 to 1, is an
    exponent of the likelihood: below 1 if successive multipath is similar. `constant` and
    `n_before` are those of `Sheets.narrowed`.
    """
    whole = modes.sheets(share)
    sheets = whole.narrowed(constant, n_before)
    component, mode = bent.heaviest_pairs(sheets, _PRODUCTS)
    chosen = select(bent, component)
    found = chosen.updated(select(sheets, mode))
    # The heaviest products come first.
    n = _EXACT
    exact = select(chosen, slice(n)).updated(
        _expanded(found.means[:n, :3], select(modes, mode[:n]), share, conditionals, likelihood,
                  signals).narrowed(constant, n_before))
    found = concatenate(exact, select(found, slice(n, None)))
    # The best mode comes first.
    missed, _ = overlap(np.zeros(3), bent.covariances[:, :3, :3] + sheets.covariances[0])
    missed += sheets.log_weights[0] + share * _FLOOR
    best = int(np.argmax(found.log_weights))
    energy = _energy(found.means[best, :3], select(bent, component[[best]]),
                     select(modes, mode[[best]]), bounds_m)
    return Products(concatenate(found, bent.weighted(missed)), energy,
                    bool(component[best] == len(bent.log_weights) - 1),
                    select(whole, mode[[best]]))


def _energy(point: np.ndarray, component: Sheets, mode: Modes, bounds_m: np.ndarray) -> float:
    """Return `Products.energy` for the product of a component and a mode at a point [3]."""
    precision = np.linalg.inv(component.covariances[:, :3, :3])
    point = move_inside(point[None], precision + mode.curvature, bounds_m)
    losses = mode.residual + likelihood_loss(point - mode.centres, mode.curvature) + (
        likelihood_loss(point - component.means[:, :3], precision))
    return float(losses[0])


def _expanded(points: np.ndarray, modes: Modes, share: float, conditionals: Sequence[Conditional],
              likelihood: Likelihood, signals: Signals) -> Sheets:
    """Expand the likelihood at points (r, u, v) in C modes, [C, 3]; each has one sheet."""
    values = likelihood.nuisance.carried(modes.values, modes.points, points)
    value, gradient, curvature = (np.empty((len(points), *shape)) for shape in ((), (3,), (3, 3)))
    for state in np.unique(modes.state):
        (rows,) = np.nonzero(modes.state == state)
        value[rows], gradient[rows], curvature[rows] = expanded_at(
            conditionals[state], likelihood, points[rows], values[rows],
            select(signals, np.zeros(len(rows), int)))
    return Sheets.expanded(points, gradient, curvature, value, share)


def is_doubtful(energy: float, n: int) -> bool:
    """Return whether an energy of `Products`, of n numbers, is unusual for a true prior."""
    from scipy.special import gammainccinv

    return energy > float(gammainccinv(n, _DOUBT))


def uniform(sheets: Sheets, bounds_m: np.ndarray) -> Sheets:
    """Multiply a likelihood by a uniform prior on the region with bounds [2, 3] [m].

    Sheets with a maximum outside of the region begin at their best point inside.
    """
    extent_m = np.maximum(np.ptp(bounds_m, axis=0), MIN_EXTENT_M)
    precision = np.linalg.inv(sheets.covariances)
    points = move_inside(sheets.means, precision, bounds_m)
    loss = likelihood_loss(points - sheets.means, precision)
    return sheets._replace(means=points).weighted(-loss - np.log(extent_m).sum()).as_density()


def inside(density: Sheets, bounds_m: np.ndarray, normal: np.ndarray, pose: Pose
           ) -> tuple[Sheets, Mixture]:
    """Restrict a density to the region with bounds [2, 3] [m] in the frame of the surface.

    Returns the normalised density without components outside of the region, and the mixture of
    those inside, normalised, in the frame of the site. `normal`, float64 [S, 3], contains points
    that represent a standard Gaussian.
    """
    heavy = density.log_weights >= density.log_mass + _WEIGHT
    density, light = select(density, heavy), select(density, ~heavy)
    gaussians = density.inside(bounds_m)
    peaks = gaussians.logarithm(gaussians.nearest()[:, None])[:, 0]
    reaches = peaks - density.position().log_peaks >= np.log(_DENSITY)
    chosen = reaches if reaches.any() else np.ones(len(reaches), bool)
    density, gaussians = select(density, chosen), select(gaussians, chosen)
    positions, log_ratio = gaussians.sample(normal)
    points = to_polar(positions)
    # The density of a position is that of (r, u, v) divided by the volume element.
    volume = np.log(np.linalg.det(jacobian(points.reshape(-1, 3)))).reshape(log_ratio.shape)
    weights, log_weights = mixture_weights(gaussians.logarithm(positions) + log_ratio - volume)
    among = np.linalg.inv(density.covariances[:, :3, :3])
    gain = np.swapaxes(density.covariances[:, 3:, :3] @ among, 1, 2)
    rates = density.means[:, None, 3:] + np.matmul(points - density.means[:, None, :3], gain)
    means, covariances = moments(weights, np.concatenate([pose.to_site(positions), rates], axis=2))
    covariances[:, 3:, 3:] += density.covariances[:, 3:, 3:] - np.matmul(
        density.covariances[:, 3:, :3], gain)
    mixture = Mixture._make((log_weights, means, regular(covariances))).normalised()
    return concatenate(density, light).normalised(), mixture


def constant_shares(model: MeasurementModel) -> np.ndarray:
    """Return the shares of the variances of (r, u, v) that errors of elements cause, float64 [3].

    They are averages over the region of interest.
    """
    if model.elements.is_exact:
        return np.zeros(3)
    scenario, (low, high) = model.scenario, model.scenario.roi_bounds_m
    positions = low + streams.unit_points()[:_NODES] * (high - low)
    by_point = jacobian(to_polar(positions))
    mean, slopes = model.mean_and_jacobian(positions, by_point)
    nuisance = nuisance_of(scenario)
    slopes = model.whiten(np.concatenate(
        [slopes, nuisance.scaled_patterns * mean[:, None]], axis=1))
    prior = np.eye(slopes.shape[1])
    prior[3:, 3:] *= nuisance.precision
    information = quadratic_form(slopes.reshape(*slopes.shape[:2], -1)) + prior
    information[:, :3, :3] += (
        np.swapaxes(by_point, 1, 2) @ region_information(scenario) @ by_point) - np.eye(3)
    pulls = np.zeros_like(information)
    _, direct = model.elements.errors(scenario, model.beams)
    for band, whitener in enumerate(model.whitener):
        pulls += quadratic_form(slopes[:, :, band].conj() @ (whitener @ direct(band, positions)))
    variances = np.linalg.inv(information)
    constant = variances @ pulls @ variances
    shares = np.diagonal(constant, axis1=1, axis2=2) / np.diagonal(variances, axis1=1, axis2=2)
    return np.minimum(shares[:, :3].mean(axis=0), _MOST)


def constant_covariance(sheet: Sheets, shares: np.ndarray, pose: Pose) -> np.ndarray:
    """Return the covariance of the errors of elements at a sheet, C = 1, in the site.

    The result is float64 [3, 3] [m^2]; `shares` are those of `constant_shares`.
    """
    by_point = pose.rotation @ jacobian(sheet.means)[0] * np.sqrt(shares)
    return by_point @ sheet.covariances[0] @ by_point.T
