"""Tests of whether a user moves as the scenario declares while the surface steps its patterns.

Signals of a user who moves otherwise often fit a wrong position. Two alternatives to a user as
declared therefore have an evidence, the likelihood averaged over their unknowns:

* Amplitude and phase of the direct path are Gaussian and independent from frame to frame, as those
  of a user who crosses several beams of the surface in a cycle. Only the delay is common. What
  failed elements do to the direct path is part of this, so the surface counts as intact.
* If users are declared to be slower, the user moves slowly, or walks. One Gauss-Newton step from
  each mode, with such a velocity, finds those who move little, and are near a mode.
* If the scenario declares a velocity, the user is a few times as fast. From one frame to the next,
  the direct path then turns by a few turns more than that of a mode, and signals are similar.

These share the prior probability of a user who moves otherwise than declared.

If the scenario declares a velocity, a residual and a velocity that are improbable together also
show that the user is too fast. With short frames, the phase of the direct path hardly changes
during a cycle, whatever the user does, and no test is needed. Nor is one with a single frame in
each band, if the phases of the bands are unknown: no phases are then compared.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.arrays import log_sum
from rhs_isac_ros.model.constants import POWER_NEPERS_PER_DB
from rhs_isac_ros.model.geometry import (
    frame_times_s,
    jacobian,
    polar_derivative,
    stands_still,
    velocity_std_mps,
)
from rhs_isac_ros.positioning.estimate import Fit
from rhs_isac_ros.positioning.failures import refinement_of
from rhs_isac_ros.positioning.grid import Starts
from rhs_isac_ros.positioning.lattice import Resolution, subband_wavenumbers
from rhs_isac_ros.positioning.likelihood import Conditional, Likelihood, Signals
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.search import Modes, ascend, one_step
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.support import streams
from rhs_isac_ros.system import System

# Speed of users who walk, at which frames are long [m/s].
_WALKING_MPS = 1.5
# Standard deviations of each component of velocities: of users who move slowly or walk [m/s], and
# of those who are faster than declared, relative to the declared one.
_SLOW_STD_MPS, _FASTER = (0.1, 1.0), 4.0
# Largest numbers of turns and of steps to a mode for users who are faster than declared, and the
# share of a speed across the line of sight that is too large.
_TURNS, _STEPS, _ACROSS = 2, 6, 0.5
# Prior probability that a user moves otherwise, and largest probability with a fix: above it, a
# 95 % region cannot attain its coverage.
_PRIOR, _LIMIT = 0.03, 0.05
# Log ratio of evidences, predicted at a mode, below which an exact one is never above the limit.
_IMPROBABLE = -3.0
# Probability of a residual and a velocity below which the user may be faster than declared.
_TOO_FAST = 2e-3
# Numbers of powers of the direct path, and of positions from whose means these follow; largest
# offset of the timing in standard deviations; and largest number of delays for each sub-band.
_POWERS, _POSITIONS, _OFFSET, _DELAYS = 9, 64, 1.5, 2


class MovementTest:
    """Tests of the movement in one cycle, for a system with long frames."""

    def __init__(self, system: System, likelihood: Likelihood) -> None:
        self._system, self._likelihood, scenario = system, likelihood, system.scenario
        # Without failures, this is the system itself.
        self._intact, self._of_frames = system, likelihood
        if scenario.failed_element_share:
            self._intact = System(dataclasses.replace(scenario, failed_element_share=0.0),
                                  system.codebook, system.surface)
            self._of_frames = Likelihood(self._intact)
        self._bases, self._shares, self._energies = _frames(self._intact)
        declared = scenario.user_speed_std_mps
        self._others = [_Others(system, likelihood.nuisance, std_mps)
                        for std_mps in _SLOW_STD_MPS if std_mps > declared]
        if declared:
            self._others.append(_Others(
                system, likelihood.nuisance, _FASTER * declared, _TURNS))

    @classmethod
    def of(cls, system: System, likelihood: Likelihood) -> 'MovementTest | None':
        """Return the tests, or None if movement does not matter to the phases of the frames."""
        is_short = stands_still(system.scenario, _WALKING_MPS)
        is_single = system.scenario.n_frames == 1 and likelihood.nuisance.is_coarse
        return None if is_short or is_single else cls(system, likelihood)

    def reason(self, fit: Fit, modes: Modes | None, conditionals: Sequence[Conditional],
               signals: Signals, aligned: np.ndarray, level: float) -> str:
        """Return why there is no fix, or ''.

        Takes one shot with the likelihoods for each state of the surface, the parameters `aligned`
        that follow from the signals alone, float64 [Q], and the level of the multipath that the
        residual shows, relative to the model.
        """
        log_ratios = [self._unsteady(fit, signals, aligned, level)]
        if modes is not None:
            log_ratios += [one.log_ratio(modes, conditionals, signals) for one in self._others]
        log_ratio = log_sum(np.array(log_ratios)) - np.log(len(log_ratios))
        odds = _PRIOR / (1 - _PRIOR) * np.exp(min(log_ratio, 100.0))
        if odds > _LIMIT / (1 - _LIMIT):
            return (f'velocity: probability {odds / (1 + odds):.3g} that the user moves otherwise '
                    f'than with user_speed_std_mps = {self._system.scenario.user_speed_std_mps:g},'
                    f' expected at most {_LIMIT:g}')
        return self._too_fast(fit)

    def _unsteady(self, fit: Fit, signals: Signals, aligned: np.ndarray, level: float) -> float:
        """Return the log evidence of independent frames, relative to that of the fit."""
        likelihood, prior = self._of_frames, self._likelihood.nuisance
        constant = self._likelihood.log_det - likelihood.log_det
        if likelihood.model is self._intact:
            weights = likelihood.weights_at(np.array([fit.gain]))[0]
            whitened = likelihood.whitened(aligned[None], likelihood.signals(signals.received))[
                0] * np.exp(-fit.gain) * weights
            constant += 2 * float(np.log(weights).sum())
        else:
            whitened = self._intact.whiten(signals.received[0])
        powers = np.abs(np.einsum('tbnf,bn->tbf', self._bases.conj(), whitened))**2 / level
        excess = np.multiply.outer(self._energies, self._shares)
        values = np.sum(powers * excess / (1 + excess) - np.log1p(excess), axis=(2, 3))
        if prior.gain_std:
            # Laplace's integral over the gain, as in the evidence of the fit.
            n = signals.received.size
            constant -= (fit.gain / prior.gain_std)**2 / 2 + 2 * n * fit.gain + float(
                np.log(4 * n) / 2 + np.log(prior.gain_unit))
        rest = (fit.residual - np.sum(np.abs(whitened)**2)) / level - fit.residual
        return (log_sum(values) - np.log(values.size) + constant + float(rest)
                + prior.log_evidence_of_aligned(aligned) - fit.log_evidence)

    def _too_fast(self, fit: Fit) -> str:
        """Return the reason if residual and velocity are improbable together, or ''."""
        from scipy.special import chdtrc, ndtr

        scenario = self._system.scenario
        (moving,) = np.nonzero(velocity_std_mps(scenario))
        if not len(moving):
            return ''
        median_db, std_db = scenario.multipath_level_db
        expected = max(fit.expected, 0.5)
        residual = fit.residual / (10**(median_db / 10) * expected)
        std = np.hypot(expected**-0.5, POWER_NEPERS_PER_DB * std_db)
        speeds = fit.mean[3 + moving] / scenario.user_speed_std_mps
        # Fisher's method combines the probabilities.
        product = float(ndtr(-np.log(residual) / std) * chdtrc(len(speeds), np.sum(speeds**2)))
        probability = product * (1 - np.log(max(product, np.finfo(float).tiny)))
        return '' if probability >= _TOO_FAST else (
            f'velocity: {np.linalg.norm(speeds):.2g} standard deviations, with {residual:.3g} '
            f'times the expected residual energy: probability {probability:.1g}, expected at '
            f'least {_TOO_FAST:g}; the user may be faster than user_speed_std_mps')


class _Others:
    """Users with other velocities than declared, whose components have a standard deviation.

    With `turns`, the direct path turns by 1 to `turns` further turns from one frame to the next,
    in either direction, compared with a mode.
    """

    def __init__(self, system: System, declared: NuisancePrior, std_mps: float, turns: int = 0
                 ) -> None:
        scenario = system.scenario
        self._declared, self._likelihood = declared, Likelihood(System(
            dataclasses.replace(scenario, user_speed_std_mps=std_mps),
            system.codebook, system.surface))
        self._refinement = refinement_of(self._likelihood)
        self._turns = turns
        numbers = np.array([
            n for n in range(-turns, turns + 1) if n or not turns])[:, None, None]
        frequencies_hz, times_s = np.array(scenario.center_frequencies_hz), frame_times_s(scenario)
        self._further_mps = numbers * SPEED_OF_LIGHT_MPS / (
            frequencies_hz.mean() * scenario.frame_duration_s)
        # A turn is less speed in a band of a higher frequency. If such bands come later, a mode
        # that lacks turns away from the surface makes up for the difference by the growth of the
        # range with the square of the time: the speed across the line of sight is too large.
        rise = (frequencies_hz - frequencies_hz.mean()) @ times_s.mean(axis=1)
        self._across = np.where(numbers * rise > 0, _ACROSS, 1.0)

    def log_ratio(self, modes: Modes, conditionals: Sequence[Conditional], signals: Signals
                  ) -> float:
        """Return the log evidence of such a user, relative to that of the modes of one shot.

        Each mode keeps its state of the surface.
        """
        likelihood, prior, wide = self._likelihood, self._declared, self._likelihood.nuisance
        n_moving, n_wide = prior.velocity.shape[1], wide.velocity.shape[1]
        others = modes.values[:, n_moving:][:, ~prior.phases[:, n_moving:].any(axis=0)]
        velocities, away = (
            modes.values[:, :n_moving] @ prior.velocity.T, jacobian(modes.points)[:, :, 0])
        along = np.sum(velocities * away, axis=1)[:, None] * away
        velocities = along + self._across * (velocities - along) + self._further_mps * away
        n = len(self._further_mps)
        points, state = np.tile(modes.points, (n, 1)), np.tile(modes.state, n)
        values = np.zeros((len(points), len(wide)))
        values[:, n_wide:n_wide + others.shape[1]] = np.tile(others, (n, 1))
        values = wide.with_rates(values, points, np.matmul(
            polar_derivative(points), velocities.reshape(-1, 3, 1))[..., 0])
        starts = Starts(np.zeros(len(points), int), points, values)
        signals, mass = likelihood.signals(signals.received), modes.log_mass
        states = [(self._refinement.same(conditionals[one]), state == one)
                  for one in np.unique(state)]

        def relative(climb: Callable[..., Modes]) -> float:
            return log_sum(np.array([
                climb(conditional, likelihood, select(starts, rows), signals).log_mass
                for conditional, rows in states])) - mass
        if not self._turns:
            predicted = relative(lambda *args: one_step(*args)[0])
            if predicted < _IMPROBABLE:
                return predicted
        return relative(functools.partial(ascend, n_steps=_STEPS if self._turns else 1))


def _frames(system: System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bases of direct paths with independent frames, and energies of those in the region.

    For T delays and n whitened measurements of a band, the bases are complex128 [T, N_B, n, F].
    The second array contains the share of each direction in the energy, float64 [T, N_B, F], and
    the third one energies from the smallest to the largest, float64 [P].
    """
    scenario, resolution = system.scenario, Resolution.of(system.scenario)
    low, high = scenario.roi_bounds_m
    whitened, _ = system.mean_and_jacobian(
        low + (high - low) * streams.unit_points()[:_POSITIONS], np.zeros((_POSITIONS, 3, 0)),
        whitened=True)
    energies = np.sum(np.abs(whitened)**2, axis=(1, 2))
    offset_m = _OFFSET * SPEED_OF_LIGHT_MPS * min(
        scenario.timing_std_s, 1 / (2 * scenario.spacing_hz))
    ends_m = resolution.nearest_m - offset_m, resolution.farthest_m + offset_m
    n_delays = min(1 + int(np.ceil(2 * np.ptp(ends_m) / resolution.delay_m)),
                   _DELAYS * scenario.n_subbands)
    wavenumbers = subband_wavenumbers(scenario)
    wavenumbers = wavenumbers - wavenumbers.mean(axis=1, keepdims=True)
    turns = np.exp(-1j * wavenumbers * np.linspace(*ends_m, n_delays)[:, None, None])
    frames = turns[..., None] * np.eye(scenario.n_frames)[:, None, None, None]
    columns = system.whiten(frames.reshape(*frames.shape[:3], -1))
    bases, values, _ = np.linalg.svd(np.moveaxis(columns, 0, -1), full_matrices=False)
    shares = values**2 / np.sum(values**2, axis=(1, 2), keepdims=True)
    return bases, shares, np.geomspace(energies.min(), energies.max(), _POWERS)
