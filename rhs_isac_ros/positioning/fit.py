"""Tests of whether the model can explain received signals at all.

Whitened signals y from a position with the whitened mean t differ from t by noise of unit
variance: ``2 |y - t|^2`` has a chi-square distribution with two degrees of freedom per
measurement. Signals beyond its quantiles at the probability `FALSE_ALARM` do not fit any position
of the region. Possible causes are a user elsewhere, another codebook, or a silent or defective
receiver. Such signals give no position.
"""

# Share of valid signals that each test may reject.
FALSE_ALARM = 1e-9
# Probability of all alternatives above which residuals are not compared with the scenario.
DOUBT_LIMIT = 0.05


class FitTest:
    """Tests of whitened signals; each returns a reason, which is empty if the signals pass.

    An energy is the squared norm of a whitened signal, and `n_measurements` is the number of
    complex measurements of a positioning phase, N_B N_SB F.

    Attributes
    ----------
    min_energy, max_residual
        Lower limit of the energy of signals, and upper limit of the energy of a residual.
    """

    def __init__(self, n_measurements: int) -> None:
        # Half a chi-square variable of 2 n degrees of freedom is a gamma variable of shape n.
        from scipy.special import gammainccinv, gammaincinv

        self.min_energy = float(gammaincinv(n_measurements, FALSE_ALARM))
        # With an unknown level of the multipath, the ratio of the likelihoods with and without a
        # direct path is that of residual and energy to the power of n.
        self._weak_share = FALSE_ALARM**(1 / n_measurements)
        self.max_residual = float(gammainccinv(n_measurements, FALSE_ALARM))

    def min_energy_test(self, energy: float) -> str:
        """Reject signals that are weaker than noise; the energy is relative to it."""
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

    def weak_test(self, energy: float, residual: float) -> str:
        """Reject signals that are weaker than the multipath, unless it is a direct path.

        Multipath may be weaker than in the model. The direct path at the best position then
        explains most of the energy.
        """
        max_residual = self._weak_share * energy
        if energy >= self.min_energy or residual <= max_residual:
            return ''
        return (f'residual energy at the best position: {residual:.3g}, expected at most '
                f'{max_residual:.3g} of signals weaker than the multipath')

    def residual_test(self, residual: float) -> str:
        """Reject signals whose residual at the best position has more energy than noise."""
        if residual <= self.max_residual:
            return ''
        return (f'residual energy at the best position: {residual:.3g}, expected at most '
                f'{self.max_residual:.3g}')
