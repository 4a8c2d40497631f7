"""The mean signal and its derivatives, whitened so that noise and multipath become white."""

import numpy as np

from rhs_isac_ros.bounds.fisher import factor, mean_derivative
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, mean_received
from rhs_isac_ros.model.los import los_and_derivative
from rhs_isac_ros.model.receive import received_signal


class WhitenedModel:
    """Likelihood of positions for one scenario and codebook.

    Up to a constant, the log-likelihood of whitened signals y at a position with whitened mean t
    is 2 Re(t^H y) - t^H t.

    Parameters
    ----------
    scenario
        The scenario.
    codebook
        The codebook.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    """

    def __init__(self, scenario: Scenario, codebook: Codebook) -> None:
        codebook.check(scenario)
        self.scenario, self.codebook = scenario, codebook
        self._patterns, self._whiteners = factor(scenario, codebook)

    def whiten(self, received: np.ndarray) -> np.ndarray:
        """Whiten signals.

        Parameters
        ----------
        received
            Complex128 [N, N_B, N_SB F].

        Returns
        -------
        numpy.ndarray
            Complex128 of the same shape, with unit covariance.
        """
        return np.einsum('irs,nis->nir', self._whiteners, received)

    def mean(self, positions: np.ndarray) -> np.ndarray:
        """Whitened mean signals.

        Parameters
        ----------
        positions
            Float64 [N, 3] [m].

        Returns
        -------
        numpy.ndarray
            t, complex128 [N, N_B, N_SB F].
        """
        return self.whiten(mean_received(self.scenario, self.codebook, positions))

    def mean_and_derivative(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened mean signals and their derivative by the position.

        Parameters
        ----------
        positions
            Float64 [N, 3] [m].

        Returns
        -------
        tuple of numpy.ndarray
            Complex128 [N, N_B, N_SB F] and [N, 3, N_B, N_SB F] [1/m].
        """
        means, slopes = [], []
        for band, (pattern, whitener) in enumerate(
                zip(self._patterns, self._whiteners, strict=True)):
            gain, by_position = los_and_derivative(self.scenario, positions, band)
            means.append(received_signal(gain, 0.0, pattern, 0.0) @ whitener.T)
            slopes.append(mean_derivative(by_position, pattern) @ whitener.T)
        return np.stack(means, axis=1), np.stack(slopes, axis=2)
