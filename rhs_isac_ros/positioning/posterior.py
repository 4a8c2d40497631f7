"""The posterior of a position: weighted samples of its modes, in the region of interest.

A mode is usually Gaussian, and `sheets` draws samples of it inside the region. If every band has
an unknown phase of its own, only delays, amplitudes and the curvature of the wavefront determine
the range. A mode then extends over metres, across which the log-likelihood is not quadratic.
Samples are then drawn from wider Gaussians, and their weights follow from the likelihood at each
of them. Such modes may overlap; a sample counts for its own mode in proportion to the densities
of all.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import evenly_spread, mixture_weights
from rhs_isac_ros.model.gaussian import marginalise, moments, symmetric
from rhs_isac_ros.model.geometry import to_polar, to_positions
from rhs_isac_ros.model.impairments import UNIFORM_STD_RAD
from rhs_isac_ros.positioning.estimate import regular
from rhs_isac_ros.positioning.lattice import carrier_wavenumbers
from rhs_isac_ros.positioning.likelihood import Conditional, Likelihood, Signals
from rhs_isac_ros.positioning.mixture import Mixture
from rhs_isac_ros.positioning.search import Modes, marginal_at
from rhs_isac_ros.positioning.segments import Segments, select
from rhs_isac_ros.positioning.sheets import Inside, Sheets

# Factor by which a proposal is wider than its Gaussian, because the tails of the posterior may be
# heavier.
_SPREAD = 1.3
# Samples with a log-weight below the best by more than this have no effect, whatever their phases.
_MARGIN = 20.0
# Averages over the phases of the bands: spacing of the ranges, in standard deviations of the
# product of the bands' factors; and number of values of a phase that all bands share, few because
# the average over the range nearly removes the effect of this phase.
_SPACING = 1.5
_COMMON = 8
# Powers that flatten weights: ratio of successive ones, and largest number of them.
_FLATTER = 0.8
_POWERS = 40
# Largest standard deviation of a wrapped phase: it is nearly uniform, and one wrap suffices.
# Smallest one: with phases that are known better, few samples would carry the weight.
_PHASE_STD_RAD = 3.0
_LEAST_STD_RAD = 0.05


class Samples(NamedTuple):
    """The samples of the posteriors of N shots in the region, S samples for each of M modes."""

    # Float64 [M, S, 3] [m], or [M, S, 6] [m, m/s] with velocities.
    positions: np.ndarray
    weights: np.ndarray  # Float64 [M, S]; their sum is 1 for each shot.
    of_shot: Segments  # The modes of each shot.
    log_evidence: np.ndarray  # Logarithms of the likelihood averaged over the region, [N].
    # Relative increase of covariances because there are few samples, float64 [N].
    few: np.ndarray

    @classmethod
    def of(cls, positions: np.ndarray, log_weights: np.ndarray, shots: np.ndarray,
           n_fitted: int = 0) -> 'Samples':
        """Normalise the weights of each shot; the density is relative to a uniform prior.

        Takes log-weights [M, S], and the shots of the modes, int [M]. Given n independent samples
        of a Gaussian with D unknown coordinates, one more sample has a Student distribution, whose
        covariance is (n + 1) / (n - D - 2) times theirs. `n_fitted` is D + 2, or 0 for points that
        represent the covariance well; n is the effective number of samples. The covariance of a
        few samples may be arbitrarily small: if n is below twice `n_fitted`, the weights are
        raised to the power with which it is not.
        """
        of_shot = Segments.of_keys(shots)
        highest = of_shot.max(log_weights.max(axis=1))
        relative = log_weights - of_shot.repeat(highest)[:, None]
        totals = of_shot.sum(np.exp(relative).sum(axis=1))
        powers = np.ones(len(totals))
        for _ in range(_POWERS):
            weights = np.exp(relative * of_shot.repeat(powers)[:, None])
            weights /= of_shot.repeat(of_shot.sum(weights.sum(axis=1)))[:, None]
            n = 1 / of_shot.sum(np.einsum('ms,ms->m', weights, weights))
            scarce = n < 2 * n_fitted
            if not scarce.any():
                break
            powers[scarce] *= _FLATTER
        n = np.maximum(n, n_fitted + 1)
        return cls(positions, weights, of_shot,
                   highest + np.log(totals) - np.log(log_weights.shape[1]),
                   (1 + n_fitted) / (n - n_fitted))

    def average(self, values: np.ndarray) -> np.ndarray:
        """Average values of the modes, float64 [M], over each posterior, [N]."""
        return self.of_shot.sum(self.weights.sum(axis=1) * values)

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute the means, float64 [N, D], and covariances, [N, D, D], of the posteriors.

        The covariance includes the uncertainty of moments of few samples.
        """
        of_shot = self.of_shot
        mean = of_shot.sum(np.matmul(self.weights[:, None], self.positions)[:, 0])
        offsets = self.positions - of_shot.repeat(mean)[:, None]
        weighted = np.swapaxes(offsets * self.weights[..., None], 1, 2)
        squares, shift = np.matmul(weighted, offsets), weighted.sum(axis=2)
        shares = np.maximum(self.weights.sum(axis=1), np.finfo(float).tiny)
        within = squares - shift[:, :, None] * shift[:, None] / shares[:, None, None]
        return mean, of_shot.sum(squares) + self.few[:, None, None] * of_shot.sum(within)

    def described(self, n: int, modes: Modes | None, bounds: np.ndarray
                  ) -> tuple[Mixture, Sheets]:
        """Return the posterior of the n-th shot as a mixture, and the likelihood.

        The mixture has the moments of the samples. Without `modes`, those of the shot, so has the
        likelihood, in (r, u, v).
        """
        rows = slice(self.of_shot.starts[n], self.of_shot.ends[n])
        shares = self.weights[rows].sum(axis=1)
        chosen = np.argsort(-shares, kind='stable')[:np.count_nonzero(shares)]
        log_shares, positions = np.log(shares[chosen]), self.positions[rows][chosen]
        weights = self.weights[rows][chosen] / shares[chosen, None]
        means, covariances = moments(weights, positions)
        mixture = Mixture._make((
            log_shares, means, regular(covariances * (1 + self.few[n]))))
        return mixture, modes.sheets() if modes else Sheets.of_density(
            log_shares, *moments(weights, to_polar(positions[..., :3])), bounds)


def draw_samples(modes: Modes, normal: np.ndarray, bounds: np.ndarray) -> Samples:
    """Represent the modes by samples, for a uniform prior between the bounds [2, 3] of the region.

    `normal`, float64 [S, 3], contains points that represent a standard Gaussian.
    """
    gaussians = Inside.of(modes.points, modes.gradient, modes.curvature, bounds,
                          log_values=modes.log_likelihood)
    positions, log_ratio = gaussians.sample(normal)
    return Samples.of(positions, gaussians.logarithm(positions) + log_ratio, modes.shots)


def draw_broad_samples(
        likelihood: Likelihood, conditionals: Sequence[Conditional], phases: 'BandPhases',
        signals: Signals, modes: Modes, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Represent the posterior of one shot by weighted samples of its widened modes.

    `conditionals` contains the likelihood for each state of the surface. Returns the positions,
    float64 [M, S, 3] [m], with columns for a velocity, [M, S, 6] [m, m/s], and the logarithms of
    their weights, [M, S].
    """
    prior, bounds = likelihood.nuisance, likelihood.resolution.bounds_m
    n_moving, widening = prior.velocity.shape[1], _SPREAD**2
    positions, log_weights = Inside.of(
        modes.points, modes.gradient / widening, modes.curvature / widening, bounds
    ).sample(normal)
    velocities = np.zeros((*log_weights.shape, 3 * (n_moving > 0)))
    for state in np.unique(modes.state):
        (rows,) = np.nonzero(modes.state == state)
        points = to_polar(positions[rows]).reshape(-1, 3)
        centres, values = (
            np.repeat(each[rows], len(normal), axis=0) for each in (modes.points, modes.values))
        values = prior.carried(values, centres, points)
        evidence, values, information = marginal_at(
            conditionals[state], likelihood, points, values, signals)
        if n_moving:
            # Velocities are drawn around the best ones, and have the weights of the likelihood.
            joint = marginalise(information, np.zeros(values.shape), n_moving)
            among = joint.information / widening
            white = np.tile(normal[:, 3:3 + n_moving], (len(rows), 1))
            drawn = np.matmul(
                np.linalg.cholesky(symmetric(np.linalg.inv(among))), white[..., None])
            values += np.hstack([drawn, np.matmul(joint.regression, drawn)])[..., 0]
            evidence, values, _ = marginal_at(
                conditionals[state], likelihood, points, values, signals, n_moving)
            evidence += np.sum(white**2, axis=1) / 2 - np.linalg.slogdet(among)[1] / 2
            # SciPy takes long to load, and users at rest do not need it.
            from scipy.special import ndtri

            levels = ndtri(evenly_spread(len(normal)))
            velocities[rows] = prior.velocities(
                values, points, np.tile(levels, len(rows))).reshape(len(rows), -1, 3)
        of_state = select(modes, rows)
        evidence += log_share(points.reshape(len(rows), -1, 3), of_state, likelihood.rates(
            of_state.values, of_state.points)).ravel()
        if phases.is_informative:
            likely = evidence >= evidence.max() - _MARGIN
            outputs = likelihood.at(
                points[likely], values[likely], moves=False, turns=False
            ).outputs(values[likely], signals)
            turns = np.exp(1j * (likelihood.nuisance.phases @ values[likely].T))
            log_factors, shares = phases.factors(outputs.T * turns)
            evidence[likely] += log_factors
            points[likely, 0] += phases.drawn_m(shares)
            positions[rows] = np.clip(
                to_positions(points), *bounds).reshape(len(rows), -1, 3)
        log_weights[rows] += evidence.reshape(len(rows), -1)
    return np.concatenate([positions, velocities], axis=2), log_weights


def log_share(points: np.ndarray, modes: Modes, rates: np.ndarray) -> np.ndarray:
    """Return the logarithm of the share of points [M, S, 3] in their own mode, float64 [M, S].

    Modes overlap. The shares of all modes in a point add up to 1, so that nothing counts twice.
    Modes whose `rates` in steps, [M, 3] or [M, 0], differ by at least 1 do not overlap.
    """
    # Expanded about a common centre, squared distances are matrix products, which are faster.
    n_modes, n_samples, _ = points.shape
    centre = modes.points.mean(axis=0)
    offsets, means = points.reshape(-1, 3) - centre, modes.centres - centre
    spread = np.einsum('mab,mb->ma', modes.curvature, means)
    squares = (np.einsum('pa,pb->pab', offsets, offsets).reshape(-1, 9)
               @ modes.curvature.reshape(-1, 9).T)
    squares += np.einsum('ma,ma->m', means, spread) - 2 * offsets @ spread.T
    exponent = -squares / (2 * _SPREAD**2) + np.linalg.slogdet(modes.curvature)[1] / 2
    is_apart = np.sum((rates[:, None] - rates)**2, axis=2) >= 1
    exponent = np.where(
        is_apart[:, None], -np.inf, exponent.reshape(n_modes, n_samples, n_modes))
    own = exponent[np.arange(n_modes), :, np.arange(n_modes)]
    return own - np.logaddexp.reduce(exponent, axis=2)


class BandPhases:
    """The information in band phases that the search treats as uniform although they are not.

    Compared with uniform phases, the likelihood of a position has one more factor per band: the
    density of the phase of its matched filter's output, a wrapped normal density that noise
    broadens. Along the range, the product of these factors oscillates with the carriers, far
    faster than the rest of the posterior. The product is therefore averaged over one wavelength
    around each sample.
    """

    def __init__(self, likelihood: Likelihood) -> None:
        prior = likelihood.nuisance
        self._std = max(prior.relative_phase_std_rad, _LEAST_STD_RAD)
        # Whether there is information that the search ignores; if not, there are no factors.
        self.is_informative = prior.is_coarse and self._std <= UNIFORM_STD_RAD
        if not self.is_informative:
            return
        wavenumbers = carrier_wavenumbers(likelihood.scenario)
        shared = max(prior.phase_covariance.min(), 0.0) if len(wavenumbers) > 1 else 0.0
        spacing = _SPACING * self._std / np.sqrt(len(wavenumbers))
        n_ranges = int(np.ceil(2 * np.pi / spacing))
        self.offsets_m = (((np.arange(n_ranges) + 0.5) / n_ranges - 0.5)
                          * 2 * np.pi / wavenumbers.mean())
        self._wavenumbers = wavenumbers
        self._common, self._log_weights = _common_phase(np.sqrt(shared))

    def factors(self, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Multiply the bands' factors at P positions, and average over one wavelength of range.

        `outputs`, [N_B, P], are the outputs of the matched filters. Returns the logarithm of the
        average, [P], and the shares of the offsets `offsets_m` in range, [P, R].
        """
        all_turns = self._wavenumbers[:, None, None] * self.offsets_m[:, None] + self._common
        log_factor = np.zeros((outputs.shape[1], *all_turns.shape[1:]))
        for output, turns in zip(outputs, all_turns, strict=True):
            std = self._broadened(np.abs(output))[:, None, None]
            log_factor += _log_density(np.angle(output)[:, None, None] + turns, std)
        log_factor += self._log_weights - np.log(len(self.offsets_m))
        weights, log_total = mixture_weights(log_factor, axis=(1, 2))
        return log_total, weights.sum(axis=2)

    def drawn_m(self, shares: np.ndarray) -> np.ndarray:
        """Draw an offset for each of P positions with these shares, [P, R] [m]."""
        levels = evenly_spread(len(shares))
        cumulative = np.cumsum(shares, axis=1)
        chosen = np.count_nonzero(cumulative < levels[:, None], axis=1)
        return self.offsets_m[np.minimum(chosen, shares.shape[1] - 1)]

    def _broadened(self, magnitude: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the phase of noisy outputs, up to one wrap."""
        # Noise gives the phase a von Mises density, which is approximated by the wrapped normal
        # density with the same first harmonic.
        from scipy.special import i0e, i1e

        concentration = 2 * np.maximum(magnitude, 1e-9)
        variance = self._std**2 - 2 * np.log(i1e(concentration) / i0e(concentration))
        return np.minimum(np.sqrt(variance), _PHASE_STD_RAD)


def _common_phase(std: float) -> tuple[np.ndarray, np.ndarray]:
    """Return values of the phase that all bands share, and the logarithms of their weights."""
    if std == 0:
        return np.zeros(1), np.zeros(1)
    if std > UNIFORM_STD_RAD:
        turns = 2 * np.pi * np.arange(_COMMON) / _COMMON
        return turns, np.full(_COMMON, -np.log(_COMMON))
    values, weights = np.polynomial.hermite_e.hermegauss(_COMMON)
    return std * values, np.log(weights / weights.sum())


def _log_density(angle: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Return the log-density of the wrapped normal distribution relative to the uniform one."""
    angle = angle - 2 * np.pi * np.round(angle / (2 * np.pi))
    # The wraps by one turn, relative to the term without a wrap.
    slope, constant = 2 * np.pi / std**2 * angle, -2 * np.pi**2 / std**2
    wraps = np.exp(constant + slope) + np.exp(constant - slope)
    return (np.log(np.sqrt(2 * np.pi) / std) - angle**2 / (2 * std**2) + np.log1p(wraps))
