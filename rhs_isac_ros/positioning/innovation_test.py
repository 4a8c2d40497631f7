"""A running test of whether the residuals of fixes have the energy that the model predicts.

A single residual is tested at `fit.FALSE_ALARM`, which only gross errors of the model exceed. The
mean over many fixes reveals small ones, such as a wrong delay spread, which leave the positions
plausible but their covariances too small. Their variance reveals deviations that differ from phase
to phase, such as unknown gains of the users, of which the best position absorbs the larger part.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

# Probability that the mean residual of a correct model causes a warning, and that their variance
# does, for which the approximation is less accurate.
FALSE_WARNING = 1e-6
FALSE_SPREAD_WARNING = 1e-7
# Probability of the latest residuals from which a warning ends: high, so that a small deviation
# does not end and begin again and again.
RETURN = 0.9
SPREAD_RETURN = 0.5
# Number of residuals in the mean, of those that end a warning, and the smallest number that is
# judged.
WINDOW = 400
MIN_RETURN = 100
MIN_FIXES = 10
# Tolerated error of an expectation, from modes that are not Gaussian.
_TOLERANCE = 0.5
# Tolerated relative excess of the variance, for the same reason.
_SPREAD_TOLERANCE = 0.15
# Larger deviations from the expectation count as this many standard deviations, so that no single
# signal causes a warning.
_MAX_DEVIATIONS = 6.0
# The same for the variance, which a few signals that the estimator misjudges should not dominate.
_MAX_SQUARE = 9.0


class InnovationTest:
    """Mean and variance of the energy of the last residuals, compared with the expectation.

    Twice an energy has approximately a chi-square distribution; `Estimate.expected_residual` is
    half its mean.

    Parameters
    ----------
    window
        Number of residuals in the mean, at least `MIN_RETURN`.

    Attributes
    ----------
    drifts
        Whether the residuals deviate from the model. This begins when the mean or the variance
        over the window is improbable, and ends when those of the latest `MIN_RETURN` are not.

    Raises
    ------
    ValueError
        If the window is smaller, so that no warning would end.
    """

    def __init__(self, window: int = WINDOW) -> None:
        if window < MIN_RETURN:
            raise ValueError(f'window: {window}, expected at least {MIN_RETURN}')
        self._window = window
        self._residuals: deque[_Residual] = deque()
        self._sum = _NOTHING
        self.drifts = False

    def add(self, energy: float, expected: float) -> None:
        """Add the energy of a residual and its expectation; if one of them is NaN, do nothing."""
        if np.isnan(energy) or np.isnan(expected):
            return
        scale = max(expected, 1.0)
        deviation = (energy - expected) / scale**0.5
        deviation = min(max(deviation, -_MAX_DEVIATIONS), _MAX_DEVIATIONS)
        self._append(_Residual(
            expected + deviation * scale**0.5, expected, min(deviation**2, _MAX_SQUARE),
            2 + 6 / scale))
        if self.drifts:
            latest = list(self._residuals)[-MIN_RETURN:]
            total = _Residual(*np.sum(latest, axis=0).tolist())
            if len(latest) == MIN_RETURN and (
                    _probability(total, MIN_RETURN) >= RETURN
                    and _spread_probability(total, MIN_RETURN) >= SPREAD_RETURN):
                self.clear()
                for residual in latest:
                    self._append(residual)
        elif len(self._residuals) >= MIN_FIXES:
            n = len(self._residuals)
            self.drifts = (_probability(self._sum, n) < FALSE_WARNING
                           or _spread_probability(self._sum, n) < FALSE_SPREAD_WARNING)

    def _append(self, residual: '_Residual') -> None:
        if len(self._residuals) == self._window:
            self._sum = self._sum.plus(self._residuals.popleft(), -1)
        self._residuals.append(residual)
        self._sum = self._sum.plus(residual, 1)

    def clear(self) -> None:
        """Remove all residuals, for example after a change of the scenario or codebook."""
        self._residuals.clear()
        self._sum = _NOTHING
        self.drifts = False

    @property
    def n_fixes(self) -> int:
        """Number of residuals in the window."""
        return len(self._residuals)

    @property
    def ratio(self) -> float:
        """Mean energy relative to the expectation; NaN without residuals."""
        return self._sum.energy / max(self._sum.expected, 0.5) if self._residuals else np.nan

    @property
    def spread(self) -> float:
        """Variance of the energy about the expectation, relative to that of the model.

        It is NaN without residuals.
        """
        return self._sum.square / len(self._residuals) if self._residuals else np.nan


class _Residual(NamedTuple):
    """A residual, or a sum of several: `square` is that of the normalised deviation."""

    energy: float
    expected: float
    square: float
    square_variance: float

    def plus(self, other: '_Residual', factor: int) -> '_Residual':
        return _Residual(*(one + factor * two for one, two in zip(self, other, strict=True)))


_NOTHING = _Residual(0.0, 0.0, 0.0, 0.0)


def _probability(total: _Residual, n: int) -> float:
    """Probability of a sum at least as far from the expected sum of `n` energies, on either side.

    A sum below the expectation counts, too: the assumed multipath is then too strong in some
    directions of the signals, and may be too weak in others.
    """
    # Every node imports this package, and SciPy takes longer to load than ROS.
    from scipy.special import gammainc, gammaincc

    # With few measurements and many modes, an expectation may be negative.
    expected, slack = max(total.expected, 0.5 * n), _TOLERANCE * n
    # Half a chi-square variable of 2 k degrees of freedom is a gamma variable of shape k.
    return 2 * float(min(gammainc(expected, total.energy + slack),
                         gammaincc(expected, max(total.energy - slack, 0.0))))


def _spread_probability(total: _Residual, n: int) -> float:
    """Probability of a sum of `n` squared deviations that is at least as large.

    The sum is approximately a gamma variable. The square of a normalised gamma variable of shape
    k has the mean 1 and the variance 2 + 6 / k.
    """
    from scipy.special import gammaincc

    mean = n * (1 + _SPREAD_TOLERANCE)
    variance = total.square_variance * (1 + _SPREAD_TOLERANCE)**2
    return float(gammaincc(mean**2 / variance, max(total.square, 0.0) * mean / variance))
