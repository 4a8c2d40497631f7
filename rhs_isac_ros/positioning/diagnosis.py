"""Tests of whether the model explains received signals, of one shot and in the latest cycles.

Whitened signals y from a position with the whitened mean t differ from t by noise of unit
variance, so ``2 |y - t|^2`` has a chi-square distribution with two degrees of freedom per
measurement. Signals beyond its quantiles do not fit any position of the region (`FitTest`).
Possible causes are a user elsewhere, another codebook, or a silent or defective receiver.

This test detects only gross errors of the model. The mean energy of many residuals also reveals
small errors, such as a wrong delay spread, which leave positions plausible but their covariances
too small. The variance of the energy reveals deviations that differ from shot to shot, such as
unknown gains of the users, although the best position absorbs the larger part of them
(`InnovationTest`).

The mean alone does not distinguish a wrong level of the multipath from a wrong spread, because
both can raise or lower it. A wrong level scales all residuals, and leaves their relative variance
unchanged. The relative variance grows if a wrong spread concentrates the energy in a few
directions of the signals, or if levels differ between users or places (`diagnose`).
"""

import collections
import math
from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import gaussian
from rhs_isac_ros.positioning.alternatives import ALTERNATIVES, probabilities_of
from rhs_isac_ros.positioning.estimate import Estimate

# Numbers of residuals: in the window, required to end a warning, and required to begin one.
WINDOW = 400
MIN_RETURN = 100
MIN_RESIDUALS = 10
# Probabilities that the residuals of a correct model cause a warning. For the variance, the
# approximation is less accurate.
_BEGIN = 1e-6, 1e-7
# A warning ends when the p-values of the latest residuals reach these. They are high, so that a
# small deviation does not cause one warning after another.
_END = 0.9, 0.5
# Tolerated error of an expectation, and tolerated relative excess of the variance. Modes that are
# not Gaussian cause both.
_TOLERANCES = 0.5, 0.15
# Limits of a residual's deviation, in standard deviations, and of its square. The first keeps a
# single signal from causing a warning, and the second keeps a few from dominating.
_DEVIATION = 6.0
_SQUARE = 9.0
# Subjects with which reasons begin.
_ENERGY = 'energy of the signals'
_RESIDUAL = 'residual energy at the best position'
# Likely causes of a missing position.
LEVEL = 'level of the multipath or of the users'
SPREAD = 'spread of delays, angles or levels'
# Relative variance of the residuals, in units of its value in the model, above which a wrong level
# does not explain the residuals: nearly three standard errors over a full window.
_MAX_DISPERSION = 1.2


class FitTest:
    """Tests of the energies of N_B N_SB F signals; each returns a reason to reject, or ''.

    `level` is the median power of the multipath of users in sight, relative to the model. `board`
    names the declared board, which residuals that are too large may contradict.
    """

    def __init__(self, n_measurements: int, level: float = 1.0, board: str = '') -> None:
        from scipy.special import gammaincinv

        self.min_energy = float(gammaincinv(n_measurements, gaussian.FALSE_ALARM))
        self._level = level
        # If the level of the multipath is unknown, the ratio of the likelihoods with and without a
        # direct path is (energy / residual)**n.
        self._weak_share = gaussian.FALSE_ALARM**(1 / n_measurements)
        self.max_residual = gaussian.energy_limit(n_measurements)
        self._hint = f'; the surface may have another board than {board!r}' if board else ''

    def min_energy_test(self, energy: float) -> str:
        """Reject signals weaker than noise; `energy` is relative to the noise."""
        if energy >= self.min_energy:
            return ''
        return (f'{_ENERGY}: {energy:.3g}, expected at least {self.min_energy:.3g}, '
                'the energy of noise')

    def max_energy_test(self, energy: float, max_mean_energy: float) -> str:
        """Reject signals stronger than noise plus the strongest whitened mean in the region."""
        # The norm of a sum is at most the sum of the norms.
        return _excess(_ENERGY, energy, (max_mean_energy**0.5 + self.max_residual**0.5)**2)

    def weak_test(self, energy: float, residual: float) -> str:
        """Reject signals weaker than the multipath, unless a direct path explains them."""
        # Multipath may be weaker than in the model, but then the direct path at the best position
        # explains most of the energy.
        excess = _excess(_RESIDUAL, residual, self._weak_share * energy)
        if energy >= self._level * self.min_energy or not excess:
            return ''
        return f'{excess} of signals weaker than the multipath'

    def residual_test(self, residual: float) -> str:
        """Reject signals whose residual at the best position exceeds the limit for noise."""
        excess = _excess(_RESIDUAL, residual, self.max_residual)
        return excess and excess + self._hint


def _excess(subject: str, value: float, limit: float) -> str:
    return '' if value <= limit else f'{subject}: {value:.3g}, expected at most {limit:.3g}'


def misfit_log_ratio(residual: float, n: int, level_db: tuple[float, float] = (0.0, 0.0)) -> float:
    """Return how likely n measurements with a residual energy fit no position: a log-likelihood.

    It is relative to the best position, with the median and standard deviation `level_db` of the
    multipath. Without a position, the residual has an unknown level.
    """
    (median_db, std_db), energy = level_db, np.array([[residual]])
    in_sight, misfit = (gaussian.log_evidence_of_level(energy, n, one_db, median_db)
                        for one_db in (std_db, math.hypot(std_db, gaussian.BLOCKED_STD_DB)))
    return float((misfit - in_sight)[0])


class InnovationTest:
    """A test of whether the energies of the latest residuals have the expected mean and variance.

    Twice an energy has approximately a chi-square distribution, whose mean is twice
    `Estimate.expected_residual`. With a measured covariance, the energy is also multiplied by the
    level of the multipath, a log-normal power with the median and standard deviation `level_db`.
    The level does not change for users at rest, or in one part of the region, so it may be the
    same in all residuals. Raises ValueError if the window is shorter than `MIN_RETURN`, because
    then no warning could end.
    """

    #: Whether the residuals deviate from the model. It is set when their mean or variance over the
    #: window is improbable, and reset when both are probable over the latest `MIN_RETURN` of them.
    drifts: bool

    def __init__(
            self, window: int = WINDOW, level_db: tuple[float, float] = (0.0, 0.0)) -> None:
        if window < MIN_RETURN:
            raise ValueError(f'window: {window}, expected at least {MIN_RETURN}')
        self._window, (median_db, self._std_db) = window, level_db
        self._median = 10**(median_db / 10)
        self.clear()

    def clear(self) -> None:
        """Remove all residuals, for example after a change of the scenario or codebook."""
        self._residuals: collections.deque[tuple[_Sum, _Sum]] = collections.deque(
            maxlen=self._window)
        self.drifts = False

    def add(self, energy: float, expected: float) -> None:
        """Add a residual's energy and its expectation, unless one is NaN, and update `drifts`."""
        if np.isnan(energy) or not np.isfinite(expected):
            return
        self._residuals.append(_terms(energy / self._median, expected, self._std_db))
        if self.drifts:
            latest = list(self._residuals)[-MIN_RETURN:]
            if len(latest) == MIN_RETURN and _fit(latest, _END):
                self.clear()
                self._residuals.extend(latest)
        elif len(self._residuals) >= MIN_RESIDUALS:
            self.drifts = not _fit(self._residuals, _BEGIN)

    @property
    def n_residuals(self) -> int:
        """Number of residuals in the window."""
        return len(self._residuals)

    @property
    def ratio(self) -> float:
        """Mean energy relative to the expectation; NaN without residuals."""
        total = _Sum.of(energy for energy, _ in self._residuals)
        return total.value / max(total.expected, 0.5) if self._residuals else np.nan

    @property
    def spread(self) -> float:
        """Variance of the energy relative to its value in the model; NaN without residuals."""
        total = _Sum.of(square for _, square in self._residuals)
        return total.value / total.expected if self._residuals else np.nan


class _Sum(NamedTuple):
    """A sum of n terms, whose errors have a part of their own and a part that all may share."""

    n: int
    value: float
    expected: float
    own_variance: float
    common_std: float

    @classmethod
    def of(cls, terms: Iterable['_Sum']) -> '_Sum':
        return cls(*map(sum, zip((0,) * len(cls._fields), *terms, strict=True)))

    @property
    def variance(self) -> float:
        return self.own_variance + self.common_std**2


def _terms(energy: float, expected: float, level_std_db: float) -> tuple[_Sum, _Sum]:
    """Return the energy of a residual and the square of its normalised deviation.

    The energy is relative to the median level of the multipath. The uncertainty of the level
    causes the common parts.
    """
    scale = max(expected, 1.0)
    share = gaussian.share_of_level(scale, level_std_db)
    shape = scale * (1 - share)
    std = scale / shape**0.5
    deviation = min(max((energy - expected) / std, -_DEVIATION), _DEVIATION)
    own_variance = max(expected, 0.0)
    # The square of a normalised gamma variable of shape k has the mean 1 and this variance.
    square_variance = 2 + 6 / shape
    return (_Sum(1, expected + deviation * std, expected, own_variance,
                 (own_variance * share / (1 - share))**0.5),
            _Sum(1, min(deviation**2, _SQUARE), 1.0, square_variance * (1 - share**2),
                 square_variance**0.5 * share))


def _fit(residuals: Iterable[tuple[_Sum, _Sum]], probabilities: tuple[float, float]) -> bool:
    """Return whether the p-values of the mean and the variance are at least as high as these."""
    energy, square = (_Sum.of(terms) for terms in zip(*residuals, strict=True))
    return (_p_value_of_mean(energy) >= probabilities[0]
            and _p_value_of_spread(square) >= probabilities[1])


def _p_value_of_mean(total: _Sum) -> float:
    """Return the two-sided p-value of a sum of energies."""
    # Every node imports this package, and SciPy takes longer to load than ROS.
    from scipy.special import gammainc, gammaincc

    # With few measurements and many modes, an expectation may be negative.
    expected, slack = max(total.expected, 0.5 * total.n), _TOLERANCES[0] * total.n
    shape = expected**2 / max(total.variance, 0.5 * total.n)
    low, high = (shape / expected * (total.value + sign * slack) for sign in (-1, 1))
    return 2 * float(min(gammainc(shape, high), gammaincc(shape, max(low, 0.0))))


def _p_value_of_spread(total: _Sum) -> float:
    """Return the one-sided p-value of a sum of squared deviations, nearly a gamma variable."""
    from scipy.special import gammaincc

    tolerated = 1 + _TOLERANCES[1]
    mean, variance = total.expected * tolerated, total.variance * tolerated**2
    return float(gammaincc(mean**2 / variance, max(total.value, 0.0) * mean / variance))


def diagnose(estimates: Collection[Estimate], deviates: bool,
             level_std_db: float = 0.0) -> dict[str, str]:
    """Return diagnostic values, as text by key, from the estimates of the latest cycles.

    ``probability.<alternative>`` is the mean probability of an alternative. ``no_fix.share`` and
    ``no_fix.cause`` exist if there are cycles without a fix. `deviates` is whether the residuals
    deviate from the scenario, in which case the probabilities are wrong.
    """
    values = {}
    probabilities = [probabilities_of(one) for one in estimates]
    for kind in ALTERNATIVES:
        found = [each[kind.name] for each in probabilities if kind.name in each]
        if found:
            values[f'probability.{kind.name}'] = f'{np.mean(found):.3f}'
    # The part of a reason before the colon is its subject.
    subjects = collections.Counter(
        str(one.reason).partition(':')[0] for one in estimates if one.reason)
    if subjects:
        values['no_fix.share'] = f'{sum(subjects.values())} of {len(estimates)}'
        values['no_fix.cause'] = _cause(
            estimates, subjects.most_common()[0][0], deviates, level_std_db)
    return values


def _cause(estimates: Collection[Estimate], subject: str, deviates: bool,
           level_std_db: float) -> str:
    """Return the likely cause of missing positions, given the most frequent `subject`."""
    residual, expected = np.array([
        (one.residual, one.expected_residual) for one in estimates
        if one.residual > 0 and one.expected_residual > 0]).reshape(-1, 2).T
    is_alternative = subject in {kind.reason for kind in ALTERNATIVES}
    if len(residual) < MIN_RESIDUALS or is_alternative and not deviates:
        return subject
    # The energy of n complex measurements has the relative variance 1 / n; levels add to it.
    n = float(np.mean(expected))
    shape = n * (1 - gaussian.share_of_level(n, level_std_db))
    dispersion = float(shape * np.var(np.log(residual / expected)))
    return LEVEL if dispersion <= _MAX_DISPERSION else SPREAD
