"""Covariance of the received signals due to unknown errors and failures of the elements.

The coefficient of element m in frame q is (1 + e_m) x_{q,m}, with the relative error e_m, complex
normal of variance s^2, and the amplitude x: the configuration c, or with the probability p of a
failure a level that is uniform in [0, 1]. Over surfaces, its mean is (1 - p) c + p / 2, and its
covariance between two frames is

    s^2 E[x_q] E[x_q'] + (1 + s^2) (p / 12 + p (1 - p) (1/2 - c_q) (1/2 - c_q')),

a sum of at most three products of a factor for each frame. Elements are independent. Signals are
treated as circular: failures also contribute a pseudo-covariance, a sum over elements whose terms
differ in phase.
"""

import functools

import numpy as np

from rhs_isac_ros.model.imperfections import AppliedBeams
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix

# Nodes along each side of the region of interest. Products of the gains of two sub-bands have no
# carrier and are smooth.
_ROI_NODES = 8
# Positions evaluated at a time.
_BLOCK = 32


def expected_beams(scenario: Scenario, beams: Beamforming) -> AppliedBeams:
    """Return the beamforming in effect, averaged over surfaces."""
    share = scenario.failed_element_share
    analog = (1 - share) * beams.analog + share / 2 if share else beams.analog
    return AppliedBeams(analog, beams.digital)


def error_factors(scenario: Scenario, analog: np.ndarray) -> np.ndarray:
    """Compute the factors of the coefficients' covariance, float64 [T, N_B, F, N_E].

    The covariance of an element's coefficient between two frames is the sum over the T terms of
    the product of their factors. `analog` is C, float64 [N_B, F, N_E].
    """
    return np.stack([constant + slope * analog for constant, slope in error_terms(scenario)])


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


def error_covariance(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Compute the covariance due to element errors, averaged over the region of interest.

    It includes the errors of the direct path and of the multipath. Returns complex128
    [N_B, N_SB F, N_SB F] [W].
    """
    radiation = error_radiation(scenario, beams)
    covariance = np.empty((scenario.n_bands, *[radiation.shape[2]] * 2), complex)
    for band in range(scenario.n_bands):
        products = np.einsum('trm,tsm->rsm', radiation[:, band], np.conj(radiation[:, band]))
        covariance[band] = np.sum(products * element_correlation(scenario, band), axis=2)
    return covariance


def error_covariance_at(
        scenario: Scenario, beams: Beamforming, positions: np.ndarray) -> np.ndarray:
    """Compute `error_covariance` at positions [N, 3] [m], complex128 [N, N_B, N_SB F, N_SB F]."""
    radiation = error_radiation(scenario, beams)
    n_terms, n_bands, n_measurements, n_elements = radiation.shape
    covariance = np.empty((len(positions), n_bands, n_measurements, n_measurements), complex)
    for band in range(n_bands):
        stacked = np.moveaxis(radiation[:, band], 0, 1)
        power = np.diagonal(multipath_covariance(scenario)[band]).real
        flat = (stacked * np.sqrt(power)).reshape(n_measurements, -1)
        scattered = measurement_correlation(scenario)[band] * (flat @ np.conj(flat.T))
        for start in range(0, len(positions), _BLOCK):
            block = slice(start, start + _BLOCK)
            gains = np.repeat(
                los_gain(scenario, positions[block], band), scenario.n_frames, axis=1)
            direct = (stacked * gains[:, :, None]).reshape(len(gains), n_measurements, -1)
            covariance[block, band] = scattered + np.matmul(
                direct, np.conj(np.swapaxes(direct, 1, 2)))
    return covariance


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
