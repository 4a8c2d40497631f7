"""The mean signal and its derivatives, whitened so that noise and multipath become white."""

import numpy as np

from rhs_isac_ros.bounds.fisher import factor
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
        patterns, self._whiteners = factor(scenario, codebook)
        self._frames, self._moments = _weights(scenario, patterns)

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
        n, (n_bands, n_rows) = len(positions), self.shape
        mean = np.empty((n, n_bands, n_rows), complex)
        slopes = np.empty((n, 3, n_bands, n_rows), complex)
        for band, whitener in enumerate(self._whiteners):
            gain, rate, lift = los_and_rate(self.scenario, positions, band)
            frames, moments = self._frames[band], self._moments[band]
            sums = np.matmul(gain.transpose(1, 0, 2), frames).transpose(1, 0, 2)
            mean[:, band] = sums.reshape(n, n_rows) @ whitener.T
            # Eq. (13) with p - p_m drawn out: the sum over the elements of a T (p - p_m).
            sums = np.matmul(rate.transpose(1, 0, 2), moments)
            sums = sums.reshape(-1, n, 4, frames.shape[2]).transpose(2, 1, 0, 3)
            sums = sums.reshape(4, n, n_rows)
            by_position = positions.T[:, :, None] * sums[0] - sums[1:]
            if lift is not None:
                sums = np.matmul(lift.transpose(1, 0, 2), frames).transpose(1, 0, 2)
                by_position[0] += sums.reshape(n, n_rows)
            whitened = by_position.reshape(3 * n, n_rows) @ whitener.T
            slopes[:, :, band] = whitened.reshape(3, n, n_rows).transpose(1, 0, 2)
        return mean, slopes


def _weights(scenario: Scenario, patterns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Patterns, [N_B, N_SB, N_E, F]; the same and times element coordinates, [..., 4 F]."""
    shape = scenario.n_bands, scenario.n_subbands, scenario.n_frames, scenario.n_elements
    frames = np.ascontiguousarray(np.swapaxes(patterns.reshape(shape), 2, 3))
    coordinates = np.hstack([np.ones((scenario.n_elements, 1)), element_positions(scenario)])
    moments = coordinates[:, :, None] * frames[..., None, :]
    return frames, moments.reshape(*frames.shape[:3], -1)
