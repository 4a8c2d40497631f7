"""The posterior over the whole region of interest: a slow reference for all estimators.

The likelihood is that of the estimators, evaluated at points of a Sobol sequence instead of modes.
Without impairments, moments are sums over all points. Otherwise, each shot draws some of the
points, with probabilities that follow from a cheap profile over the nuisance parameters. The
likelihood at these points is divided by the probability of the draw, so that sums keep their
expectation, and integrated over the parameters numerically where it matters.
"""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import to_polar
from rhs_isac_ros.positioning.dispersed import DispersedLikelihood
from rhs_isac_ros.positioning.estimate import Estimate, checked_received
from rhs_isac_ros.positioning.likelihood import Conditional, Likelihood
from rhs_isac_ros.positioning.neural import stack_parts
from rhs_isac_ros.positioning.offsets import Alignment
from rhs_isac_ros.positioning.posterior import BandPhases
from rhs_isac_ros.positioning.search import marginal_at
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.support.threads import one_blas_thread
from rhs_isac_ros.system import System

# Points evaluated at a time.
_BLOCK = 4096
# Expected number of points that a shot draws, with one covariance everywhere and with another one
# at each position. Their probability follows from the profile, raised to a power so that points
# which it misjudges are drawn, too.
_N_DRAWN = 2048
_N_DISPERSED = 600
_POWER = 0.5
# Log-likelihood below the best down to which parameters are integrated numerically, number of
# values at a point, and factor of their spread.
_MARGIN = 6.0
_N_VALUES = 32
_SPREAD = 1.2


@one_blas_thread
def exhaustive_posterior(
        scenario: Scenario, codebook: Codebook, received: np.ndarray, log2_points: int = 22, *,
        seed: int = 0) -> Estimate:
    """Compute mean and covariance of the posterior from points all over the region of interest.

    The prior is uniform on the region. All shots share the 2^log2_points points of a Sobol
    sequence, scrambled with the seed; the default number takes minutes. Signals are complex128
    [N, N_B, N_SB F] for an estimate of N positions.

    Impairments that the scenario declares are integrated out at every point. Element errors are
    treated as Gaussian, with their covariance at every point.

    Raises
    ------
    SignalError
        If the signals have another shape or are not finite.
    """
    from scipy.stats import qmc

    codebook.check(scenario)
    batch = checked_received(codebook, received)
    posterior = _Posterior(scenario, codebook, batch)
    low, high = scenario.roi_bounds_m
    sequence, total = qmc.Sobol(3, seed=seed), 2**log2_points
    points = np.empty((total, 3))
    profile = np.empty((len(batch), total), np.float32)
    for done in range(0, total, _BLOCK):
        block = slice(done, min(done + _BLOCK, total))
        points[block] = sequence.random(block.stop - done) * (high - low) + low
        profile[:, block] = posterior.profile(points[block])
    moments = [posterior.moments(shot, points, profile[shot]) for shot in range(len(batch))]
    means, covariances = map(np.stack, zip(*moments, strict=True))
    return Estimate(means, covariances)


class _Posterior:
    """The likelihood of N shots, as a cheap profile of all points and exactly at a few."""

    def __init__(self, scenario: Scenario, codebook: Codebook, received: np.ndarray) -> None:
        self._likelihood = likelihood = Likelihood(System(scenario, codebook))
        self._dispersed = DispersedLikelihood.of(likelihood)
        self._signals, self._phases = likelihood.signals(received), BandPhases(likelihood)
        alignment = Alignment(likelihood, tabulate(likelihood.model)['spread'])
        self._aligned = alignment.values_of_each(received)
        self._whitened = likelihood.whitened(self._aligned, self._signals)
        self._rng = np.random.default_rng(0)

    def profile(self, positions: np.ndarray) -> np.ndarray:
        """Maximise the log-likelihood over gain and phases, float32 [N, P]."""
        model, prior = self._likelihood.model, self._likelihood.nuisance
        means = model.whiten(model.mean(positions))
        if not len(prior):
            parts = stack_parts(means).astype(np.float32)
            doubled = (2 * stack_parts(self._whitened)).astype(np.float32) @ parts.T
        else:
            means = np.swapaxes(means, 0, 1).astype(np.complex64)
            outputs = np.matmul(np.swapaxes(self._whitened, 0, 1).astype(np.complex64),
                                np.conj(np.swapaxes(means, 1, 2)))
            amplitude = prior.amplitude(outputs)
            energies = np.sum(np.abs(self._whitened)**2, axis=(1, 2))
            n = self._whitened[0].size
            doubled = np.stack([prior.maximised_over_gain(one, float(energy), n)[0]
                                for one, energy in zip(amplitude, energies, strict=True)])
            means = np.swapaxes(means, 0, 1)
        return doubled - np.sum(np.abs(means)**2, axis=(1, 2))

    def moments(self, shot: int, points: np.ndarray, profile: np.ndarray
                ) -> tuple[np.ndarray, np.ndarray]:
        """Compute mean and covariance of the posterior of a shot over points [P, 3]."""
        value = profile.astype(float)
        if len(self._likelihood.nuisance) or self._dispersed:
            n_drawn = _N_DISPERSED if self._dispersed else _N_DRAWN
            share = _POWER * (value - value.max())
            share += np.log(n_drawn) - np.log(np.sum(np.exp(share)))
            if len(points) <= n_drawn:
                share[:] = 0.0
            (drawn,) = np.nonzero(np.log(self._rng.uniform(size=len(share))) < share)
            points = points[drawn]
            value = self._exact(shot, to_polar(points)) - np.minimum(share[drawn], 0.0)
        weights = np.exp(value - value.max())
        weights /= weights.sum()
        mean = weights @ points
        offsets = points - mean
        return mean, (weights[:, None] * offsets).T @ offsets

    def _exact(self, shot: int, points: np.ndarray) -> np.ndarray:
        """Log-likelihood of points [P, 3], with the parameters integrated out, [P]."""
        likelihood = self._likelihood
        conditional: Conditional = self._dispersed or likelihood
        prior, value = likelihood.nuisance, np.empty(len(points))
        values = np.repeat(self._aligned[shot][None], len(points), axis=0)
        outputs = likelihood.at(points, values, moves=False).outputs(
            values, select(self._signals, [shot]))
        if len(prior):
            # The steps of `marginal_at` begin near the most likely gain.
            whitened = self._whitened[shot]
            _, gain = prior.maximised_over_gain(
                prior.amplitude(outputs.T), float(np.sum(np.abs(whitened)**2)), whitened.size)
            values += prior.start(outputs.T, np.broadcast_to(gain, len(points)))
        for start in range(0, len(points), _BLOCK):
            block = slice(start, start + _BLOCK)
            value[block], values[block], _ = marginal_at(
                conditional, likelihood, points[block], values[block],
                select(self._signals, [shot]))
        if not len(prior):
            return value
        (near,) = np.nonzero(value >= value.max() - _MARGIN)
        value[near] = self._integrated(conditional, points[near], values[near], shot)
        if self._phases.is_informative:
            signals = select(self._signals, [shot])
            outputs = likelihood.at(points, values, moves=False).outputs(values, signals)
            turned = outputs * np.exp(1j * values @ prior.phases.T)
            value += self._phases.factors(turned.T)[0]
        return value

    def _integrated(self, conditional: Conditional, points: np.ndarray, values: np.ndarray,
                    shot: int) -> np.ndarray:
        """Integrate over the parameters by importance sampling around their best values."""
        from scipy.special import ndtri
        from scipy.stats import qmc

        n_values = values.shape[1]
        normal = ndtri(qmc.Sobol(n_values, seed=0).random(_N_VALUES))
        signals = select(self._signals, [shot])
        located = conditional.at(points, values, moves=False)
        among = located.local(values, signals).information
        roots = np.linalg.cholesky(among)
        value = np.empty((len(points), _N_VALUES))
        for column, one in enumerate(normal):
            offset = np.linalg.solve(np.swapaxes(roots, 1, 2), np.broadcast_to(
                _SPREAD * one, values.shape)[..., None])[..., 0]
            local = located.local(values + offset, signals)
            value[:, column] = local.value + one @ one / 2
        highest = value.max(axis=1)
        average = highest + np.log(np.mean(np.exp(value - highest[:, None]), axis=1))
        return (average + n_values * np.log(_SPREAD)
                - np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1))
