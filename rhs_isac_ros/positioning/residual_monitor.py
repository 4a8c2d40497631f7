"""A running test of whether the residuals of fixes have the energy that the model predicts.

A single residual is tested at `fit.FALSE_ALARM`, which only gross errors of the model exceed. The
mean over many fixes reveals small ones, such as a wrong delay spread, which leave the positions
plausible but their covariances too small.
"""

from collections import deque

import numpy as np

# Probability that the mean residual of a correct model causes a warning.
FALSE_WARNING = 1e-6
# Probability of the latest residuals from which a warning ends: high, so that a small deviation
# does not end and begin again and again.
RETURN = 0.9
# Number of residuals in the mean, of those that end a warning, and the smallest number that is
# judged.
WINDOW = 400
MIN_RETURN = 100
MIN_FIXES = 10
# Tolerated error of an expectation, from modes that are not Gaussian.
_TOLERANCE = 0.5
# Larger deviations from the expectation count as this many standard deviations, so that no single
# signal causes a warning.
_MAX_DEVIATIONS = 6.0


class ResidualMonitor:
    """Energy of the last whitened residuals, compared with the expectation.

    Twice an energy has approximately a chi-square distribution; `Estimate.expected_residual` is
    half its mean.

    Parameters
    ----------
    window
        Number of residuals in the mean, at least `MIN_RETURN`.

    Attributes
    ----------
    drifts
        Whether the residuals deviate from the model. This begins when the mean over the window is
        improbable, and ends when the mean over the latest `MIN_RETURN` is not.

    Raises
    ------
    ValueError
        If the window is smaller, so that no warning would end.
    """

    def __init__(self, window: int = WINDOW) -> None:
        if window < MIN_RETURN:
            raise ValueError(f'window: {window}, expected at least {MIN_RETURN}')
        self._window = window
        self._residuals: deque[tuple[float, float]] = deque()
        # Sums over the window.
        self._energy = self._expected = 0.0
        self.drifts = False

    def add(self, energy: float, expected: float) -> None:
        """Add the energy of a residual and its expectation; if one of them is NaN, do nothing."""
        if np.isnan(energy) or np.isnan(expected):
            return
        limit = _MAX_DEVIATIONS * max(expected, 1.0)**0.5
        self._append(min(max(energy, expected - limit), expected + limit), expected)
        if self.drifts:
            latest = list(self._residuals)[-MIN_RETURN:]
            energy, expected = map(float, np.sum(latest, axis=0))
            if len(latest) == MIN_RETURN and _probability(
                    energy, expected, MIN_RETURN) >= RETURN:
                self.clear()
                for pair in latest:
                    self._append(*pair)
        elif len(self._residuals) >= MIN_FIXES:
            self.drifts = FALSE_WARNING > _probability(
                self._energy, self._expected, len(self._residuals))

    def _append(self, energy: float, expected: float) -> None:
        if len(self._residuals) == self._window:
            oldest = self._residuals.popleft()
            self._energy, self._expected = self._energy - oldest[0], self._expected - oldest[1]
        self._residuals.append((energy, expected))
        self._energy, self._expected = self._energy + energy, self._expected + expected

    def clear(self) -> None:
        """Remove all residuals, for example after a change of the scenario or codebook."""
        self._residuals.clear()
        self._energy = self._expected = 0.0
        self.drifts = False

    @property
    def n_fixes(self) -> int:
        """Number of residuals in the window."""
        return len(self._residuals)

    @property
    def ratio(self) -> float:
        """Mean energy relative to the expectation; NaN without residuals."""
        return self._energy / max(self._expected, 0.5) if self._residuals else np.nan


def _probability(energy: float, expected: float, n: int) -> float:
    """Probability of a sum at least as far from the expected sum of `n` energies, on either side.

    A sum below the expectation counts, too: the assumed multipath is then too strong in some
    directions of the signals, and may be too weak in others.
    """
    # Every node imports this package, and SciPy takes longer to load than ROS.
    from scipy.special import gammainc, gammaincc

    # With few measurements and many modes, an expectation may be negative.
    expected, slack = max(expected, 0.5 * n), _TOLERANCE * n
    # Half a chi-square variable of 2 k degrees of freedom is a gamma variable of shape k.
    return 2 * float(min(gammainc(expected, energy + slack),
                         gammaincc(expected, max(energy - slack, 0.0))))
