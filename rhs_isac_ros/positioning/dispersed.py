"""The likelihood with the covariance of element errors at each position."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.arrays import adjoint, mixture_weights, multiply_rows
from rhs_isac_ros.model.gaussian import covariance_root
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

# Numbers of failures to average over: smallest probability of each, and how many at most.
_MIN_PROBABILITY = 1e-5
_MAX_COUNTS = 12
# Memory of the covariances of several points [bytes]; less of it stays in the cache.
_MAX_BYTES = 1 << 23
# Share of the whitened energy up to which errors of an estimated surface need no covariance for
# each position.
_MIN_ERROR_SHARE = 0.05


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
        intact = self._intact.covariance_at(
            positions[:1] if self._intact.elements.is_exact else positions)
        excess = (self._average.covariance_at(positions) - intact if any(self._scales)
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
