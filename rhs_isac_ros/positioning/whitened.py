"""The mean signal and its derivatives, whitened so that noise and multipath become white."""

import numpy as np

from rhs_isac_ros.bounds.fisher import factor, mean_derivative
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, mean_received
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.model.los import los_and_rate


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
        self._moments = _moments(scenario, self._patterns)

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes (N_B, N_SB F) of the signals of a positioning phase."""
        return self._whiteners.shape[:2]

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
        n, n_rows = len(positions), self._whiteners.shape[1]
        n_bands, n_subbands = self.scenario.n_bands, self.scenario.n_subbands
        mean = np.empty((n, n_bands, n_rows), complex)
        slopes = np.empty((n, 3, n_bands, n_rows), complex)
        for band, whitener in enumerate(self._whiteners):
            gain, rate = los_and_rate(self.scenario, positions, band)
            mean[:, band] = mean_derivative(gain[:, None], self._patterns[band])[:, 0] @ whitener.T
            # The sum over the elements of a T (p - p_m), with p drawn out.
            sums = mean_derivative(rate[:, None], self._moments[band])
            sums = np.moveaxis(sums.reshape(n, n_subbands, 4, -1), 2, 1).reshape(n, 4, n_rows)
            by_position = positions[:, :, None] * sums[:, :1] - sums[:, 1:]
            slopes[:, :, band] = by_position @ whitener.T
        return mean, slopes


def _moments(scenario: Scenario, patterns: np.ndarray) -> np.ndarray:
    """Patterns alone and times each coordinate of the elements: [N_B, N_SB 4 F, N_E]."""
    weights = np.vstack([np.ones(scenario.n_elements), element_positions(scenario).T])
    frames = patterns.reshape(scenario.n_bands, scenario.n_subbands, 1, -1, scenario.n_elements)
    weighted = frames * weights[:, None, :]
    return weighted.reshape(scenario.n_bands, -1, scenario.n_elements)
