"""Unknown coefficients of the elements: draws, and their effect on mean and covariance.

The coefficient of element m in frame q is (1 + e_m) x_{q,m}, with the relative error e_m, complex
normal of variance s^2, and the amplitude x: the configuration c, or with the probability p of a
failure a level that is uniform in [0, 1]. Over surfaces, its mean is (1 - p) c + p / 2, and its
covariance between two frames is

    s^2 E[x_q] E[x_q'] + (1 + s^2) (p / 12 + p (1 - p) (1/2 - c_q) (1/2 - c_q')),

a sum of at most three products of a factor for each frame. Elements are independent. Signals are
treated as circular: failures also contribute a pseudo-covariance, a sum over elements whose terms
differ in phase.
"""

import dataclasses
import functools
import hashlib
from typing import NamedTuple, Protocol

import numpy as np

from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import (
    complex_normal,
    measurement_correlation,
    multipath_covariance,
)
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix

# Nodes along each side of the region of interest. Products of the gains of two sub-bands have no
# carrier and are smooth.
_ROI_NODES = 8
# Positions evaluated at a time.
_BLOCK = 32


class AppliedBeams(NamedTuple):
    """Beamforming whose coefficients need not be real, or levels of the surface."""

    analog: np.ndarray
    digital: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class ElementErrors:
    """Errors of the elements of one surface, the same in all bands and frames.

    Attributes
    ----------
    gains
        Factor of the coefficient of each element, complex128 [N_E]; 1 without an error.
    stuck
        Amplitude of each failed element, float64 [N_E]; NaN where an element works.
    """

    gains: np.ndarray
    stuck: np.ndarray
    is_exact = True

    @property
    def id(self) -> str:
        """Hash of the errors, 16 hexadecimal digits."""
        digest = hashlib.sha256(np.asarray(self.gains, complex).astype('<c16').tobytes())
        digest.update(np.asarray(self.stuck, float).astype('<f8').tobytes())
        return digest.hexdigest()[:16]

    def applied(self, analog: np.ndarray) -> np.ndarray:
        """Return the coefficients in effect, complex128, for configurations [..., N_E].

        Raise ValueError if the surface has another number of elements.
        """
        if analog.shape[-1:] != self.gains.shape:
            raise ValueError(f'surface: {len(self.gains)} elements, expected N_E = '
                             f'{analog.shape[-1]} as in the configurations')
        coefficients: np.ndarray = np.where(np.isnan(self.stuck), analog, self.stuck) * self.gains
        return coefficients

    def applied_beams(self, beams: Beamforming) -> AppliedBeams:
        """Return the beamforming in effect."""
        return AppliedBeams(self.applied(beams.analog), beams.digital)

    def error_covariance(self, scenario: Scenario, beams: Beamforming) -> np.ndarray:
        """Return the covariance of `SurfaceModel`: zero."""
        return np.zeros((scenario.n_bands, *[scenario.n_subbands * scenario.n_frames] * 2))

    def error_covariance_at(
            self, scenario: Scenario, beams: Beamforming, positions: np.ndarray) -> np.ndarray:
        """Return the covariance of `SurfaceModel` at positions: zero."""
        return np.repeat(self.error_covariance(scenario, beams)[None], len(positions), axis=0)


class SurfaceModel(Protocol):
    """Knowledge of the elements of a surface: expected coefficients and the errors of these."""

    @property
    def is_exact(self) -> bool:
        """Whether there are no errors."""
        ...

    def applied_beams(self, beams: Beamforming) -> AppliedBeams:
        """Return the expected beamforming in effect."""
        ...

    def error_covariance(self, scenario: Scenario, beams: Beamforming) -> np.ndarray:
        """Compute the covariance due to errors, complex128 [N_B, N_SB F, N_SB F] [W].

        It is the average over the region of interest, and includes the errors of the direct path
        and of the multipath.
        """
        ...

    def error_covariance_at(
            self, scenario: Scenario, beams: Beamforming, positions: np.ndarray) -> np.ndarray:
        """Compute `error_covariance` at positions [N, 3] [m] instead, [N, N_B, N_SB F, N_SB F]."""
        ...


class DeclaredElements:
    """The distribution of the elements that a scenario declares: a `SurfaceModel`."""

    def __init__(self, scenario: Scenario) -> None:
        self.is_exact = not has_errors(scenario)
        self._failed_share = scenario.failed_element_share

    def applied_beams(self, beams: Beamforming) -> AppliedBeams:
        """Return the beamforming in effect, averaged over surfaces."""
        share = self._failed_share
        analog = (1 - share) * beams.analog + share / 2 if share else beams.analog
        return AppliedBeams(analog, beams.digital)

    def error_covariance(self, scenario: Scenario, beams: Beamforming) -> np.ndarray:
        """Compute the covariance, as `SurfaceModel` describes."""
        radiation = error_radiation(scenario, beams)
        covariance = np.empty((scenario.n_bands, *[radiation.shape[2]] * 2), complex)
        for band in range(scenario.n_bands):
            products = np.einsum('trm,tsm->rsm', radiation[:, band], np.conj(radiation[:, band]))
            covariance[band] = np.sum(products * element_correlation(scenario, band), axis=2)
        return covariance

    def error_covariance_at(
            self, scenario: Scenario, beams: Beamforming, positions: np.ndarray) -> np.ndarray:
        """Compute the covariance at positions, as `SurfaceModel` describes."""
        radiation = error_radiation(scenario, beams)
        _, n_bands, n_rows, _ = radiation.shape
        covariance = np.empty((len(positions), n_bands, n_rows, n_rows), complex)
        for band in range(n_bands):
            stacked = np.moveaxis(radiation[:, band], 0, 1)
            power = np.diagonal(multipath_covariance(scenario)[band]).real
            flat = (stacked * np.sqrt(power)).reshape(n_rows, -1)
            scattered = measurement_correlation(scenario)[band] * (flat @ np.conj(flat.T))
            for start in range(0, len(positions), _BLOCK):
                block = slice(start, start + _BLOCK)
                gains = np.repeat(
                    los_gain(scenario, positions[block], band), scenario.n_frames, axis=1)
                direct = (stacked * gains[:, :, None]).reshape(len(gains), n_rows, -1)
                covariance[block, band] = scattered + np.matmul(
                    direct, np.conj(np.swapaxes(direct, 1, 2)))
        return covariance


def has_errors(scenario: Scenario) -> bool:
    """Return whether a scenario declares errors or failures of elements."""
    return scenario.element_error_rms > 0 or scenario.failed_element_share > 0


def draw_surface(scenario: Scenario, rng: np.random.Generator) -> ElementErrors:
    """Draw the errors of a surface.

    Generators in the same state give the same errors up to their declared size, and a higher
    share of failed elements adds failures.
    """
    n_elements = scenario.n_elements
    fate, levels = rng.uniform(size=(2, n_elements))
    gains = 1 + scenario.element_error_rms * complex_normal((n_elements,), rng)
    return ElementErrors(
        gains, np.where(fate < scenario.failed_element_share, levels, np.nan))


def error_factors(scenario: Scenario, analog: np.ndarray) -> np.ndarray:
    """Compute the factors of the coefficients' covariance, float64 [T, N_B, F, N_E].

    The covariance of an element's coefficient between two frames is the sum over the T terms of
    the product of their factors. `analog` is C, float64 [N_B, F, N_E].
    """
    factors = [constant + slope * analog for constant, slope in error_terms(scenario)]
    return np.array(factors).reshape(-1, *analog.shape)


def error_terms(scenario: Scenario) -> list[tuple[float, float]]:
    """Return the T factors of `error_factors` as a constant and a slope over the amplitude c.

    There is one term for errors alone, and there are two more if elements can fail.
    """
    rms, share = scenario.element_error_rms, scenario.failed_element_share
    spread = np.sqrt((1 + rms**2) * share)
    centred = spread * np.sqrt(1 - share)
    terms = [(rms * share / 2, rms * (1 - share)), (spread / np.sqrt(12), 0.0),
             (centred / 2, -centred)]
    return [term for term in terms if any(term)]


def error_radiation(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Compute the factors times the weights S B, complex128 [T, N_B, N_SB F, N_E]."""
    weights = np.matmul(beams.digital, onboard_matrix(scenario))
    factors = error_factors(scenario, beams.analog)
    radiation: np.ndarray = (factors[:, :, None] * weights).reshape(
        len(factors), scenario.n_bands, -1, scenario.n_elements)
    return radiation


@functools.lru_cache(maxsize=16)
def element_correlation(scenario: Scenario, band: int) -> np.ndarray:
    """Compute the correlation of an element's gain over the measurements of a band.

    The gain is that of the direct path, averaged over the region of interest, and of the
    multipath. Returns complex128 [N_SB F, N_SB F, N_E], read-only.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_ROI_NODES)
    low, high = scenario.roi_bounds_m
    axes = ((low + high) / 2 + nodes[:, None] * (high - low) / 2).T
    positions = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    shares = np.einsum('a,b,c->abc', *[weights / 2] * 3).ravel()
    direct = np.zeros((scenario.n_subbands, scenario.n_subbands, scenario.n_elements), complex)
    for start in range(0, len(positions), _BLOCK):
        block = slice(start, start + _BLOCK)
        gains = los_gain(scenario, positions[block], band)
        direct += np.einsum('n,njm,nlm->jlm', shares[block], gains, np.conj(gains))
    correlation = np.repeat(np.repeat(direct, scenario.n_frames, 0), scenario.n_frames, 1)
    power = np.diagonal(multipath_covariance(scenario)[band])
    correlation += measurement_correlation(scenario)[band][..., None] * power
    correlation.flags.writeable = False
    return correlation
