"""Whether the model can explain received signals at all.

Whitened signals y of a position with whitened mean t differ from it by unit noise:
``2 |y - t|^2`` has a chi-square distribution with two degrees of freedom a measurement. What lies
beyond the quantiles of `FALSE_ALARM` comes from no position of the region: from a user elsewhere,
another codebook, a silent or a broken receiver. Then there is no fix.
"""


# Share of good signals that each of the tests may refuse.
FALSE_ALARM = 1e-9


class FitTest:
    """Limits of what the model can explain.

    Parameters
    ----------
    n_measurements
        Complex measurements of a positioning phase, N_B N_SB F.

    Attributes
    ----------
    least_energy
        Least square norm of whitened signals: that of noise alone.
    most_misfit
        Largest square norm of a whitened residual.
    """

    def __init__(self, n_measurements: int) -> None:
        # Half a chi-square variable of 2 n degrees of freedom is a gamma variable of shape n.
        from scipy.special import gammainccinv, gammaincinv

        self.least_energy = float(gammaincinv(n_measurements, FALSE_ALARM))
        self.most_misfit = float(gammainccinv(n_measurements, FALSE_ALARM))

    def silence(self, energy: float) -> str:
        """Tell whether signals are weaker than noise.

        Parameters
        ----------
        energy
            Square norm of the whitened signals.

        Returns
        -------
        str
            What is wrong; empty if nothing.
        """
        if energy >= self.least_energy:
            return ''
        return (f'energy {energy:.3g} of the whitened signals, expected at least '
                f'{self.least_energy:.3g}, that of noise')

    def misfit(self, misfit: float) -> str:
        """Tell whether signals fit none of the positions.

        Parameters
        ----------
        misfit
            Square norm of the whitened residual at the best position.

        Returns
        -------
        str
            What is wrong; empty if nothing.
        """
        if misfit <= self.most_misfit:
            return ''
        return (f'misfit {misfit:.3g} of the best position, expected at most '
                f'{self.most_misfit:.3g}')

    def loudness(self, energy: float, loudest: float) -> str:
        """Tell whether signals are stronger than those of any position.

        Parameters
        ----------
        energy
            Square norm of the whitened signals.
        loudest
            Largest square norm of a whitened mean in the region.

        Returns
        -------
        str
            What is wrong; empty if nothing.
        """
        # The norm of a sum is at most the sum of the norms.
        most = (loudest**0.5 + self.most_misfit**0.5)**2
        if energy <= most:
            return ''
        return f'energy {energy:.3g} of the whitened signals, expected at most {most:.3g}'
