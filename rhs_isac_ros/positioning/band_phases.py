"""The information in phases of the bands that are neither known nor uniform.

Relative to uniform phases, the likelihood of a position has one factor for each band: the density
of the phase of the matched filter's output, the wrapped normal distribution broadened by the
noise. Along the range, the product of the factors turns with the carriers, far faster than the
rest of the posterior: it has peaks of centimetres, whose heights follow the differences of the
carriers. It is averaged over one wavelength around each sample.
"""

import numpy as np

from rhs_isac_ros.positioning.templates import carrier_wavenumbers
from rhs_isac_ros.positioning.unknowns import Unknowns
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Spacing of the ranges, in standard deviations of the product of the bands' factors.
_SPACING = 1.5
# Values of a phase that all bands share: the average over the range nearly removes it.
_N_COMMON = 8
# From this standard deviation, a wrapped phase is uniform; wraps beyond one turn are negligible.
_MAX_STD_RAD = 3.0


class BandPhases:
    """The prior of the bands' phases.

    Attributes
    ----------
    is_informative
        Whether the search has left out information in the phases of the bands; otherwise, there
        are no factors.
    """

    def __init__(self, model: WhitenedModel, unknowns: Unknowns) -> None:
        self._std = unknowns.prior_band_phase_std_rad
        self.is_informative = unknowns.is_coarse and bool(np.isfinite(self._std))
        if not self.is_informative:
            return
        wavenumbers = carrier_wavenumbers(model.scenario)
        spacing = _SPACING * self._std / np.sqrt(len(wavenumbers))
        n_ranges = int(np.ceil(2 * np.pi / spacing))
        self._ranges_m = (((np.arange(n_ranges) + 0.5) / n_ranges - 0.5)
                          * 2 * np.pi / wavenumbers.mean())
        common, log_weights = _common_phase(unknowns.prior_phase_std_rad)
        self._turns = wavenumbers[:, None, None] * self._ranges_m[:, None] + common
        self._log_weights = log_weights - np.log(n_ranges)

    def factors(self, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Average the product of the factors over the wavelength around positions.

        Takes the outputs of the matched filters at the positions, complex128 [N_B, P].

        Returns
        -------
        log_factors, offsets_m
            Logarithm of the average, and the mean offset in range [m], float64 [P].
        """
        log_factor = np.zeros((outputs.shape[1], *self._turns.shape[1:]))
        for output, turns in zip(outputs, self._turns, strict=True):
            std = self._broadened(np.abs(output))[:, None, None]
            log_factor += _log_density(np.angle(output)[:, None, None] + turns, std)
        log_factor += self._log_weights
        highest = log_factor.max(axis=(1, 2))
        weights = np.exp(log_factor - highest[:, None, None]).sum(axis=2)
        total = weights.sum(axis=1)
        return highest + np.log(total), weights @ self._ranges_m / total

    def _broadened(self, magnitude: np.ndarray) -> np.ndarray:
        """Standard deviation of the phase of outputs of these magnitudes.

        That of the noise has the von Mises density; its first harmonic is that of a wrapped
        normal distribution.
        """
        from scipy.special import i0e, i1e

        concentration = 2 * np.maximum(magnitude, 1e-9)
        variance: np.ndarray = (
            self._std**2 - 2 * np.log(i1e(concentration) / i0e(concentration)))
        std: np.ndarray = np.minimum(np.sqrt(variance), _MAX_STD_RAD)
        return std


def _common_phase(std: float) -> tuple[np.ndarray, np.ndarray]:
    """Values of the phase that all bands share, and the logarithms of their weights."""
    if std == 0:
        return np.zeros(1), np.zeros(1)
    if not np.isfinite(std):
        turns = 2 * np.pi * np.arange(_N_COMMON) / _N_COMMON
        return turns, np.full(_N_COMMON, -np.log(_N_COMMON))
    values, weights = np.polynomial.hermite_e.hermegauss(_N_COMMON)
    return std * values, np.log(weights / weights.sum())


def _log_density(angle: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Density of the wrapped normal distribution relative to the uniform one, as a logarithm."""
    angle = angle - 2 * np.pi * np.round(angle / (2 * np.pi))
    # The wraps by one turn, relative to the term without a wrap.
    ratio = np.exp(-2 * np.pi**2 / std**2)
    slope = 2 * np.pi / std**2 * angle
    wraps = ratio * (np.exp(slope) + np.exp(-slope))
    density: np.ndarray = (np.log(np.sqrt(2 * np.pi) / std) - angle**2 / (2 * std**2)
                           + np.log1p(wraps))
    return density
