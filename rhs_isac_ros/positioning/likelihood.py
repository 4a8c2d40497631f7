"""The likelihood of positions and nuisance parameters: one Gaussian for each state of the surface.

Nuisance parameters z multiply the direct path and the multipath in the signals y by exp(z P); see
`model.impairments`. The divided signals y exp(-z P) have the distribution of the model without the
factor, apart from the change of volume, and but for the thermal noise, which a gain does not
multiply: its power is divided by that of the gain. With mean mu(p) and covariance Lambda at a
position p and gain g [nepers], the log-likelihood is, up to a constant, ``-|W (y exp(-z P) -
mu(p))|^2 - 2 Re(sum z P) - log det Lambda`` with ``W^H W = Lambda^-1``. In the basis in which the
multipath is diagonal, so is the noise, and the gain changes W by a factor for each measurement.

A `Conditional` evaluates the log-likelihood and its derivatives. The search, the posterior and the
tracker use this interface for all impairments and errors of elements.
"""

import dataclasses
from typing import NamedTuple, Protocol

import numpy as np

from rhs_isac_ros.model.arrays import adjoint
from rhs_isac_ros.model.gaussian import (
    covariance_root,
    inverse_lower,
    log_bessel,
    marginalise,
    quadratic_form,
)
from rhs_isac_ros.positioning.lattice import Resolution
from rhs_isac_ros.positioning.nuisance import UNIFORM_EQUIVALENT, NuisancePrior
from rhs_isac_ros.positioning.projection import projected
from rhs_isac_ros.system import System


class Signals(NamedTuple):
    """Signals of N shots, complex128 [N, N_B, N_SB F], as received and whitened."""

    received: np.ndarray
    whitened: np.ndarray


class Local(NamedTuple):
    """The log-likelihood of M points (r [m], u, v) with nuisance parameters, and its derivatives.

    `information` is the expected information, not the observed curvature. In the marginal, the
    curvatures of range and phase nearly cancel, and noise would spoil their difference.
    """

    value: np.ndarray  # Logarithm of the likelihood times the parameters' prior, float64 [M].
    gradient: np.ndarray  # Float64 [M, P + Q]; P is 3, or 0 without derivatives at the points.
    information: np.ndarray  # Float64 [M, P + Q, P + Q].
    residual: np.ndarray  # Energy of the whitened residual, float64 [M].


class Located(Protocol):
    """The likelihood at M points, as a function of the parameters."""

    def local(self, values: np.ndarray, signals: Signals) -> Local:
        """Evaluate the likelihood at parameters [M, Q] for one or M shots."""
        ...


class Conditional(Protocol):
    """The likelihood for one state of the surface, or averaged over several."""

    #: Largest number of points to evaluate together; each may need covariances of its own.
    n_at_once: int = 1 << 20

    def at(self, points: np.ndarray, values: np.ndarray, *, moves: bool = True,
           turns: bool = True) -> Located:
        """Return the likelihood at points [M, 3]; unless `moves`, without derivatives there.

        Of the parameters `values`, [M, Q], only the velocity counts, and is that of the result.
        Unless `turns`, derivatives with respect to the velocity are 0, which is faster.
        """
        ...

    def local(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> Local:
        """Evaluate the likelihood at points [M, 3] and parameters [M, Q] for one or M shots."""
        return self.at(points, values).local(values, signals)


class Columns(NamedTuple):
    """Whitened residuals and derivatives at M points, complex128, of n whitened measurements."""

    residual: np.ndarray  # Signals without the factors of the parameters, less the mean, [M, n].
    by_point: np.ndarray  # Derivatives of the mean with respect to the point, [M, P, n].
    # Derivatives with respect to the parameters, for the expected information, [M, Q, n].
    by_values: np.ndarray
    # Derivatives with respect to L further standard normal parameters, in which the mean is
    # linear, [M, L, n].
    linear: np.ndarray
    # Negative derivatives of the signals with respect to the parameters, for the gradient,
    # [M, Q, n]. They contain the multipath, which has no part in the expected information unless
    # a parameter moves it.
    observed: np.ndarray

    @classmethod
    def of(cls, stacked: np.ndarray, n_values: int, n_linear: int = 0, n_coordinates: int = 3
           ) -> 'Columns':
        """Divide columns in the order of the fields, [M, C, n].

        If the last Q are omitted, `observed` is `by_values`. Gradient and information then use
        the same derivatives, and never predict an energy below 0.
        """
        ends = np.cumsum([1, n_coordinates, n_values, n_linear])
        residual, by_point, by_values, linear, observed = np.split(stacked, ends, axis=1)
        return cls(residual[:, 0], by_point, by_values, linear,
                   observed if observed.shape[1] else by_values)

    def weighted(self, weights: np.ndarray) -> 'Columns':
        """Multiply all measurements by weights [M, n]."""
        weights = weights[:, None]
        by_values = self.by_values * weights
        return Columns(
            self.residual * weights[:, 0], self.by_point * weights, by_values,
            self.linear * weights, by_values if self.observed is self.by_values
            else self.observed * weights)


class Factors(NamedTuple):
    """Factors of covariances of signals, [..., N_B, N_SB F, N_SB F]."""

    whitener: np.ndarray  # Inverses of the factors of the covariances.
    log_det: np.ndarray  # Logarithms of the determinants, added over the bands, float64 [...].
    # Share of thermal noise in the whitened measurements, float64 [..., n]; None without a gain.
    noise: np.ndarray | None

    @classmethod
    def of(cls, prior: NuisancePrior, covariance: np.ndarray) -> 'Factors':
        """Factorise covariances."""
        return cls.of_roots(prior, covariance_root(
            prior.scenario, covariance, orthogonal=prior.has_gain))

    @classmethod
    def of_roots(cls, prior: NuisancePrior, roots: np.ndarray) -> 'Factors':
        """Take Cholesky factors, or, with a gain, such with orthogonal columns."""
        if not prior.has_gain:
            diagonal = np.diagonal(roots, axis1=-2, axis2=-1).real
            return cls(inverse_lower(roots), 2 * np.log(diagonal).sum(axis=(-2, -1)), None)
        variance = np.sum(np.abs(roots)**2, axis=-2)
        noise = prior.scenario.noise_power_w / variance
        return cls(adjoint(roots) / variance[..., None], np.log(variance).sum(axis=(-2, -1)),
                   noise.reshape(*noise.shape[:-2], -1))

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Whiten columns [M, C, N_B, N_SB F] by one factor, or by those of M points; [M, C, n]."""
        white = np.matmul(np.swapaxes(columns, 1, 2), np.swapaxes(self.whitener, -2, -1))
        return np.swapaxes(white, 1, 2).reshape(*columns.shape[:2], -1)


class Likelihood(Conditional):
    """The likelihood with one covariance, in which element errors are averaged over the region."""

    def __init__(self, system: System) -> None:
        self.codebook, self.surface = system.codebook, system.surface
        # Estimators are built between cycles; the first estimate should be as fast as later ones.
        self.model = projected(system.prepare()).prepare()
        self.scenario = self.model.scenario
        self.nuisance = NuisancePrior(self.model)
        self.resolution = Resolution.of(self.scenario)
        self.factors = Factors.of_roots(self.nuisance, self.model.combined_root)
        self.log_det = float(self.factors.log_det)

    def signals(self, received: np.ndarray) -> Signals:
        """Whiten signals [N, N_B, N_SB F]."""
        return Signals(received, self.model.whiten(received))

    def whitened(self, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Divide signals by the factors of parameters [M, Q]; whiten them, [M, N_B, N_SB F]."""
        return self.turned(values, self.still(values, signals))

    def still(self, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Whiten signals without the factors of the parameters that move the multipath."""
        moves = self.nuisance.moves_multipath
        return self.model.whiten(self.nuisance.divide(
            signals.received, values * moves)) if moves.any() else signals.whitened

    def turned(self, values: np.ndarray, still: np.ndarray) -> np.ndarray:
        """Remove the factors of all other parameters, which multiply whole bands."""
        if not len(self.nuisance):
            return still
        others = values * ~self.nuisance.moves_multipath
        return still * np.exp(-(others @ self.nuisance.scaled_patterns[:, :, 0]))[..., None]

    def rates(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the rates of (r, u, v) in `Resolution.rate_steps`; see `NuisancePrior.rates`."""
        rates = self.nuisance.rates(values, points)
        return rates / self.resolution.rate_steps[:rates.shape[1]]

    def weights_at(self, gains: np.ndarray) -> np.ndarray:
        """Return the factors of whitened measurements, [M, N_B, N_SB F]; without a gain, 1.

        The gains [nepers] are [M], or [M, N_B] for each band.
        """
        if self.factors.noise is None:
            return np.ones((len(gains), 1, 1))
        gains = np.broadcast_to(gains.reshape(len(gains), -1), (len(gains), self.model.shape[0]))
        weights, _ = self.nuisance.noise_weights(gains, self.factors.noise)
        return weights.reshape(len(gains), *self.model.shape)

    def at(self, points: np.ndarray, values: np.ndarray, *, moves: bool = True,
           turns: bool = True) -> 'WhiteMeans':
        """Return the likelihood at points; see `Conditional.at`."""
        return WhiteMeans(self, *self.model.mean_and_jacobian(
            *self.nuisance.states(points, values, moves, turns), whitened=True))


@dataclasses.dataclass(eq=False)
class WhiteMeans:
    """The likelihood at M points with one covariance."""

    likelihood: Likelihood
    mean: np.ndarray  # Whitened, complex128 [M, N_B, N_SB F].
    # Derivatives of `mean` with respect to point and velocity, [M, P + D, N_B, N_SB F].
    slopes: np.ndarray
    # Latest parameters that move the multipath, and signals with and without their factors.
    _latest: tuple[np.ndarray, Signals, np.ndarray] | None = None

    def _whitened(self, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Return `Likelihood.whitened`; steps of the bands' phases alone change little of it."""
        moving = values[:, self.likelihood.nuisance.moves_multipath]
        if self._latest is None or self._latest[1] is not signals or not np.array_equal(
                self._latest[0], moving):
            self._latest = moving, signals, self.likelihood.still(values, signals)
        return self.likelihood.turned(values, self._latest[2])

    def local(self, values: np.ndarray, signals: Signals) -> Local:
        """Evaluate the likelihood; see `Located.local`."""
        prior, whitened = self.likelihood.nuisance, self._whitened(values, signals)
        slopes = self.slopes.reshape(*self.slopes.shape[:2], self.mean[0].size)
        n_moving = prior.velocity.shape[1]
        n_points = slopes.shape[1] - n_moving
        by_point, by_velocity = slopes[:, :n_points], slopes[:, n_points:]
        by_values = observed = slopes[:, :0]
        if len(prior):
            by_values, observed = prior.slopes(whitened, self.mean)
        if n_moving:
            by_values[:, :n_moving] = observed[:, :n_moving] = by_velocity
        columns = Columns((whitened - self.mean).reshape(len(self.mean), -1), by_point,
                          by_values, by_point[:, :0], observed)
        return assemble(
            prior, values, columns, prior.information, self.likelihood.factors.noise)

    @property
    def growth(self) -> np.ndarray:
        """Relative change of the amplitude of the direct path, float64 [M, P + D]."""
        changes = np.einsum('mpbn,mbn->mp', self.slopes, self.mean.conj()).real
        found: np.ndarray = changes / np.sum(np.abs(self.mean)**2, axis=(1, 2))[:, None]
        return found

    def log_excess(self, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Return logs of curvatures relative to the expected information, float64 [M, Q].

        The expected information of a parameter is proportional to the energy of the direct path,
        but the curvature is proportional to the output of the matched filter. That of a uniform
        phase is such that Laplace's method gives its Bessel function.
        """
        argument = 2 * np.abs(self.outputs(values, signals))
        curvature = np.exp(2 * (argument - log_bessel(argument))) / (4 * np.pi)
        gains = values @ self.likelihood.nuisance.gains.T
        energy = np.sum(np.abs(self.mean)**2 * self.likelihood.weights_at(gains)**2, axis=2)
        energy = np.maximum(energy, np.finfo(float).tiny)
        common = np.log(curvature.sum(axis=1) / energy.sum(axis=1))[:, None]
        n_common = values.shape[1] - curvature.shape[1]
        return np.hstack([np.repeat(common, n_common, axis=1), np.log(curvature / energy)])

    def settled(self, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Replace uniform band phases in parameters [M, Q] by the most likely phases."""
        outputs, change = self.outputs(values, signals), np.zeros_like(values)
        change[:, -outputs.shape[1]:] = np.angle(outputs) / UNIFORM_EQUIVALENT
        return values + change

    def outputs(self, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Compute the outputs of the bands' matched filters, complex128 [M, N_B]."""
        gains = values @ self.likelihood.nuisance.gains.T
        return np.sum(
            self.mean.conj() * self._whitened(values, signals)
            * self.likelihood.weights_at(gains)**2, axis=2)


def assemble(prior: NuisancePrior, values: np.ndarray, columns: Columns,
             information_of_covariance: np.ndarray, noise: np.ndarray | None = None) -> Local:
    """Combine whitened columns into the likelihood and its derivatives at parameters [M, Q].

    `information_of_covariance`, float64 [Q, Q], is the information of the covariance about the
    parameters. The further parameters of the columns are integrated out. `noise` is that of
    `Factors`.
    """
    if noise is not None:
        weights, shares = prior.noise_weights(values @ prior.gains.T, noise)
        columns = columns.weighted(weights)
    first, n_linear = columns.by_point.shape[1], columns.linear.shape[1]
    n = first + len(prior)
    # The residual energy, and gradient and information of its negative.
    expected = columns.by_point
    if n + n_linear > first:
        expected = np.concatenate([expected, columns.by_values, columns.linear], axis=1)
    slopes = expected if columns.observed is columns.by_values else np.concatenate(
        [columns.by_point, columns.observed, columns.linear], axis=1)
    information = quadratic_form(expected)
    # Re(a^H b) is the inner product of real and imaginary parts.
    parts = np.ascontiguousarray(columns.residual).view(float)
    gradient = 2 * np.matmul(
        np.ascontiguousarray(slopes).view(float), parts[..., None])[..., 0]
    energy = np.einsum('mp,mp->m', parts, parts)
    value = -energy
    # The priors of point, parameters and further parameters.
    diagonal = np.einsum('mpp->mp', information)
    diagonal[:, :first] += prior.floor[:first]
    diagonal[:, n:] += 1.0
    if len(prior):
        diagonal[:, first:n] += prior.precision
        gradient[:, first:n] -= prior.precision * values + prior.volume
        # Derivatives of parameters that move the multipath already include this information.
        still = ~prior.moves_multipath
        information[:, first:n, first:n] += np.outer(still, still) * information_of_covariance
        value += prior.log_prior(values)
    if noise is not None:
        # By the share of noise, a gain scales the covariance less, and so does the density.
        by_band = (len(values), *prior.gains.shape[:1], -1)
        squares = parts.reshape(len(parts), -1, 2)**2
        surplus = np.sum((shares * (1 - squares.sum(axis=2))).reshape(by_band), axis=2)
        value += 2 * np.log(weights).sum(axis=1)
        gradient[:, first:n] += 2 * surplus @ prior.gains
        information[:, first:n, first:n] -= prior.hidden(shares)
        np.maximum(diagonal[:, first:n], prior.least_information, out=diagonal[:, first:n])
    if not n_linear:
        return Local(value, gradient, information, energy)
    marginal = marginalise(information, gradient, n)
    rise = np.sum(gradient[:, n:] * marginal.offset, axis=1) / 2
    return Local(value + rise + marginal.log_volume, marginal.gradient, marginal.information,
                 energy - rise)
