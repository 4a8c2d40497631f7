"""The posterior of the elements and band gains of one surface, as a calibration estimates it.

The coefficient of element m for the amplitude c is linear in two numbers, ``gain c + offset``: an
element that works has the offset 0, and one that has failed the gain 0. A band multiplies all its
signals by a gain of the receiving chain. Mean signals are therefore linear in the elements and
in each band's gain, and their errors have a covariance in closed form.
"""

import dataclasses
import hashlib

import numpy as np

from rhs_isac_ros.model.impairments.elements import AppliedBeams
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix

# Quasi-random positions over which the covariance is averaged.
_LOG2_NODES = 7
# Positions evaluated at a time.
_BLOCK = 32


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceEstimate:
    """Mean and covariance of the coefficients of a surface.

    Attributes
    ----------
    gains, offsets
        Expected coefficient of each element, ``gain c + offset``, complex128 [N_E].
    band_gains
        Expected gain of each band, complex128 [N_B].
    factor
        F with F F^H the covariance of gains, offsets and relative errors of the band gains,
        complex128 [2 N_E + N_B, R].
    failed_probability
        Probability that each element has failed, float64 [N_E].
    """

    gains: np.ndarray
    offsets: np.ndarray
    band_gains: np.ndarray
    factor: np.ndarray
    failed_probability: np.ndarray

    @property
    def is_exact(self) -> bool:
        """Whether the estimate has no errors."""
        return not self.factor.shape[1]

    @property
    def id(self) -> str:
        """Hash of the estimate, 16 hexadecimal digits."""
        digest = hashlib.sha256()
        for array in (self.gains, self.offsets, self.band_gains, self.factor):
            digest.update(np.ascontiguousarray(array, complex).astype('<c16').tobytes())
        return digest.hexdigest()[:16]

    @property
    def failed(self) -> np.ndarray:
        """Return which elements have probably failed, bool [N_E]."""
        failed: np.ndarray = self.failed_probability > 0.5
        return failed

    def std(self) -> np.ndarray:
        """Return the standard deviations of the rows of `factor`, float64 [2 N_E + N_B]."""
        std: np.ndarray = np.sqrt(np.sum(np.abs(self.factor)**2, axis=1))
        return std

    def without_errors(self) -> 'SurfaceEstimate':
        """Return an estimate that takes the means as exact."""
        return dataclasses.replace(self, factor=self.factor[:, :0])

    def applied(self, analog: np.ndarray) -> np.ndarray:
        """Return the expected coefficients, complex128, for configurations [..., N_E]."""
        coefficients: np.ndarray = self.gains * analog + self.offsets
        return coefficients

    def applied_beams(self, beams: Beamforming) -> AppliedBeams:
        """Return the expected beamforming in effect, with the gains of the bands."""
        return AppliedBeams(
            self.applied(beams.analog), self.band_gains[:, None, None, None] * beams.digital)

    def error_covariance(self, scenario: Scenario, beams: Beamforming) -> np.ndarray:
        """Compute the covariance of the signals due to the errors of the estimate.

        The result is averaged over the region of interest, complex128 [N_B, N_SB F, N_SB F] [W].
        """
        from scipy.stats import qmc

        low, high = scenario.roi_bounds_m
        positions = low + qmc.Sobol(3, seed=0).random(2**_LOG2_NODES) * (high - low)
        covariance = self._scattered(scenario, beams)
        for band in range(scenario.n_bands):
            for start in range(0, len(positions), _BLOCK):
                errors = self._direct(scenario, beams, band, positions[start:start + _BLOCK])
                stacked = np.swapaxes(errors, 0, 1).reshape(errors.shape[1], -1)
                covariance[band] += stacked @ np.conj(stacked.T) / len(positions)
        return covariance

    def error_covariance_at(
            self, scenario: Scenario, beams: Beamforming, positions: np.ndarray) -> np.ndarray:
        """Compute `error_covariance` at positions [N, 3], complex128 [N, N_B, N_SB F, N_SB F]."""
        covariance = np.repeat(self._scattered(scenario, beams)[None], len(positions), axis=0)
        for band in range(scenario.n_bands):
            for start in range(0, len(positions), _BLOCK):
                block = slice(start, start + _BLOCK)
                errors = self._direct(scenario, beams, band, positions[block])
                covariance[block, band] += np.matmul(errors, np.conj(np.swapaxes(errors, 1, 2)))
        return covariance

    def _scattered(self, scenario: Scenario, beams: Beamforming) -> np.ndarray:
        """Covariance from the multipath at erroneous elements [N_B, N_SB F, N_SB F] [W]."""
        radiation = element_radiation(scenario, beams)
        n = 2 * scenario.n_elements
        errors = self.factor[:n] @ np.conj(self.factor[:n].T)
        covariance = scattered_errors(scenario, radiation, errors)
        covariance *= np.abs(self.band_gains[:, None, None])**2
        return covariance

    def _direct(self, scenario: Scenario, beams: Beamforming, band: int,
                positions: np.ndarray) -> np.ndarray:
        """Errors of the direct path for unit white numbers, complex128 [N, N_SB F, R]."""
        design = direct_design(scenario, element_radiation(scenario, beams), band, positions)
        errors = design @ self.factor[:2 * scenario.n_elements]
        mean = design @ np.concatenate([self.gains, self.offsets])
        errors += mean[..., None] * self.factor[2 * scenario.n_elements + band]
        scaled: np.ndarray = self.band_gains[band] * errors
        return scaled


def element_radiation(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Compute the weights of gains and offsets of the elements in every measurement.

    Returns complex128 [N_B, N_SB F, 2 N_E], for unit gains of the bands.
    """
    weights = np.matmul(beams.digital, onboard_matrix(scenario))
    configured = beams.analog[:, None] * weights
    both = np.concatenate([configured, weights], axis=-1)
    radiation: np.ndarray = both.reshape(scenario.n_bands, -1, 2 * scenario.n_elements)
    return radiation


def direct_design(scenario: Scenario, radiation: np.ndarray, band: int,
                  positions: np.ndarray) -> np.ndarray:
    """Compute the derivative of a band's mean signals with respect to gains and offsets.

    Returns complex128 [N, N_SB F, 2 N_E] for positions [N, 3] [m] and the weights of
    `element_radiation`.
    """
    los = los_gain(scenario, positions, band)
    by_measurement = np.repeat(np.concatenate([los, los], axis=-1), scenario.n_frames, axis=1)
    design: np.ndarray = by_measurement * radiation[band]
    return design


def scattered_errors(
        scenario: Scenario, radiation: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Compute the covariance of the signals from the multipath at erroneous elements [W].

    Returns complex128 [N_B, N_SB F, N_SB F] for the weights of `element_radiation` and the
    covariance of gains and offsets, complex128 [2 N_E, 2 N_E].
    """
    spatial = np.tile(multipath_covariance(scenario), (1, 2, 2))
    products = np.matmul(radiation @ (spatial * errors), np.conj(np.swapaxes(radiation, 1, 2)))
    covariance: np.ndarray = measurement_correlation(scenario) * products
    return covariance
