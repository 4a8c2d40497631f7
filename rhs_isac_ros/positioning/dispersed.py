"""The likelihood with the covariance of element errors at each position."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.arrays import adjoint, mixture_weights, multiply_rows
from rhs_isac_ros.model.gaussian import covariance_root
from rhs_isac_ros.model.geometry import element_positions, polar_bounds, to_polar
from rhs_isac_ros.model.los import los_waves
from rhs_isac_ros.positioning.likelihood import (
    Columns,
    Conditional,
    Factors,
    Likelihood,
    Local,
    Signals,
    assemble,
)
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.support import streams

# Numbers of failures to average over: smallest probability of each, and how many at most.
_MIN_PROBABILITY = 1e-5
_MAX_COUNTS = 12
# Memory of the covariances of several points [bytes]; less of it stays in the cache.
_MAX_BYTES = 1 << 23
# Share of the whitened energy up to which errors of an estimated surface need no covariance for
# each position.
_MIN_ERROR_SHARE = 0.05
# Interpolated covariances: highest powers; largest Frobenius norm of the error of a whitened one,
# and number of points at which it is measured; and memory of covariances at points [bytes].
_POWERS = 2, 3, 5
_MAX_ERROR, _N_TESTS = 1e-5, 16
_POINT_BYTES = 1 << 26
# Width of the border of the region, because positions are rounded [m].
_BORDER_M = 1e-6


class InterpolatedCovariance:
    """The covariance of signals at positions in the region, for declared errors of elements.

    The errors of the direct path are independent. Each element thus adds the products of its gains
    in any two sub-bands, whose carriers cancel. Relative to the products of one element, these are
    smooth functions of 1/r, u and v, as the surface is small and turns little over the sub-bands.
    Polynomials are fitted to exact covariances, with as few powers as the error allows.
    """

    def __init__(self, model: MeasurementModel, power: int) -> None:
        self._model, scenario = model, model.scenario
        self._constant = model.covariance_in_shadow()
        self._powers = np.array([
            powers for powers in itertools.product(range(power + 1), repeat=3)
            if powers[1] + powers[2] <= power])
        self._middle = [int(np.argmin(np.sum(element_positions(scenario)**2, axis=1)))]
        low, high = self._bounds_m = scenario.roi_bounds_m
        self._limits = np.sort(_smooth(polar_bounds(self._bounds_m)), axis=0)
        n = 2 * len(self._powers)
        places = low + (high - low) * streams.unit_points()[:n + _N_TESTS]
        exact, gains = model.covariance_at(places), self._gains(places[:n])
        smooth = (exact[:n] - self._constant) / gains[..., None] / gains.conj()[:, :, None]
        self._coefficients = np.linalg.lstsq(
            self._polynomials(places[:n]), smooth.reshape(n, -1).view(float), rcond=None)[0]
        errors = model.whitener @ (self(places[n:]) - exact[n:]) @ adjoint(model.whitener)
        #: Largest norm of the error of a whitened covariance.
        self.error = float(np.linalg.norm(errors, axis=(2, 3)).max())

    @classmethod
    def of(cls, model: MeasurementModel) -> Callable[[np.ndarray], np.ndarray]:
        """Return `MeasurementModel.covariance_at`, interpolated if this is accurate."""
        n_bytes = model.covariance_in_shadow().nbytes
        for power in _POWERS if model.surface is None and not model.elements.is_exact else ():
            if (power + 1)**2 * (power + 2) * n_bytes > _POINT_BYTES:
                break
            if (found := cls(model, power)).error <= _MAX_ERROR:
                return found
        return model.covariance_at

    def __call__(self, positions: np.ndarray) -> np.ndarray:
        """Return covariances at positions [M, 3] [m], complex128 [M, N_B, N_SB F, N_SB F].

        Those beyond the region are exact.
        """
        found = (self._polynomials(positions) @ self._coefficients).view(complex).reshape(
            len(positions), *self._constant.shape)
        gains = self._gains(positions)
        found *= gains[..., None]
        found *= gains.conj()[:, :, None]
        found += self._constant
        low, high = self._bounds_m
        beyond = np.any((positions < low - _BORDER_M) | (positions > high + _BORDER_M), axis=1)
        if beyond.any():
            found[beyond] = self._model.covariance_at(positions[beyond])
        return found

    def _polynomials(self, positions: np.ndarray) -> np.ndarray:
        """Return products of powers at positions [M, 3], float64 [M, K]."""
        low, high = self._limits
        scaled = (2 * _smooth(to_polar(positions)) - low - high) / np.where(
            high > low, high - low, 1.0)
        values = scaled[:, :, None]**np.arange(self._powers.max() + 1)
        products: np.ndarray = np.prod(
            [values[:, axis, self._powers[:, axis]] for axis in range(3)], axis=0)
        return products

    def _gains(self, positions: np.ndarray) -> np.ndarray:
        """Return gains of an element in the middle, in any unit, complex128 [M, N_B, N_SB F]."""
        scenario = self._model.scenario
        waves, _, _ = los_waves(
            scenario, positions, range(scenario.n_bands), self._middle, slopes=False)
        return np.moveaxis(waves[..., 0], 2, 0).repeat(scenario.n_frames, axis=2)


def _smooth(points: np.ndarray) -> np.ndarray:
    """Return 1/r, u and v of points (r [m], u, v), float64 [M, 3]."""
    return np.column_stack([1 / points[:, 0], points[:, 1:]])


class DispersedLikelihood(Conditional):
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
        self._intact_at = InterpolatedCovariance.of(self._intact)
        self._average_at = InterpolatedCovariance.of(self._average) if share else self._intact_at
        self._scales, log_weights = _failure_counts(scenario.n_elements, share)
        self._offsets = log_weights + likelihood.log_det
        roots = covariance_root(scenario, self._covariances(MeasurementModel.covariance))
        self.n_at_once = max(_MAX_BYTES // roots.nbytes, 1)
        self._information = [likelihood.nuisance.information_of(*both)
                             for both in zip(roots, np.linalg.inv(roots), strict=True)]

    def _covariances(self, of: Callable[[MeasurementModel], np.ndarray]) -> np.ndarray:
        """Return a covariance for each number of failures, [K, N_B, N_SB F, N_SB F]."""
        average, least = of(self._average), of(self._intact)
        return least + self._scales[:, None, None, None] * (average - least)

    def states(self, of: Callable[[MeasurementModel], np.ndarray]) -> 'list[SurfaceState]':
        """Return the states of the surface with covariances `of` a model, for all positions."""
        covariances, root = self._covariances(of), self._base.model.combined_root
        operators = np.matmul(adjoint(root), np.linalg.solve(covariances, root[None]))
        offsets = self._offsets - np.linalg.slogdet(covariances)[1].sum(axis=1)
        unit = np.eye(root.shape[-1])
        return [SurfaceState(offset, None if np.allclose(one, unit) else one)
                for offset, one in zip(offsets.tolist(), operators, strict=True)]

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

    def at(self, points: np.ndarray, values: np.ndarray, *, moves: bool = True,
           turns: bool = True) -> 'LocatedStates':
        """Return the likelihood at points; see `Conditional.at`."""
        users, by_unknown = self._base.nuisance.states(points, values, moves, turns)
        positions = users[:, :3]
        # Without errors, an intact surface has the same covariance at all points.
        intact = self._intact_at(
            positions[:1] if self._intact.elements.is_exact else positions)
        excess = (self._average_at(positions) - intact if any(self._scales)
                  else np.zeros(1))
        states = []
        for scale, offset, information in zip(
                self._scales, self._offsets, self._information, strict=True):
            factors = Factors.of(
                self._base.nuisance, intact + scale * excess if scale else intact)
            states.append((factors, offset - factors.log_det, information))
        mean, slopes = self._average.mean_and_jacobian(users, by_unknown)
        return LocatedStates(self._base.nuisance, mean, slopes, slopes[:, :0], states)


class SurfaceState(NamedTuple):
    """A state of the surface with one covariance for all positions; by default, the only state.

    For whitened signals y and a whitened mean t, its log-likelihood is ``offset - d^H M d`` with
    d = y - t, up to the constant of `Likelihood`.
    """

    offset: float = 0.0
    operator: np.ndarray | None = None  #: M, complex128 [N_B, n, n]; None for the identity.

    def apply(self, whitened: np.ndarray) -> np.ndarray:
        """Multiply whitened signals [..., N_B, n] by M."""
        return whitened if self.operator is None else multiply_rows(self.operator, whitened)

    def energy(self, whitened: np.ndarray) -> np.ndarray:
        """Return ``y^H M y`` of whitened signals [..., N_B, n], float64 [...]."""
        return np.sum((whitened.conj() * self.apply(whitened)).real, axis=(-2, -1))


ONE_STATE = (SurfaceState(),)


class LocatedStates(NamedTuple):
    """The likelihood at M points, averaged over states of the surface: a `Located`."""

    prior: NuisancePrior
    mean: np.ndarray  # Complex128 [M, N_B, N_SB F].
    # Derivatives of `mean` with respect to point and velocity, [M, P + D, N_B, N_SB F].
    slopes: np.ndarray
    linear: np.ndarray  # Those of `Columns.linear`, [M, L, N_B, N_SB F].
    # For each state: factors of the covariance, constant of the log-likelihood, [M] or [1], and
    # information of the covariance about the parameters.
    states: list[tuple[Factors, np.ndarray, np.ndarray]]

    def local(self, values: np.ndarray, signals: Signals) -> Local:
        """Evaluate the likelihood; see `Located.local`."""
        prior, found = self.prior, []
        columns = prior.columns(
            values, signals.received, self.mean, self.slopes, self.linear)
        n_points = self.slopes.shape[1] - prior.velocity.shape[1]
        for factors, offset, information in self.states:
            white = Columns.of(
                factors.whiten(columns), len(prior), self.linear.shape[1], n_points)
            local = assemble(prior, values, white, information, factors.noise)
            found.append(local._replace(value=local.value + offset))
        return _average_of(found)


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
    # The distribution of `scipy.stats`, whose import takes a second. Most nodes need neither.
    from scipy.special import gammaln, xlog1py, xlogy
    counts = np.arange(n_elements + 1)
    probability = np.exp(
        gammaln(n_elements + 1) - gammaln(counts + 1) - gammaln(n_elements - counts + 1)
        + xlogy(counts, share) + xlog1py(n_elements - counts, -share))
    likely = counts[probability > _MIN_PROBABILITY]
    if len(likely) > _MAX_COUNTS:
        likely = np.unique(np.linspace(likely[0], likely[-1], _MAX_COUNTS).round().astype(int))
    weights = probability[likely] / probability[likely].sum()
    return likely / (n_elements * share), np.log(weights)
