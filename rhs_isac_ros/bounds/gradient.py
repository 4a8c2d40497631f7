"""Gradients of quadratic forms with respect to the codebook, errors of the elements included.

`by_radiation` is d/dRe(T_i) + i d/dIm(T_i) of an objective, complex128 [N_B, N_SB F, N_E].
"""

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.impairments.elements import (
    AppliedBeams,
    element_correlation,
    error_radiation,
    error_terms,
)
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.surface import Beamforming, onboard_matrix
from rhs_isac_ros.model.surface_estimate import SurfaceEstimate


def quadratic_gradients(
        model: MeasurementModel, codebook: Beamforming, mean_terms: np.ndarray,
        covariance_terms: np.ndarray, n_items: int, surface: SurfaceEstimate | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the gradients of an average from the sums of `GradientSums` over n items.

    The sums are those of all bands, complex128 [N_B, N_SB F, N_E] and [N_B, N_SB F, N_SB F].
    Returns the gradients with respect to C and S, in the form of `Gradient`. An estimate of the
    surface is taken as exact.
    """
    scenario = model.scenario
    through_covariance = np.matmul(
        np.conj(measurement_correlation(scenario)) * covariance_terms,
        np.matmul(model.radiation, multipath_covariance(scenario)))
    by_radiation = 4 * (through_covariance - mean_terms) / n_items
    if surface:
        return _through_surface(scenario, codebook, surface, by_radiation)
    share = scenario.failed_element_share
    by_analog, by_digital = _through_term(
        scenario, codebook, (share / 2, 1 - share), by_radiation)
    if not model.elements.is_exact:
        radiation = error_radiation(scenario, codebook)
        for term, of_term in zip(error_terms(scenario), radiation, strict=True):
            gradients = _through_term(
                scenario, codebook, term, _by_error(scenario, of_term, covariance_terms, n_items))
            by_analog, by_digital = by_analog + gradients[0], by_digital + gradients[1]
    return by_analog, by_digital


def _by_error(scenario: Scenario, radiation: np.ndarray, covariance_terms: np.ndarray,
              n_items: int) -> np.ndarray:
    """Derivative with respect to a term of `error_radiation` [N_B, N_SB F, N_E]."""
    return np.stack([
        4 / n_items * np.einsum(
            'rsm,sm->rm', np.conj(element_correlation(scenario, band)) * terms[..., None], columns)
        for band, (terms, columns) in enumerate(zip(covariance_terms, radiation, strict=True))])


def _through_surface(
        scenario: Scenario, codebook: Beamforming, surface: SurfaceEstimate,
        by_radiation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradients through a radiation matrix of gains, offsets and gains of the bands."""
    by_radiation = np.conj(surface.band_gains)[:, None, None] * by_radiation
    beams = AppliedBeams(np.conj(surface.applied(codebook.analog)), codebook.digital)
    return (gradient_analog(scenario, codebook, np.conj(surface.gains) * by_radiation),
            gradient_digital(scenario, beams, by_radiation))


def _through_term(
        scenario: Scenario, codebook: Beamforming, term: tuple[float, float],
        by_radiation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradients through a radiation matrix (constant + slope C) * (S B)."""
    constant, slope = term
    beams = AppliedBeams(constant + slope * codebook.analog, codebook.digital)
    return (slope * gradient_analog(scenario, codebook, by_radiation),
            gradient_digital(scenario, beams, by_radiation))


def gradient_analog(
        scenario: Scenario, codebook: Beamforming, by_radiation: np.ndarray) -> np.ndarray:
    """Implements Proposition 2. Derivative with respect to C_i, float64 [N_B, F, N_E].

    The paper writes the chain rule for every pair of coordinates. Here, the pairs have already
    been summed in the derivative with respect to T_i.
    """
    weights = np.matmul(codebook.digital, onboard_matrix(scenario))
    by_radiation = by_radiation.reshape(weights.shape)
    gradient: np.ndarray = np.einsum('ijqm,ijqm->iqm', np.conj(by_radiation), weights).real
    return gradient


def gradient_digital(
        scenario: Scenario, codebook: Beamforming, by_radiation: np.ndarray) -> np.ndarray:
    """Implements Proposition 3. Derivative d/dRe(S) + i d/dIm(S), complex128 [N_B, N_SB, F, K]."""
    onboard = onboard_matrix(scenario)
    n_bands, n_subbands, _, n_elements = onboard.shape
    by_radiation = by_radiation.reshape(n_bands, n_subbands, -1, n_elements)
    weighted = by_radiation * codebook.analog[:, None]
    gradient: np.ndarray = np.matmul(weighted, np.conj(np.swapaxes(onboard, 2, 3)))
    return gradient
