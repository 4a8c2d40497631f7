"""The likely reason why signals give no position, from the estimates of the latest cycles.

The mean residual alone cannot tell a wrong level of the multipath from a wrong spread: both make
it larger or smaller. A level scales all residuals, so that their relative variance remains that of
the model. A wrong spread concentrates the energy in a few directions of the signals, and levels
that differ between users or places differ from cycle to cycle: the relative variance grows.
"""

import collections
import dataclasses

import numpy as np

from rhs_isac_ros.positioning.alternatives import ALTERNATIVES, probabilities_of
from rhs_isac_ros.positioning.estimate import Estimate
from rhs_isac_ros.positioning.innovation_test import MIN_FIXES, WINDOW

LEVEL = 'level of the multipath or of the users'
SPREAD = 'spread of delays, angles or levels'
# Relative variance of the residuals, in units of the model's, above which a level does not explain
# them: two standard errors over the window.
_MAX_DISPERSION = 1.2


@dataclasses.dataclass(frozen=True)
class _Cycle:
    """Subject of the reason, empty with a fix; residual and expectation; and probabilities."""

    subject: str
    residual: float
    expected: float
    probabilities: dict[str, float]


class Diagnosis:
    """Fixes, residuals and probabilities of the latest cycles."""

    def __init__(self) -> None:
        self._cycles: collections.deque[_Cycle] = collections.deque(maxlen=WINDOW)

    def add(self, estimate: Estimate) -> None:
        """Add the estimate of a cycle."""
        self._cycles.append(_Cycle(
            str(estimate.reason).partition(':')[0], float(estimate.residual),
            float(estimate.expected_residual), probabilities_of(estimate)))

    def clear(self) -> None:
        """Forget all cycles."""
        self._cycles.clear()

    def status(self, deviates: bool) -> dict[str, str]:
        """Return the values for the diagnostics.

        Parameters
        ----------
        deviates
            Whether the residuals deviate from the scenario, so that the probabilities are wrong.

        Returns
        -------
        dict
            ``probability.<alternative>``, the mean over the cycles, which is the share of such
            users; and if there are cycles without a fix, ``no_fix.share`` and ``no_fix.cause``.
        """
        values = {}
        for kind in ALTERNATIVES:
            found = [cycle.probabilities[kind.name] for cycle in self._cycles
                     if kind.name in cycle.probabilities]
            if found:
                values[f'probability.{kind.name}'] = f'{np.mean(found):.3f}'
        subjects = collections.Counter(one.subject for one in self._cycles if one.subject)
        if subjects:
            values['no_fix.share'] = f'{sum(subjects.values())} of {len(self._cycles)}'
            values['no_fix.cause'] = self._cause(subjects.most_common(1)[0][0], deviates)
        return values

    def _cause(self, subject: str, deviates: bool) -> str:
        """Return the likely cause, given the most frequent subject of the reasons."""
        residual, expected = np.array([
            (one.residual, one.expected) for one in self._cycles
            if one.residual > 0 and one.expected > 0]).reshape(-1, 2).T
        is_alternative = subject in {kind.reason for kind in ALTERNATIVES}
        if len(residual) < MIN_FIXES or is_alternative and not deviates:
            return subject
        # The energy of n complex measurements has the relative variance 1 / n.
        dispersion = float(np.var(np.log(residual / expected)) * np.mean(expected))
        return LEVEL if dispersion <= _MAX_DISPERSION else SPREAD
