"""Tests of whether the model can explain received signals at all.

Whitened signals y from a position with the whitened mean t differ from t by noise of unit
variance: ``2 |y - t|^2`` has a chi-square distribution with two degrees of freedom per
measurement. Signals beyond its quantiles at the probability `FALSE_ALARM` do not fit any position
of the region. Possible causes are a user elsewhere, another codebook, or a silent or defective
receiver. Such signals give no position, and neither do signals that are from outside of the region
with a probability above `OUTSIDE_LIMIT`.
"""

import math

# Share of valid signals that each test may reject.
FALSE_ALARM = 1e-9
# Prior probability that a user is in the region of interest rather than outside.
REGION_PROBABILITY = 0.5
# Probability of a user outside above which there is no fix: high, because most users are inside,
# and none of them should lose a fix. Above the second, the covariance includes positions outside.
OUTSIDE_LIMIT = 0.99
DOUBT_LIMIT = 0.05
# Share of the energy of a direct path that some multipath may leave.
_WEAK_SHARE = 0.25


class FitTest:
    """Tests of whitened signals; each returns a reason, which is empty if the signals pass.

    An energy is the squared norm of a whitened signal, and `n_measurements` is the number of
    complex measurements of a positioning phase, N_B N_SB F.

    Parameters
    ----------
    weakest
        Energy of the weakest whitened mean in the region. Multipath may be weaker than in the
        model; signals that are weaker than any direct path as well contain noise alone.

    Attributes
    ----------
    min_energy, max_residual
        Lower limit of the energy of signals, and upper limit of the energy of a residual.
    """

    def __init__(self, n_measurements: int, weakest: float = math.inf) -> None:
        # Half a chi-square variable of 2 n degrees of freedom is a gamma variable of shape n.
        from scipy.special import gammainccinv, gammaincinv

        self.min_energy = min(float(gammaincinv(n_measurements, FALSE_ALARM)),
                              weakest * _WEAK_SHARE)
        self.max_residual = float(gammainccinv(n_measurements, FALSE_ALARM))

    def min_energy_test(self, energy: float) -> str:
        """Reject signals that are weaker than noise and any direct path."""
        if energy >= self.min_energy:
            return ''
        return (f'energy of the whitened signals: {energy:.3g}, expected at least '
                f'{self.min_energy:.3g}, the energy of noise')

    def max_energy_test(self, energy: float, max_mean_energy: float) -> str:
        """Reject signals stronger than noise plus the strongest whitened mean in the region."""
        # The norm of a sum is at most the sum of the norms.
        max_energy = (max_mean_energy**0.5 + self.max_residual**0.5)**2
        if energy <= max_energy:
            return ''
        return (f'energy of the whitened signals: {energy:.3g}, expected at most '
                f'{max_energy:.3g}')

    def residual_test(self, residual: float) -> str:
        """Reject signals whose residual at the best position has more energy than noise."""
        if residual <= self.max_residual:
            return ''
        return (f'residual energy at the best position: {residual:.3g}, expected at most '
                f'{self.max_residual:.3g}')


def outside_probability(log_bayes_factor: float) -> float:
    """Compute the probability of a user outside of the region.

    Takes the logarithm of the evidence for the region relative to that for its surroundings.
    """
    log_odds = log_bayes_factor + math.log(REGION_PROBABILITY / (1 - REGION_PROBABILITY))
    # The exponential of larger numbers overflows; the result is 0 or 1 anyway.
    return 1 / (1 + math.exp(min(max(log_odds, -700.0), 700.0)))


def outside_test(probability: float) -> str:
    """Reject signals of a user who is outside of the region with this probability."""
    if probability <= OUTSIDE_LIMIT:
        return ''
    return (f'position outside of the region: probability {probability:.6g}, expected at most '
            f'{OUTSIDE_LIMIT:g}')
