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
import functools
from typing import NamedTuple, Protocol

import numpy as np

from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.arrays import adjoint, blocks, mixture_weights
from rhs_isac_ros.model.gaussian import (
    covariance_root,
    marginalise,
    quadratic_form,
    step_to_maximum,
)
from rhs_isac_ros.model.geometry import jacobian, to_positions
from rhs_isac_ros.model.impairments import (
    UNIFORM_STD_RAD,
    Exponents,
    nuisance_of,
)
from rhs_isac_ros.model.scenario import ScenarioError
from rhs_isac_ros.positioning.lattice import Resolution
from rhs_isac_ros.system import System

# Standard deviation of a Gaussian whose density at its centre equals that of a uniform phase.
_UNIFORM_EQUIVALENT = np.sqrt(2 * np.pi)
# Standard deviation from which the search treats the phases of the bands as uniform. Their joint
# density then has many peaks along the range, too narrow for Gaussians. Its information is added
# to the samples of the posterior afterwards.
COARSE_STD_RAD = 0.75


class _Search(NamedTuple):
    """Estimation of parameters from the signals alone, and the margin for its errors."""

    # Grid on which parameters with several maxima are compared.
    reach: float = 4.0  # In standard deviations.
    points: tuple[int, ...] = (513, 49, 13, 5)  # Per parameter, for 1, 2, 3 and more parameters.
    points_per_turn: int = 6  # Of the phase between two measurements, if these are more.
    block: int = 1 << 20  # Number of complex numbers at a time.
    refinements: int = 4  # Of the best point.
    # Errors of the estimates, in standard deviations, whose effect the margin covers, and largest
    # margin. Nearby users have stronger signals than the average, on which the effect depends.
    deviation: float = 6.0
    margin: float = 200.0


_SEARCH = _Search()
# Smallest eigenvalue of a sum of signals, as a share of its trace.
_MIN_SPREAD = 1e-12
# Numbers of failures to average over: smallest probability of each, and how many at most.
_MIN_PROBABILITY = 1e-5
_MAX_COUNTS = 12
# Largest logarithm of the power of noise relative to signals, which keeps it finite.
_MAX_EXPONENT = 300.0
# Share of the whitened energy up to which errors of an estimated surface need no covariance for
# each position.
_MIN_ERROR_SHARE = 0.05


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
    gradient: np.ndarray  # Float64 [M, 3 + Q].
    information: np.ndarray  # Float64 [M, 3 + Q, 3 + Q].
    residual: np.ndarray  # Energy of the whitened residual, float64 [M].


class Conditional(Protocol):
    """The likelihood for one state of the surface, or averaged over several."""

    def local(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> Local:
        """Evaluate the likelihood at points [M, 3] and parameters [M, Q] for one or M shots."""
        ...


class Columns(NamedTuple):
    """Whitened residuals and derivatives at M points, complex128, of n whitened measurements."""

    residual: np.ndarray  # Signals without the factors of the parameters, less the mean, [M, n].
    by_point: np.ndarray  # Derivatives of the mean with respect to the point, [M, 3, n].
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
    def of(cls, stacked: np.ndarray, n_values: int, n_linear: int = 0) -> 'Columns':
        """Divide columns in the order of the fields, [M, C, n].

        If the last Q are omitted, `observed` is `by_values`. Gradient and information then use
        the same derivatives, and never predict an energy below 0.
        """
        ends = np.cumsum([1, 3, n_values, n_linear])
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


class NuisancePrior(Exponents):
    """Prior and effect of the nuisance parameters, in units in which they are standard normal.

    A uniform phase has a flat prior and the unit `_UNIFORM_EQUIVALENT`. If the relative phases of
    bands vary by `COARSE_STD_RAD` or more, uniform phases of all bands replace the parameters that
    rotate whole bands; the range then follows from delays, amplitudes and wavefronts only.
    """

    phase_covariance: np.ndarray  #: Of the declared phases of the bands, float64 [N_B, N_B].
    relative_phase_std_rad: float  #: Largest standard deviation relative to their mean.
    is_coarse: bool  #: Whether every band is given a uniform phase, by the last parameters.
    needs_search: np.ndarray  #: As in `Nuisance`, bool [Q].
    phases: np.ndarray  #: Phase of each band per unit [rad], float64 [N_B, Q].
    #: Information of the prior, as in `Nuisance`, but 0 for a uniform phase, float64 [Q].
    precision: np.ndarray
    gains: np.ndarray  #: Of the bands per unit of each parameter [nepers], float64 [N_B, Q].
    has_gain: bool  #: Whether any of them is not negligible.
    #: Half of the change of a parameter that does not change the signals, float64 [Q].
    half_period: np.ndarray
    information: np.ndarray  #: Contribution of the model's covariance, float64 [Q, Q].

    def __init__(self, model: MeasurementModel) -> None:
        self.scenario, declared = model.scenario, nuisance_of(model.scenario)
        self.phase_covariance = declared.phases @ declared.phases.T
        self.relative_phase_std_rad = _relative_std(self.phase_covariance)
        self.is_coarse = self.relative_phase_std_rad >= COARSE_STD_RAD
        kept = ~(declared.phases.any(axis=0) & self.is_coarse)
        _, n_bands, n_rows = declared.scaled_patterns.shape
        turns = _UNIFORM_EQUIVALENT * np.eye(n_bands)[:n_bands * self.is_coarse]
        patterns = np.concatenate([
            declared.scaled_patterns[kept], 1j * turns[:, :, None] * np.ones(n_rows)])
        phases = np.hstack([declared.phases[:, kept], turns.T])
        self.needs_search, self.moves_multipath = (
            np.append(flags[kept], np.zeros(len(turns), bool))
            for flags in (declared.needs_search, declared.moves_multipath))
        largest = np.abs(phases).max(axis=0, initial=0.0)
        uniform = largest > UNIFORM_STD_RAD
        scale = np.where(uniform, _UNIFORM_EQUIVALENT / np.where(uniform, largest, 1.0), 1.0)
        self.scaled_patterns, self.phases = patterns * scale[:, None, None], phases * scale
        precision, period = (np.append(values[kept], np.zeros(len(turns)))
                             for values in (declared.precision, declared.period))
        if (self.scenario.timing_std_s == np.inf and self.scenario.n_subbands % 2 == 0
                and not np.isinf(self.phase_std_rad).all()):
            raise ScenarioError(
                'timing_std_s: unknown, expected an unknown phase_std_rad or band_phase_std_rad '
                'as well: half a period of the timing turns all phases by half a turn')
        self.precision, self.half_period = np.where(uniform, 0.0, precision), period / 2
        self.gains, self.has_gain = self.scaled_patterns.real.mean(axis=2).T, declared.has_gain
        self._operators = self._multiplying(model.root, model.whitener)
        self.information = self.information_of(model.root, model.whitener)

    @functools.cached_property
    def gain(self) -> np.ndarray:
        """Gain of all signals per unit [nepers], float64 [Q]."""
        return self.scaled_patterns.real.mean(axis=(1, 2))

    @functools.cached_property
    def gain_unit(self) -> float:
        """Gain [nepers] per unit of its density; the standard deviation unless it is unknown."""
        return float(np.linalg.norm(self.gain))

    @functools.cached_property
    def gain_std(self) -> float:
        """Standard deviation of the gain of all signals [nepers]; 0 if it is negligible.

        It is far above `gain_unit` if the gain has no prior.
        """
        return self.has_gain * float(np.sqrt(self.gain @ self._gain_variance))

    @functools.cached_property
    def _gain_variance(self) -> np.ndarray:
        """Covariance of the parameters with the gain of all signals [nepers], float64 [Q]."""
        return self.gain / np.where(self.gain == 0, 1.0, self.precision)

    @functools.cached_property
    def volume(self) -> np.ndarray:
        """Change of the logarithm of the signals' volume per unit, float64 [Q]."""
        return 2 * self.scaled_patterns.real.sum(axis=(1, 2))

    @functools.cached_property
    def phase_std_rad(self) -> np.ndarray:
        """Standard deviation of the phase of each band, infinite if it is uniform, [N_B]."""
        std = np.sqrt(np.diagonal(self.phase_covariance))
        return np.where(self.is_coarse | (std > UNIFORM_STD_RAD), np.inf, std)

    @functools.cached_property
    def floor(self) -> np.ndarray:
        """Curvature in (r, u, v) that is added to every log-likelihood, float64 [3]."""
        return Resolution.of(self.scenario).curvature_floor

    def information_of(self, root: np.ndarray, whitener: np.ndarray) -> np.ndarray:
        """Compute the Fisher information of a covariance about the parameters, [Q, Q]."""
        # The multipath reveals gains and offsets of carrier and timing, but no phase.
        operators = self._multiplying(root, whitener)
        both = operators + adjoint(operators)
        return np.einsum('aimn,binm->ab', both, both, optimize=True).real

    def direct_information(self, spread: np.ndarray) -> np.ndarray:
        """Compute the information of whitened means with second moments `spread`, [Q, Q]."""
        return 2 * np.einsum('aimn,ino,bimo->ab', self._operators, spread, self._operators.conj(),
                             optimize=True).real

    def _multiplying(self, root: np.ndarray, whitener: np.ndarray) -> np.ndarray:
        """Compute W P W^-1, which applies P to whitened signals, [Q, N_B, N_SB F, N_SB F]."""
        return np.matmul(whitener * self.scaled_patterns[:, :, None], root)

    def columns(self, values: np.ndarray, received: np.ndarray, mean: np.ndarray,
                slopes: np.ndarray, *linear: np.ndarray) -> np.ndarray:
        """Stack the fields of `Columns`, before whitening, complex128 [M, C, N_B, N_SB F].

        `slopes` are the derivatives of the mean with respect to the point.
        """
        divided = self.divide(received, values)
        return np.concatenate([
            (divided - mean)[:, None], slopes, self.derivatives(divided, mean), *linear,
            self.scaled_patterns * divided[:, None]], axis=1)

    def slopes(self, whitened: np.ndarray) -> np.ndarray:
        """Multiply whitened signals [M, N_B, N_SB F] by W P W^-1; return [M, Q, N_B N_SB F]."""
        slopes = np.einsum('qimn,kin->kqim', self._operators, whitened, optimize=True)
        return slopes.reshape(*slopes.shape[:2], -1)

    def log_prior(self, values: np.ndarray) -> np.ndarray:
        """Return the logarithm of the prior times the change of volume, float64 [M]."""
        return -(values**2 @ self.precision / 2 + values @ self.volume)

    def log_evidence_of_aligned(self, aligned: np.ndarray) -> float:
        """Return the log of Laplace's integral over the parameters that `Alignment` estimates."""
        (moves,) = np.nonzero(self.moves_multipath)
        curvature = self.information[np.ix_(moves, moves)] + np.diag(self.precision[moves])
        return float(-self.precision @ aligned**2 - np.linalg.slogdet(curvature)[1]) / 2

    def amplitude(self, outputs: np.ndarray) -> np.ndarray:
        """Add up the bands' matched-filter outputs, [N_B, ...], rotated as in `_in_phase`."""
        if not self.relative_phase_std_rad:
            return _in_phase(outputs.sum(axis=0), float(self.phase_std_rad[0]))
        parts = [_in_phase(output, float(std))
                 for output, std in zip(outputs, self.phase_std_rad, strict=True)]
        return np.sum(parts, axis=0)

    def maximised_over_gain(self, amplitude: np.ndarray, energy: float, n_measurements: int
                            ) -> tuple[np.ndarray, np.ndarray]:
        """Maximise the log-likelihood, without the template's energy, over the gain.

        If signals y are multiplied by h, the log-likelihood for an amplitude A, an array of any
        shape, is ``-h^2 |y|^2 + 2 h A + 2 n log h`` plus the log-prior of the gain, which is
        ``-log h``; n is `n_measurements`. Returns its maximum and the gain [nepers]; if the gain
        is known, 2 A and a single 0.
        """
        if not self.gain_std:
            return 2 * amplitude, np.zeros(1)
        precision = self.gain_std**-2
        # The maximum without the prior, and its curvature, lead to a start for two Newton steps.
        positive = np.maximum(amplitude, 0)
        factor = (positive + np.sqrt(positive**2 + 4 * n_measurements * energy)) / (2 * energy)
        curvature = 2 * positive * factor + 4 * n_measurements
        gain = -np.log(factor) * curvature / (curvature + precision)
        for _ in range(2):
            factor = np.exp(-gain)
            slope = (2 * factor * (factor * energy - amplitude) - 2 * n_measurements
                     - precision * gain)
            curvature = 2 * factor * (2 * factor * energy - amplitude) + precision
            gain += slope / np.maximum(curvature, precision)
        factor = np.exp(-gain)
        return (factor * (2 * amplitude - factor * energy) - 2 * n_measurements * gain
                - precision * gain**2 / 2, gain)

    def start(self, outputs: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """Return initial parameters [M, Q] for filter outputs [N_B, M] and gains [M] [nepers]."""
        angles = np.angle(outputs)
        if not self.relative_phase_std_rad:
            angles = np.broadcast_to(np.angle(outputs.sum(axis=0)), angles.shape)
        # Phases without a prior follow the angles; the others share the rest by their variance.
        variance = np.where(self.precision > 0, 1.0, 1e6)
        spread = self.phases * variance
        values: np.ndarray = (spread.T @ np.linalg.pinv(spread @ self.phases.T) @ angles).T
        if self.gain_std:
            values += np.outer(gain, self._gain_variance / self.gain_std**2)
        return values

    def noise_weights(self, gains: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return factors of whitened measurements, and the shares of noise in them, [M, n] each.

        `gains` are those of the bands, [M, N_B] [nepers], and `noise` is the share of noise in
        each measurement at a gain of 0, [n] or [M, n].
        """
        power = np.exp(np.minimum(-2 * gains, _MAX_EXPONENT))
        power = np.repeat(power, noise.shape[-1] // gains.shape[1], axis=1)
        total = 1 + noise * (power - 1)
        return 1 / np.sqrt(total), noise * power / total


class Factors(NamedTuple):
    """Factors of covariances of signals, [..., N_B, N_SB F, N_SB F]."""

    roots: np.ndarray
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
            return cls(roots, 2 * np.log(diagonal).sum(axis=(-2, -1)), None)
        variance = np.sum(np.abs(roots)**2, axis=-2)
        noise = prior.scenario.noise_power_w / variance
        return cls(roots, np.log(variance).sum(axis=(-2, -1)),
                   noise.reshape(*noise.shape[:-2], -1))

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Whiten columns [M, C, N_B, N_SB F] by the factors of each point; [M, C, n]."""
        white = np.linalg.solve(self.roots, np.moveaxis(columns, 1, 3))
        return np.moveaxis(white, 3, 1).reshape(*columns.shape[:2], -1)


class Likelihood:
    """The likelihood with one covariance, in which element errors are averaged over the region."""

    def __init__(self, system: System) -> None:
        self.scenario, self.codebook, self.surface = (
            system.scenario, system.codebook, system.surface)
        # Estimators are built between cycles; the first estimate should be as fast as later ones.
        self.model = system.prepare()
        self.nuisance = NuisancePrior(self.model)
        self.resolution = Resolution.of(self.scenario)
        self.factors = Factors.of_roots(self.nuisance, self.model.root)
        self.log_det = float(self.factors.log_det)

    def signals(self, received: np.ndarray) -> Signals:
        """Whiten signals [N, N_B, N_SB F]."""
        return Signals(received, self.model.whiten(received))

    def whitened(self, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Divide signals by the factors of parameters [M, Q]; whiten them, [M, N_B, N_SB F]."""
        if not len(self.nuisance):
            return signals.whitened
        return self.model.whiten(self.nuisance.divide(signals.received, values))

    def weights_at(self, gains: np.ndarray) -> np.ndarray:
        """Return the factors of whitened measurements, [M, N_B, N_SB F]; without a gain, 1.

        The gains [nepers] are [M], or [M, N_B] for each band.
        """
        if self.factors.noise is None:
            return np.ones((len(gains), 1, 1))
        gains = np.broadcast_to(gains.reshape(len(gains), -1), (len(gains), self.model.shape[0]))
        weights, _ = self.nuisance.noise_weights(gains, self.factors.noise)
        return weights.reshape(len(gains), *self.model.shape)

    def local(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> Local:
        """Evaluate the likelihood at points; see `Conditional.local`."""
        n, whitened = len(points), self.whitened(values, signals)
        mean, slopes = self.model.mean_and_jacobian(
            to_positions(points), jacobian(points), whitened=True)
        residual, by_point = (whitened - mean).reshape(n, -1), slopes.reshape(n, 3, -1)
        # Without parameters, both arrays have no columns.
        observed = by_values = by_point[:, :0]
        if len(self.nuisance):
            observed = self.nuisance.slopes(whitened)
            moves = self.nuisance.moves_multipath[:, None]
            by_values = np.where(moves, observed, self.nuisance.slopes(mean))
        columns = Columns(residual, by_point, by_values, by_point[:, :0], observed)
        return assemble(
            self.nuisance, values, columns, self.nuisance.information, self.factors.noise)

    def settle(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Replace uniform band phases in parameters [M, Q] by the most likely phases."""
        # A step in range rotates these phases by many turns.
        if not self.nuisance.is_coarse:
            return values
        outputs, change = self.outputs(points, values, signals), np.zeros_like(values)
        change[:, -outputs.shape[1]:] = np.angle(outputs) / _UNIFORM_EQUIVALENT
        return values + change

    def outputs(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> np.ndarray:
        """Compute the outputs of the bands' matched filters, complex128 [M, N_B]."""
        mean = self.model.whiten(self.model.mean(to_positions(points)))
        return np.sum(
            mean.conj() * self.whitened(values, signals)
            * self.weights_at(values @ self.nuisance.gains.T)**2, axis=2)


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
    n, n_linear = 3 + len(prior), columns.linear.shape[1]
    # The residual energy, and gradient and information of its negative.
    expected = np.concatenate([columns.by_point, columns.by_values, columns.linear], axis=1)
    slopes = expected if columns.observed is columns.by_values else np.concatenate(
        [columns.by_point, columns.observed, columns.linear], axis=1)
    information = quadratic_form(expected)
    # Re(a^H b) is the inner product of real and imaginary parts.
    parts = np.ascontiguousarray(columns.residual).view(float)
    gradient = 2 * np.matmul(
        np.ascontiguousarray(slopes).view(float), parts[..., None])[..., 0]
    energy = np.sum(parts**2, axis=1)
    # The priors of point, parameters and further parameters.
    information += np.diag(np.concatenate([prior.floor, prior.precision, np.ones(n_linear)]))
    gradient[:, 3:n] -= prior.precision * values + prior.volume
    # Derivatives of parameters that move the multipath already include this information.
    still = ~prior.moves_multipath
    information[:, 3:n, 3:n] += np.outer(still, still) * information_of_covariance
    value = prior.log_prior(values) - energy
    if noise is not None:
        # By the share of noise, a gain scales the covariance less, and so does the density.
        by_band = (len(values), *prior.gains.shape[:1], -1)
        squares = parts.reshape(len(parts), -1, 2)**2
        surplus = np.sum((shares * (1 - squares.sum(axis=2))).reshape(by_band), axis=2)
        lost = np.sum((4 * (1 - shares)**2 - 4).reshape(by_band), axis=2)
        gains = prior.gains * still
        value += 2 * np.log(weights).sum(axis=1)
        gradient[:, 3:n] += 2 * surplus @ prior.gains
        information[:, 3:n, 3:n] += np.einsum('bq,mb,bp->mqp', gains, lost, gains)
    marginal = marginalise(information, gradient, n)
    rise = np.sum(gradient[:, n:] * marginal.offset, axis=1) / 2
    return Local(value + rise + marginal.log_volume, marginal.gradient, marginal.information,
                 energy - rise)


def _relative_std(phase_covariance: np.ndarray) -> float:
    """Return the largest standard deviation of the bands' phases relative to their mean [rad]."""
    n_bands = len(phase_covariance)
    centre = np.eye(n_bands) - (1 / n_bands if n_bands > 1 else 0.0)
    relative = np.linalg.eigvalsh(centre @ phase_covariance @ centre)[-1]
    # If all bands share one phase, only rounding errors remain.
    is_shared = relative <= 1e-9 * np.trace(phase_covariance)
    return 0.0 if is_shared else float(np.sqrt(relative))


class DispersedLikelihood:
    """The likelihood with the covariance of element errors at each position.

    Errors of the direct path are stronger for near users. A surface has a whole number k of failed
    elements, and the covariance of their errors is k / E[k] times the average. The likelihood is
    averaged over k. Its value omits the same constant as that of `Likelihood`.
    """

    def __init__(self, likelihood: Likelihood) -> None:
        self._base, scenario = likelihood, likelihood.scenario
        # The number of failures of an estimated surface is known.
        share = scenario.failed_element_share if likelihood.surface is None else 0.0
        intact = dataclasses.replace(scenario, failed_element_share=0.0)
        self._average = MeasurementModel(
            dataclasses.replace(scenario, failed_element_share=share), likelihood.codebook,
            likelihood.surface).prepare()
        self._intact = MeasurementModel(intact, likelihood.codebook, likelihood.surface)
        self._scales, log_weights = _failure_counts(scenario.n_elements, share)
        self._offsets = log_weights + likelihood.log_det
        self._latest: tuple[np.ndarray, list[Factors]] | None = None
        average, least = self._average.covariance(), self._intact.covariance()
        roots = covariance_root(
            scenario, least + self._scales[:, None, None, None] * (average - least))
        self._information = [likelihood.nuisance.information_of(*both)
                             for both in zip(roots, np.linalg.inv(roots), strict=True)]

    @classmethod
    def of(cls, likelihood: Likelihood) -> 'DispersedLikelihood | None':
        """Return this likelihood, or None if element errors are known or accurately estimated."""
        model = likelihood.model
        if model.elements.is_exact:
            return None
        if model.surface is not None:
            errors = model.elements.error_covariance(model.scenario, model.beams)
            energy = np.einsum('irs,ist,irt->', model.whitener, errors, model.whitener.conj(),
                               optimize=True).real
            if energy <= _MIN_ERROR_SHARE * np.prod(model.shape):
                return None
        return cls(likelihood)

    def local(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> Local:
        """Evaluate the likelihood at points; see `Conditional.local`."""
        prior, states = self._base.nuisance, []
        mean, slopes = self._average.mean_and_jacobian(to_positions(points), jacobian(points))
        columns = prior.columns(values, signals.received, mean, slopes)
        for factors, offset, information in zip(
                self._factors_at(points), self._offsets, self._information, strict=True):
            white = Columns.of(factors.whiten(columns), len(prior))
            local = assemble(prior, values, white, information, factors.noise)
            states.append(local._replace(value=local.value + offset - factors.log_det))
        return _average_of(states)

    def _factors_at(self, points: np.ndarray) -> list[Factors]:
        """Return factors of the covariance at points for each number of failures."""
        # Numerical integration evaluates many parameters at the same points. Another thread may
        # replace `_latest` at any time.
        latest = self._latest
        if latest is None or points is not latest[0]:
            positions = to_positions(points)
            intact = self._intact.covariance_at(positions)
            excess = (self._average.covariance_at(positions) - intact if any(self._scales)
                      else np.zeros(1))
            self._latest = latest = points, [
                Factors.of(self._base.nuisance, intact + scale * excess)
                for scale in self._scales]
        return latest[1]


def _average_of(states: list[Local]) -> Local:
    """Average the likelihoods of states; take the residual from the most probable state."""
    value = np.stack([one.value for one in states])
    weights, log_total = mixture_weights(value, axis=0)
    residual = np.stack([one.residual for one in states])
    return Local(
        log_total,
        np.einsum('km,kmp->mp', weights, np.stack([one.gradient for one in states])),
        np.einsum('km,kmpq->mpq', weights, np.stack([one.information for one in states])),
        np.take_along_axis(residual, value.argmax(axis=0)[None], axis=0)[0])


def _failure_counts(n_elements: int, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers of failures divided by the mean, and the logs of their probabilities."""
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


def _in_phase(outputs: np.ndarray, std: float) -> np.ndarray:
    """Return the real parts after the most likely rotation, less half its cost in the prior."""
    if std == 0:
        return outputs.real
    magnitude: np.ndarray = np.abs(outputs)
    if not np.isfinite(std):
        return magnitude
    angle = np.angle(outputs)
    phase = angle * magnitude / (magnitude + 1 / (2 * std**2))
    return magnitude * np.cos(angle - phase) - phase**2 / (4 * std**2)


class Alignment:
    """Estimates of the parameters that move the multipath, from the signals alone.

    Offsets of carrier and timing move the multipath out of the nulls of its covariance, so they
    must be known before the search. `spread`, from `tabulate`, contains the second moments of the
    whitened means over the region, and accounts for the unknown position. `margin` is the loss of
    log-likelihood that errors of the estimates may cause at the true position.
    """

    def __init__(self, likelihood: Likelihood, spread: np.ndarray) -> None:
        self._prior = likelihood.nuisance
        # Strong signals must not make the sum singular up to rounding errors.
        least = np.maximum(_MIN_SPREAD * np.trace(spread, axis1=1, axis2=2).real, 1.0)
        roots = np.linalg.cholesky(spread + least[:, None, None] * np.eye(spread.shape[1]))
        self._whitener = np.linalg.solve(roots, likelihood.model.whitener)
        moves = np.ix_(*2 * [self._prior.moves_multipath])
        known = self._prior.information_of(likelihood.model.root @ roots, self._whitener)
        precision = (known + np.diag(self._prior.precision))[moves]
        loss = np.trace(np.linalg.solve(
            precision, self._prior.direct_information(spread)[moves])) / 2
        self.margin = min(_SEARCH.deviation**2 * float(loss), _SEARCH.margin)

    def values_of_each(self, received: np.ndarray) -> np.ndarray:
        """Estimate the parameters [N, Q] that move the multipath; all others are 0."""
        if not self._prior.moves_multipath.any():
            return np.zeros((len(received), len(self._prior)))
        return np.stack([self._values(one) for one in received])

    def _values(self, received: np.ndarray) -> np.ndarray:
        prior, moves = self._prior, self._prior.moves_multipath
        values = np.zeros(len(prior))
        if prior.needs_search.any():
            values = self._best_on_grid(received)
        for _ in range(_SEARCH.refinements):
            divided = prior.divide(received, values)
            residual = self._whitened(divided[None]).reshape(-1)
            slopes = self._whitened(prior.scaled_patterns[moves] * divided)
            slopes = slopes.reshape(len(slopes), -1)
            # With an unknown gain, the energy is normalised.
            scale = residual.size / np.sum(np.abs(residual)**2) if prior.gain_std else 1.0
            curvature = 2 * scale * (slopes.conj() @ slopes.T).real
            curvature += np.diag(prior.precision[moves])
            gradient = 2 * scale * (slopes.conj() @ residual).real
            gradient -= prior.precision[moves] * values[moves]
            values[moves] += step_to_maximum(curvature, gradient)
        return values

    def _best_on_grid(self, received: np.ndarray) -> np.ndarray:
        """Return the best grid values of parameters whose likelihood has several maxima."""
        prior = self._prior
        (searched,) = np.nonzero(prior.needs_search)
        n_grid = _SEARCH.points[min(len(searched), len(_SEARCH.points)) - 1]
        # Beyond half a period, the signals repeat.
        reach = np.minimum(_SEARCH.reach, prior.half_period[searched])
        turns = reach * np.ptp(prior.scaled_patterns[searched].imag, axis=(1, 2))
        counts = np.maximum(n_grid, np.ceil(_SEARCH.points_per_turn * turns / np.pi)).astype(int)
        lines = [np.linspace(-most, most, n)
                 for most, n in zip(reach, counts.tolist(), strict=True)]
        grid = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1)
        candidates = np.zeros((grid[..., 0].size, len(prior)))
        candidates[:, searched] = grid.reshape(len(candidates), -1)
        parts = blocks(len(candidates), max(_SEARCH.block // received.size, 1))
        cost = np.concatenate([np.sum(np.abs(
            self._whitened(prior.divide(received, candidates[part])))**2, axis=(1, 2))
            for part in parts])
        if prior.gain_std:
            cost = received.size * np.log(cost)
        cost += candidates**2 @ prior.precision / 2
        return candidates[np.argmin(cost)]

    def _whitened(self, signals: np.ndarray) -> np.ndarray:
        return np.moveaxis(
            np.matmul(np.moveaxis(signals, 1, 0), np.swapaxes(self._whitener, 1, 2)), 0, 1)
