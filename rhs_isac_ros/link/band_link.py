"""The link between the surface and one position in one band, as arrays for steering."""

import dataclasses
import functools

import numpy as np

from rhs_isac_ros.link.water_filling import water_filling
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.model.surface import onboard_matrix
from rhs_isac_ros.model.surface_estimate import SurfaceEstimate

# Largest share of the multipath power that the modes may omit.
_MAX_OMITTED = 0.02


@dataclasses.dataclass(frozen=True, eq=False)
class BandLink:
    """The link between the surface and a user in one band.

    Attributes
    ----------
    onboard
        B_j, complex128 [N_SB, K, N_E].
    los
        Line-of-sight gains, complex128 [N_SB, N_E].
    spatial
        V_i, which is real, float64 [N_E, N_E].
    modes
        The strongest modes of V_i, float64 [N_E, r]: G with G G^T close to V_i.
    noise_power_w, power_w
        Noise power of a sub-band, and power of the digital part over all sub-bands [W].
    fixed
        Elements that do not follow the configuration, bool [N_E]; theirs is 1.
    """

    onboard: np.ndarray
    los: np.ndarray
    spatial: np.ndarray
    modes: np.ndarray
    noise_power_w: float
    power_w: float
    fixed: np.ndarray

    @classmethod
    def to(cls, scenario: Scenario, position: np.ndarray, band: int,
           surface: SurfaceEstimate | None = None) -> 'BandLink':
        """Return the link to a position, float64 [3] [m], in a band, counted from 0.

        The coefficients of an estimated surface become part of the propagation on the board.

        Raises
        ------
        ValueError
            If the position is not a finite [3] array.
        """
        los = los_gain(scenario, np.asarray(position, dtype=float)[None], band)[0]
        spatial, modes = _multipath(scenario)[band]
        onboard, fixed = onboard_matrix(scenario)[band], np.zeros(scenario.n_elements, bool)
        if surface:
            fixed = surface.failed
            coefficients = np.where(fixed, surface.offsets, surface.gains)
            onboard = surface.band_gains[band] * coefficients * onboard
        return cls(onboard, los, spatial, modes, scenario.noise_power_w, scenario.max_power_w,
                   fixed)

    def best_digital(self, analog: np.ndarray) -> np.ndarray:
        """Return the best digital part for a configuration, complex128 [N_SB, K] [sqrt(W)].

        It follows the principal eigenvectors of the correlation matrices of the channels at the
        feeds, with the power divided by water-filling. The configuration is float64 [N_E].
        """
        gains, directions = np.linalg.eigh(self._correlations(analog))
        power = water_filling(gains[:, -1] / self.noise_power_w, self.power_w)
        # s is a row: s M s^H is largest along the conjugate of the eigenvector.
        digital: np.ndarray = np.conj(directions[:, :, -1]) * np.sqrt(power)[:, None]
        return digital

    def best_rate(self, analog: np.ndarray) -> float:
        """Return the capacity with the best digital part [nat/symbol], summed over sub-bands."""
        gains = np.linalg.eigvalsh(self._correlations(analog))[:, -1] / self.noise_power_w
        return float(np.log1p(gains * water_filling(gains, self.power_w)).sum())

    def scatter(self, weights: np.ndarray) -> np.ndarray:
        """Multiply weights of the elements, complex128 [..., N_E], by V_i; same shape."""
        # Two real products take half the time of one complex product.
        result = np.empty(weights.shape, complex)
        result.real, result.imag = weights.real @ self.spatial, weights.imag @ self.spatial
        return result

    def _correlations(self, analog: np.ndarray) -> np.ndarray:
        """Correlation matrices of the channels at the feeds, complex128 [N_SB, K, K]."""
        configured = self.onboard * analog
        direct = np.matmul(configured, self.los[:, :, None])
        correlations: np.ndarray = direct * np.conj(np.swapaxes(direct, 1, 2))
        correlations += np.matmul(self.scatter(configured), np.conj(np.swapaxes(configured, 1, 2)))
        return correlations


@functools.lru_cache(maxsize=16)
def _multipath(scenario: Scenario) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Covariance of each band, float64 [N_E, N_E], and its strongest modes, float64 [N_E, r]."""
    result = []
    for covariance in multipath_covariance(scenario):
        spatial = np.ascontiguousarray(covariance.real)
        powers, directions = np.linalg.eigh(spatial)
        powers, directions = np.maximum(powers[::-1], 0), directions[:, ::-1]
        rank = 1 + int(np.searchsorted(np.cumsum(powers), (1 - _MAX_OMITTED) * powers.sum()))
        modes = directions[:, :rank] * np.sqrt(powers[:rank])
        for array in (spatial, modes):
            array.flags.writeable = False
        result.append((spatial, modes))
    return tuple(result)
