"""What received signals may be instead of those of a user in the region with a direct path.

An alternative has prior odds and an evidence, the likelihood averaged over its own unknowns.
Compared with the evidence for the region, it has a probability, and above the limit of the
alternative there is no fix. The limit of a user outside is high: the prior is even, although most
users are inside, and none of them should lose a fix.
"""

import math
from typing import Protocol

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.gaussian import BLOCKED_STD_DB, log_evidence_of_level
from rhs_isac_ros.positioning.likelihood import NuisancePrior
from rhs_isac_ros.positioning.outside import Outside

# Largest level of multipath without a direct path that explains signals, in standard deviations.
_REACH = 3.0
# Probability of a blocked user above which there is no fix.
BLOCKED_LIMIT = 0.5
_DB_PER_NEPER = 20 / math.log(10)
_MIN_PROBABILITY = 1e-12


class Alternative(Protocol):
    """An alternative to a user in the region with a direct path.

    Attributes
    ----------
    name
        Name and reason; `Estimate` has the field ``<name>_probability``.
    reason
        Why there is no fix.
    limit
        Largest probability with a fix, if there are no other alternatives.
    log_odds
        Logarithm of the prior probability relative to that of a user in the region in sight.
    """

    name: str
    reason: str
    limit: float
    log_odds: float

    def log_evidence_of(self, whitened: np.ndarray, aligned: np.ndarray, residual: float,
                        prior: NuisancePrior) -> float:
        """Compute the logarithm of the evidence with the nuisance parameters integrated out.

        Parameters
        ----------
        whitened
            Whitened signals of one phase without the aligned parameters, complex128
            [N_B, N_SB F].
        aligned
            Parameters that the signals alone reveal, float64 [Q]; 0 for the others.
        residual
            Energy of the whitened residual at the best position in the region.
        """
        ...

    def explain(self, whitened: np.ndarray, max_residual: float) -> bool:
        """Return whether the alternative explains the whitened signals of a phase at all."""
        ...


class Blocked:
    """A user without a direct path, whose signals are multipath of an unknown level.

    A survey inflates the covariance of the multipath, and its level differs among users in sight.
    Their evidence is that of the inflated covariance, in which weak residuals are improbable, so
    the evidence of a blocked user is divided by the change that the actual levels would make.
    """

    name, reason, limit = 'blocked', 'blocked', BLOCKED_LIMIT

    def __init__(self, scenario: Scenario) -> None:
        share = scenario.blocked_probability
        self.log_odds = math.log(share / max(1 - share, _MIN_PROBABILITY))
        self._median_db, self._std_db = (
            scenario.multipath.level_db if scenario.multipath else (0.0, 0.0))

    def log_evidence_of(self, whitened: np.ndarray, aligned: np.ndarray, residual: float,
                        prior: NuisancePrior) -> float:
        """Compute the evidence, as `Alternative` describes; phases have no effect."""
        energy = np.array([residual, np.sum(np.abs(whitened)**2)])
        # The gain of the user is a part of the level.
        std_db = math.hypot(BLOCKED_STD_DB, self._std_db, _DB_PER_NEPER * prior.gain_std)
        in_sight, blocked = (
            float(log_evidence_of_level(energy[[index]], whitened.size, std, self._median_db)[0])
            for index, std in enumerate((self._std_db, std_db)))
        return blocked - (in_sight + residual) + prior.log_evidence_of_aligned(aligned)

    def explain(self, whitened: np.ndarray, max_residual: float) -> bool:
        """Return whether some level explains the signals, as `Alternative` describes."""
        energy = float(np.sum(np.abs(whitened)**2))
        return energy <= max_residual * 10**(_REACH * BLOCKED_STD_DB / 10)


ALTERNATIVES: tuple[type[Outside] | type[Blocked], ...] = (Outside, Blocked)
# Smallest probability of an alternative that is worth a word.
_MIN_DOUBT = 0.01


def probabilities_of(estimate: object) -> dict[str, float]:
    """Return the probabilities in an `Estimate` or a message, by the names of the alternatives.

    Those that the estimator does not consider are absent.
    """
    values = {kind.name: float(getattr(estimate, f'{kind.name}_probability'))
              for kind in ALTERNATIVES}
    return {name: value for name, value in values.items() if not math.isnan(value)}


def describe_doubts(estimate: object) -> str:
    """Return the probabilities of at least 1 % as a text, such as ``blocked 12 %``; or nothing."""
    return ', '.join(f'{name} {100 * value:.0f} %' for name, value in probabilities_of(
        estimate).items() if value >= _MIN_DOUBT)


def shares(log_weights: np.ndarray) -> np.ndarray:
    """Return the probabilities of hypotheses with these logarithms of weights, float64 [N, A]."""
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    return weights


def rejection(alternative: Alternative, probability: float) -> str:
    """Reject signals that are explained by an alternative with this probability.

    It is that compared with a user in the region in sight alone.
    """
    if probability <= alternative.limit:
        return ''
    return (f'{alternative.reason}: probability {probability:.6g}, expected at most '
            f'{alternative.limit:g}')
