"""A running test of whether the residuals of fixes have the energy that the model predicts.

A single residual is tested at `fit.FALSE_ALARM`, which only gross errors of the model exceed. The
mean over many fixes reveals small ones, such as a wrong delay spread, which leave the positions
plausible but their covariances too small.
"""

from collections import deque

import numpy as np

# Probability that the mean residual of a correct model causes a warning.
FALSE_WARNING = 1e-6
# Number of fixes in the mean, and the smallest number that is judged.
WINDOW = 100
MIN_FIXES = 10
# Real parameters fitted to the signals of each phase.
_N_FITTED = 3


class ResidualMonitor:
    """Mean energy of the whitened residuals of the last fixes.

    Twice an energy has a chi-square distribution with two degrees of freedom for each complex
    measurement, less one for each fitted coordinate.

    Parameters
    ----------
    n_measurements
        Complex measurements of a positioning phase, N_B N_SB F.
    window
        Number of fixes in the mean, at least `MIN_FIXES`.

    Raises
    ------
    ValueError
        If the window is smaller, so that no residuals would be judged.
    """

    def __init__(self, n_measurements: int, window: int = WINDOW) -> None:
        if window < MIN_FIXES:
            raise ValueError(f'window: {window}, expected at least {MIN_FIXES}')
        self._energies: deque[float] = deque(maxlen=window)
        # Half a chi-square variable of 2 k degrees of freedom is a gamma variable of shape k.
        self._shape = max(n_measurements - _N_FITTED / 2, 0.5)

    def add(self, energy: float) -> None:
        """Add the energy of the residual of a fix.

        NaN, from an estimator that computes no residual, is ignored.
        """
        if not np.isnan(energy):
            self._energies.append(energy)

    def clear(self) -> None:
        """Remove all residuals, for example after a change of the scenario or codebook."""
        self._energies.clear()

    @property
    def warning(self) -> str:
        """Text if the mean energy is improbable, empty otherwise or after too few fixes.

        A mean below the expectation also causes a warning: the assumed multipath is then too
        strong in some directions of the signals, and may be too weak in others.
        """
        n_fixes = len(self._energies)
        if n_fixes < MIN_FIXES:
            return ''
        # Every node imports this package, and SciPy takes longer to load than ROS.
        from scipy.special import gammainc, gammaincc

        total, shape = sum(self._energies), n_fixes * self._shape
        if min(gammainc(shape, total), gammaincc(shape, total)) >= FALSE_WARNING / 2:
            return ''
        return (f'residual energy: {total / n_fixes:.3g} on average over {n_fixes} fixes, '
                f'expected {self._shape:.3g}: the scenario does not match the signals')
