"""The posterior of the elements and band gains of one surface, as a calibration estimates it.

The coefficient of element m for the amplitude c is linear in two numbers, ``gain c + offset``: an
element that works has the offset 0, and one that has failed the gain 0. A band multiplies all its
signals by a gain of the receiving chain. Mean signals are therefore linear in the elements and
in each band's gain, and their errors have a covariance in closed form.
"""

import dataclasses
import hashlib

import numpy as np

from rhs_isac_ros.model.impairments.elements import AppliedBeams, DirectErrors, SurfaceModel
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceEstimate(SurfaceModel):
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
        return self.failed_probability > 0.5

    def std(self) -> np.ndarray:
        """Return the standard deviations of the rows of `factor`, float64 [2 N_E + N_B]."""
        return np.sqrt(np.sum(np.abs(self.factor)**2, axis=1))

    def without_errors(self) -> 'SurfaceEstimate':
        """Return an estimate that takes the means as exact."""
        return dataclasses.replace(self, factor=self.factor[:, :0])

    def applied(self, analog: np.ndarray) -> np.ndarray:
        """Return the expected coefficients, complex128, for configurations [..., N_E]."""
        return self.gains * analog + self.offsets

    def applied_beams(self, beams: Beamforming) -> AppliedBeams:
        """Return the expected beamforming in effect, with the gains of the bands."""
        return AppliedBeams(
            self.applied(beams.analog), self.band_gains[:, None, None, None] * beams.digital)

    def errors(self, scenario: Scenario, beams: Beamforming) -> tuple[np.ndarray, DirectErrors]:
        """Return the errors, as `SurfaceModel` describes."""
        radiation = element_radiation(scenario, beams)
        of_elements, of_bands = np.split(self.factor, [2 * scenario.n_elements])
        scattered = scattered_errors(scenario, radiation, of_elements @ np.conj(of_elements.T))

        def direct(band: int, positions: np.ndarray) -> np.ndarray:
            design = direct_design(scenario, radiation, band, positions)
            mean = design @ np.concatenate([self.gains, self.offsets])
            return self.band_gains[band] * (
                design @ of_elements + mean[..., None] * of_bands[band])

        return scattered * np.abs(self.band_gains[:, None, None])**2, direct


def element_radiation(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Compute the weights of gains and offsets of the elements in every measurement.

    Returns complex128 [N_B, N_SB F, 2 N_E], for unit gains of the bands.
    """
    weights = np.matmul(beams.digital, onboard_matrix(scenario))
    configured = beams.analog[:, None] * weights
    both = np.concatenate([configured, weights], axis=-1)
    return both.reshape(scenario.n_bands, -1, 2 * scenario.n_elements)


def direct_design(scenario: Scenario, radiation: np.ndarray, band: int,
                  positions: np.ndarray) -> np.ndarray:
    """Compute the derivative of a band's mean signals with respect to gains and offsets.

    Returns complex128 [N, N_SB F, 2 N_E] for positions [N, 3] [m] and the weights of
    `element_radiation`.
    """
    los = los_gain(scenario, positions, band)
    by_measurement = np.repeat(np.concatenate([los, los], axis=-1), scenario.n_frames, axis=1)
    return by_measurement * radiation[band]


def scattered_errors(
        scenario: Scenario, radiation: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Compute the covariance of the signals from the multipath at erroneous elements [W].

    Returns complex128 [N_B, N_SB F, N_SB F] for the weights of `element_radiation` and the
    covariance of gains and offsets, complex128 [2 N_E, 2 N_E].
    """
    spatial = np.tile(multipath_covariance(scenario), (1, 2, 2))
    products = np.matmul(radiation @ (spatial * errors), np.conj(np.swapaxes(radiation, 1, 2)))
    return measurement_correlation(scenario) * products
