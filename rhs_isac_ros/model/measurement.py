"""Gaussian model of the signals received in a positioning phase.

The signals of band i are complex Gaussian with a mean that depends on the user's position and a
covariance Lambda_i that does not. Bands are independent of each other. Element errors that the
scenario declares add to the covariance; `impairments` describes unknown gains and phases.
"""

import functools

import numpy as np

from rhs_isac_ros.model.element_sums import ElementSums
from rhs_isac_ros.model.impairments.elements import DeclaredElements, ElementErrors, SurfaceModel
from rhs_isac_ros.model.impairments.factors import draw_impairments
from rhs_isac_ros.model.los import checked_positions, los_derivative, los_gain
from rhs_isac_ros.model.multipath import (
    complex_normal,
    measurement_correlation,
    multipath_covariance,
    square_root,
)
from rhs_isac_ros.model.receive import received_signal
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, radiation_matrix
from rhs_isac_ros.model.surface_estimate import SurfaceEstimate
from rhs_isac_ros.model.threads import map_blocks, one_blas_thread

# Knowledge of the elements of one surface: their errors, or an estimate of them.
Surface = ElementErrors | SurfaceEstimate
# Positions evaluated at a time.
_BLOCK = 256


def signal_covariance(scenario: Scenario, radiation: np.ndarray) -> np.ndarray:
    """Implements Eq. (14). Covariance of the received signals, independent of the position.

    Returns Lambda_i, complex128 [N_B, N_SB F, N_SB F] [W], for the radiation matrices T_i of all
    bands, complex128 [N_B, N_SB F, N_E].
    """
    noise = scenario.noise_power_w * np.eye(radiation.shape[1])
    covariance: np.ndarray = scattered_covariance(scenario, radiation) + noise
    return covariance


def scattered_covariance(scenario: Scenario, radiation: np.ndarray) -> np.ndarray:
    """Compute the covariance of the multipath in the received signals, as `signal_covariance`."""
    spatial = multipath_covariance(scenario)
    scattered = np.matmul(np.matmul(radiation, spatial), np.conj(np.swapaxes(radiation, 1, 2)))
    correlated: np.ndarray = measurement_correlation(scenario) * scattered
    return correlated


def mean_derivative(slopes: np.ndarray, radiation: np.ndarray) -> np.ndarray:
    """Implements Eq. (13). Derivative of one band's mean signal with respect to the position.

    Returns complex128 [N, G, N_SB F] [1/m], sub-band-major.

    Parameters
    ----------
    slopes
        Derivative of the line-of-sight gains, complex128 [N, G, N_SB, N_E] [1/m]; G is 3. Any
        other linear functions of the gains may take its place.
    radiation
        T_i of the band, complex128 [N_SB F, N_E].
    """
    n, n_rows, n_subbands, n_elements = slopes.shape
    frames = radiation.reshape(n_subbands, -1, n_elements)
    # One matrix product per sub-band: [G N, N_E] with [N_E, F].
    stacked = np.moveaxis(slopes, 2, 0).reshape(n_subbands, n_rows * n, n_elements)
    products = np.matmul(stacked, np.swapaxes(frames, 1, 2))
    derivative: np.ndarray = np.moveaxis(products, 0, 1).reshape(n, n_rows, -1)
    return derivative


class MeasurementModel:
    """Distribution of the received signals for one scenario and beamforming.

    Immutable. Construction computes the radiation matrices only; the factors of the covariance
    and the weights of `mean_and_jacobian` are computed at first use, or by `prepare`.

    Positions are those of the user, float64 [N, 3] [m]. Methods that take them raise ValueError
    if the shape is wrong or a value is not finite. Measurements are sub-band-major.

    Parameters
    ----------
    surface
        Known errors of the elements, or an estimate of them, whose own errors the covariance
        then includes. By default they are unknown, with the distribution that the scenario
        declares: the mean is then the average over surfaces, and the covariance includes the
        errors.

    Attributes
    ----------
    scenario, beams, surface
        The arguments.
    elements
        `surface`, or the distribution that the scenario declares.
    radiation
        T_i of Eq. (9) for the coefficients in effect, complex128 [N_B, N_SB F, N_E], read-only.

    Raises
    ------
    ValueError
        If the beamforming or the surface does not have the sizes of the scenario.
    """

    @one_blas_thread
    def __init__(self, scenario: Scenario, beamforming: Beamforming,
                 surface: Surface | None = None) -> None:
        self.scenario, self.beams, self.surface = scenario, beamforming, surface
        self.elements: SurfaceModel = surface or DeclaredElements(scenario)
        self.radiation = _read_only(
            radiation_matrix(scenario, self.elements.applied_beams(beamforming)))

    @property
    def shape(self) -> tuple[int, int]:
        """Sizes (N_B, N_SB F) of the signals of a positioning phase."""
        n_bands, n_measurements, _ = self.radiation.shape
        return n_bands, n_measurements

    @one_blas_thread
    def covariance(self) -> np.ndarray:
        """Compute Lambda_i, complex128 [N_B, N_SB F, N_SB F] [W]; the result is not cached.

        Unknown errors of the elements contribute their average over the region of interest.
        """
        covariance = signal_covariance(self.scenario, self.radiation)
        if not self.elements.is_exact:
            covariance += self.elements.error_covariance(self.scenario, self.beams)
        return covariance

    def covariance_at(self, positions: np.ndarray) -> np.ndarray:
        """Compute the covariance at positions, complex128 [N, N_B, N_SB F, N_SB F] [W].

        It depends on the position through unknown errors of the elements only.
        """
        positions = checked_positions(positions)
        covariance: np.ndarray = np.repeat(
            signal_covariance(self.scenario, self.radiation)[None], len(positions), axis=0)
        if not self.elements.is_exact:
            covariance += self.elements.error_covariance_at(
                self.scenario, self.beams, positions)
        return covariance

    @functools.cached_property
    def root(self) -> np.ndarray:
        """Cholesky factor L_i of Lambda_i, complex128 [N_B, N_SB F, N_SB F], read-only."""
        return _read_only(np.linalg.cholesky(self.covariance()))

    @functools.cached_property
    def whitener(self) -> np.ndarray:
        """L_i^-1, lower triangular, complex128 [N_B, N_SB F, N_SB F], read-only."""
        return _read_only(np.linalg.inv(self.root))

    @one_blas_thread
    def prepare(self, jacobian: bool = False) -> 'MeasurementModel':
        """Compute the whitener, and on request the weights of `mean_and_jacobian`, in advance."""
        _ = self.whitener
        if jacobian:
            _ = self._weights
        return self

    def whiten(self, signals: np.ndarray) -> np.ndarray:
        """Transform signals [..., N_B, N_SB F] to unit covariance; the shape stays the same."""
        # Unlike a matrix product, this rounds a signal the same in a batch of any size.
        whitened: np.ndarray = np.einsum('irs,...is->...ir', self.whitener, signals)
        return whitened

    def mean(self, positions: np.ndarray) -> np.ndarray:
        """Compute the mean signals, complex128 [N, N_B, N_SB F]: Eq. (8) for the direct path."""
        positions = checked_positions(positions)
        mean = np.empty((len(positions), *self.shape), complex)

        # A change of this kernel or its block size would change the simulated signals of all
        # seeds.
        def fill(start: int) -> None:
            block = slice(start, start + _BLOCK)
            for band, radiation in enumerate(self.radiation):
                los = los_gain(self.scenario, positions[block], band)
                mean[block, band] = received_signal(los, 0.0, radiation, 0.0)

        map_blocks(fill, range(0, len(positions), _BLOCK))
        return mean

    def band_jacobian(self, positions: np.ndarray, band: int) -> np.ndarray:
        """Compute the derivative of one band's mean signals, complex128 [N, 3, N_SB F] [1/m].

        All positions are evaluated at once, with memory for [N, 3, N_SB, N_E] numbers.
        """
        slopes = los_derivative(self.scenario, positions, band)
        return mean_derivative(slopes, self.radiation[band])

    def jacobian(self, positions: np.ndarray) -> np.ndarray:
        """Compute the derivative of the mean signals, complex128 [N, 3, N_B, N_SB F] [1/m]."""
        positions = checked_positions(positions)
        jacobian = np.empty((len(positions), 3, *self.shape), complex)

        def fill(start: int) -> None:
            block = slice(start, start + _BLOCK)
            for band in range(len(self.radiation)):
                jacobian[block, :, band] = self.band_jacobian(positions[block], band)

        map_blocks(fill, range(0, len(positions), _BLOCK))
        return jacobian

    def mean_and_jacobian(
            self, positions: np.ndarray, by_coordinate: np.ndarray | None = None, *,
            whitened: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Compute `mean` and `jacobian` together, much faster, but with different rounding.

        Parameters
        ----------
        by_coordinate
            Derivatives of the positions with respect to other coordinates, float64 [N, 3, Q],
            for the derivatives of the mean with respect to these, [N, Q, N_B, N_SB F].
        whitened
            Whether to `whiten` both.
        """
        positions, weights = checked_positions(positions), self._weights
        n, (n_bands, n_rows) = len(positions), self.shape
        by_term = weights.weights(positions)
        if by_coordinate is not None:
            by_term = np.matmul(np.swapaxes(by_coordinate, 1, 2), by_term)
        mean = np.empty((n, n_bands, n_rows), complex)
        jacobian = np.empty((n, by_term.shape[1], n_bands, n_rows), complex)

        def fill(start: int) -> None:
            block = slice(start, start + weights.block)
            terms = weights.terms(positions[block])
            if whitened:
                shape = terms.shape
                terms = np.matmul(terms.reshape(n_bands, -1, n_rows),
                                  np.swapaxes(self.whitener, 1, 2)).reshape(shape)
            mean[block] = np.swapaxes(terms[:, :, 0], 0, 1)
            parts = np.matmul(by_term[block], terms[:, :, 1:].view(float))
            jacobian[block] = np.moveaxis(parts.view(complex), 0, 2)

        map_blocks(fill, range(0, n, weights.block))
        return mean, jacobian

    @one_blas_thread
    def sample(self, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw signals of independent phases, one at each position, complex128 [N, N_B, N_SB F].

        Multipath and noise are drawn together, with the covariance Lambda_i. `simulate_received`
        draws the gain of every element instead; the distribution is the same, but the call takes
        a hundred times as long. Impairments that the scenario declares are drawn as described
        there.
        """
        surface, factors = draw_impairments(self.scenario, len(positions), rng)
        if surface is not None and self.surface is None:
            return MeasurementModel(self.scenario, self.beams, surface)._sample(
                positions, rng, factors)
        return self._sample(positions, rng, factors)

    def _sample(self, positions: np.ndarray, rng: np.random.Generator,
                factors: np.ndarray | None) -> np.ndarray:
        signals = self.mean(positions)
        white = complex_normal(signals.shape, rng)
        if factors is None:
            for band, root in enumerate(self.root):
                signals[:, band] += white[:, band] @ root.T
            return signals
        # Factors act on the multipath, but not on the noise.
        noise = np.sqrt(self.scenario.noise_power_w) * complex_normal(signals.shape, rng)
        for band, scattered in enumerate(scattered_covariance(self.scenario, self.radiation)):
            root = square_root(scattered)
            signals[:, band] += white[:, band, :root.shape[1]] @ root.T
        received: np.ndarray = signals * factors + noise
        return received

    @functools.cached_property
    def _weights(self) -> ElementSums:
        return ElementSums(self.scenario, self.radiation)


def _read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array
