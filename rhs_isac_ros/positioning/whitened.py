"""Mean signals and their derivatives, whitened so that multipath and noise are white."""

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.measurement import Surface


class WhitenedModel:
    """Likelihood of positions for one scenario and codebook.

    Up to a constant, the log-likelihood of whitened signals y at a position with whitened mean t
    is 2 Re(t^H y) - t^H t. What is known of the surface is that of `MeasurementModel`.

    Raises
    ------
    CodebookError
        If the codebook does not fit the scenario.
    """

    def __init__(self, scenario: Scenario, codebook: Codebook,
                 surface: Surface | None = None) -> None:
        codebook.check(scenario)
        self.scenario, self.codebook, self.surface = scenario, codebook, surface
        # Estimators are built between cycles; their first estimate should be as fast as any.
        self._model = MeasurementModel(scenario, codebook, surface).prepare(jacobian=True)

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes (N_B, N_SB F) of the signals of a positioning phase."""
        return self._model.shape

    @property
    def root(self) -> np.ndarray:
        """Cholesky factor of the covariance, complex128 [N_B, N_SB F, N_SB F], read-only."""
        return self._model.root

    def whiten(self, received: np.ndarray) -> np.ndarray:
        """Transform signals [N, N_B, N_SB F] to unit covariance; the shape stays the same."""
        return self._model.whiten(received)

    def whitened_power(self, covariance: np.ndarray) -> float:
        """Compute the energy of whitened signals with a covariance [N_B, N_SB F, N_SB F]."""
        whitener = self._model.whitener
        return float(np.einsum(
            'irs,ist,irt->', whitener, covariance, np.conj(whitener), optimize=True).real)

    def whitened_operators(self, patterns: np.ndarray) -> np.ndarray:
        """Compute W P W^-1 for factors P of the signals, e.g. of nuisance parameters.

        Takes complex128 [Q, N_B, N_SB F]; returns [Q, N_B, N_SB F, N_SB F].
        """
        operators: np.ndarray = np.matmul(
            self._model.whitener * patterns[:, :, None], self._model.root)
        return operators

    def mean(self, positions: np.ndarray) -> np.ndarray:
        """Compute whitened mean signals, complex128 [N, N_B, N_SB F].

        Parameters
        ----------
        positions
            Float64 [N, 3] [m].
        """
        return self._model.whiten(self._model.mean(positions))

    def mean_and_jacobian(
            self, positions: np.ndarray, by_coordinate: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute whitened mean signals and their derivative with respect to the position.

        Parameters
        ----------
        positions
            Float64 [N, 3] [m].
        by_coordinate
            Derivatives of the positions with respect to other coordinates, float64 [N, 3, 3], for
            the derivatives with respect to these.

        Returns
        -------
        tuple of numpy.ndarray
            Complex128 [N, N_B, N_SB F] and [N, 3, N_B, N_SB F] [1/m].
        """
        return self._model.mean_and_jacobian(positions, by_coordinate, whitened=True)
