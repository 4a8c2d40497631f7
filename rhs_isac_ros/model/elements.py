"""Coefficients of the elements of a surface: drawn, declared as unknown, or estimated.

The coefficient of element m in frame q is (1 + e_m) x_{q,m}. The relative error e_m is complex
normal with variance s^2. The amplitude x is the configuration c or, if the element has failed, a
level that is uniform in [0, 1]; the probability of a failure is p. Over all surfaces, the
coefficient has the mean (1 - p) c + p / 2 and, between two frames, the covariance

    s^2 E[x_q] E[x_q'] + (1 + s^2) (p / 12 + p (1 - p) (1/2 - c_q) (1/2 - c_q')).

This is a sum of at most three terms. Each term is the product of two factors, one for each frame.
Elements are independent. Signals are treated as circular: failures also cause a pseudo-covariance,
but its terms, one for each element, differ in phase and largely cancel.

An estimated coefficient is ``gain c + offset``: the offset of a working element is 0, as is the
gain of a failed one. All signals of a band are also multiplied by a gain of its receive chain.
The mean signals are therefore linear in the gains and offsets of the elements, and in the gain of
each band, so the covariance of their errors has a closed form.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from rhs_isac_ros.model import multipath
from rhs_isac_ros.model.arrays import (
    adjoint,
    blocks,
    digest,
    gauss_legendre,
    numbers,
    read_only,
)
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.surface import Beamforming, Response, radiation_matrix
from rhs_isac_ros.support import streams

# Quadrature nodes along each side of the region of interest. A few suffice, because the carrier
# cancels in the product of the gain in one sub-band and the conjugate gain in another.
_ROI_NODES = 8
# Number of quasi-random positions over which covariances are averaged.
_N_NODES = 128
# Number of positions evaluated at a time.
_BLOCK = 32

# Function of a band and positions, float64 [N, 3] [m]. It returns matrices E, complex128
# [N, N_SB F, R]; the errors of the direct-path signals are E z, with R white numbers z. Objects
# that keep it are pickled, so it is a function of a module with arguments.
DirectErrors = Callable[[int, np.ndarray], np.ndarray]


class SurfaceModel:
    """Knowledge about the elements of a surface: expected coefficients and their errors.

    A subclass defines `response` and, if there are errors, `is_exact` and `errors`.
    """

    @property
    def response(self) -> Response:
        """Slope in c and offset of the expected coefficients, and gains of the bands."""
        raise NotImplementedError

    @property
    def is_exact(self) -> bool:
        """Whether the coefficients of the elements are known without errors."""
        return True

    def applied(self, analog: np.ndarray) -> np.ndarray:
        """Return the expected coefficients for configurations [..., N_E] of the paper's board."""
        slope, offset, _ = self.response
        return slope * analog + offset

    def errors(self, scenario: Scenario, beams: Beamforming) -> tuple[np.ndarray, DirectErrors]:
        """Return the covariance of multipath errors, [N_B, N_SB F, N_SB F], and `DirectErrors`."""
        raise NotImplementedError

    def error_covariance(self, scenario: Scenario, beams: Beamforming) -> np.ndarray:
        """Compute the covariance that element errors add, complex128 [N_B, N_SB F, N_SB F] [W].

        It is an average over the region of interest, and includes the errors of the direct path
        and of the multipath.
        """
        low, high = scenario.roi_bounds_m
        nodes = low + streams.unit_points()[:_N_NODES] * (high - low)
        scattered, direct = self.errors(scenario, beams)
        return np.mean([
            with_direct_errors(scattered, direct, block).mean(axis=0)
            for block in np.split(nodes, len(nodes) // _BLOCK)], axis=0)


@dataclasses.dataclass(frozen=True, eq=False)
class ElementErrors(SurfaceModel):
    """Errors of the elements of one surface, the same in all bands and frames."""

    gains: np.ndarray  #: Factors of the coefficients, complex128 [N_E]; 1 without an error.
    stuck: np.ndarray  #: Amplitudes of failed elements, float64 [N_E]; NaN for working ones.

    def __post_init__(self) -> None:
        """Raise ValueError unless the arrays contain numbers."""
        object.__setattr__(self, 'gains', numbers('gains', self.gains, complex))
        object.__setattr__(self, 'stuck', numbers('stuck', self.stuck, finite=False))

    @property
    def id(self) -> str:
        """Hash of the errors, 16 hexadecimal digits."""
        return digest(self.gains, self.stuck)

    @property
    def response(self) -> Response:
        """The actual slopes and offsets; the bands have the gain 1."""
        return self.gains * np.isnan(self.stuck), self.gains * np.nan_to_num(self.stuck), 1.0


class DeclaredElements(SurfaceModel):
    """The distribution of the coefficients that a scenario declares."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario

    @property
    def is_exact(self) -> bool:
        """Whether the scenario declares no errors."""
        return not has_errors(self._scenario)

    @property
    def response(self) -> Response:
        """The slopes and offsets averaged over surfaces; the bands have the gain 1."""
        share = self._scenario.failed_element_share
        return 1 - share, share / 2, 1.0

    def error_covariance(self, scenario: Scenario, beams: Beamforming) -> np.ndarray:
        """Compute `SurfaceModel.error_covariance` from cached correlations."""
        covariance = []
        for band, radiation in enumerate(np.swapaxes(error_radiation(scenario, beams), 0, 1)):
            products = np.einsum('trm,tsm->rsm', radiation, np.conj(radiation))
            covariance.append(np.sum(products * element_correlation(scenario, band), axis=2))
        return np.stack(covariance)

    def errors(self, scenario: Scenario, beams: Beamforming) -> tuple[np.ndarray, DirectErrors]:
        """Return the errors of multipath and direct path; see `SurfaceModel.errors`."""
        # [N_B, N_SB F, T, N_E]
        radiation = np.moveaxis(error_radiation(scenario, beams), 0, 2)
        n_bands, n_rows = radiation.shape[:2]
        amplitude = np.sqrt(multipath.spatial_covariance(scenario).power)
        flat = (radiation * amplitude[:, None, None]).reshape(n_bands, n_rows, -1)
        return (multipath.measurement_correlation(scenario) * np.matmul(flat, adjoint(flat)),
                functools.partial(_declared_errors, scenario, radiation))


def _declared_errors(scenario: Scenario, radiation: np.ndarray, band: int, positions: np.ndarray
                     ) -> np.ndarray:
    """Compute `DirectErrors` from the radiation of T terms, [N_B, N_SB F, T, N_E]."""
    n_rows, n_terms, n_elements = radiation.shape[1:]
    by_subband = radiation[band].reshape(scenario.n_subbands, -1, n_elements)
    errors = by_subband * los_gain(scenario, positions, band)[:, :, None]
    return errors.reshape(len(positions), n_rows, n_terms * n_elements)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class SurfaceEstimate(SurfaceModel):
    """Mean and covariance of the coefficients of a surface, ``gain c + offset``.

    Raises ValueError if sizes disagree, or a number is not finite or not a probability.
    """

    gains: np.ndarray  #: Expected gains of the elements, complex128 [N_E].
    offsets: np.ndarray  #: Expected offsets of the elements, complex128 [N_E].
    band_gains: np.ndarray  #: Expected gain of each band, complex128 [N_B].
    #: F such that F F^H is the covariance of gains, offsets and relative errors of the band gains,
    #: complex128 [2 N_E + N_B, R].
    factor: np.ndarray
    failed_probability: np.ndarray  #: Probability that each element has failed, float64 [N_E].

    def __post_init__(self) -> None:
        """Copy and check the arrays, and make them read-only."""
        n_elements, n_bands = np.size(self.gains), np.size(self.band_gains)
        for name, kind, shape in (
                ('gains', complex, (n_elements,)), ('offsets', complex, (n_elements,)),
                ('band_gains', complex, (n_bands,)),
                ('factor', complex, (2 * n_elements + n_bands, 'R')),
                ('failed_probability', float, (n_elements,))):
            array = numbers(name, getattr(self, name), kind, shapes=[shape])
            object.__setattr__(self, name, read_only(array.copy('K')))
        probability = self.failed_probability
        if n_elements and not (0 <= probability.min() and probability.max() <= 1):
            raise ValueError(f'failed_probability: {probability.min():g} to '
                             f'{probability.max():g}, expected 0 to 1')

    def __repr__(self) -> str:
        """Return the identifier and the sizes, but no arrays."""
        return (f'SurfaceEstimate(id={self.id!r}, n_bands={len(self.band_gains)}, '
                f'n_elements={len(self.gains)})')

    @property
    def is_exact(self) -> bool:
        """Whether the estimate has no errors."""
        return not self.factor.shape[1]

    @property
    def id(self) -> str:
        """Hash of the estimate without `failed_probability`, 16 hexadecimal digits."""
        return digest(self.gains, self.offsets, self.band_gains, self.factor)

    @property
    def failed(self) -> np.ndarray:
        """Whether each element has probably failed, bool [N_E]."""
        return self.failed_probability > 0.5

    def std(self) -> np.ndarray:
        """Return standard deviations of gains, offsets and relative band gains, [2 N_E + N_B]."""
        return np.sqrt(np.sum(np.abs(self.factor)**2, axis=1))

    @property
    def response(self) -> Response:
        """The expected gains and offsets of the elements, and gains of the bands."""
        return self.gains, self.offsets, self.band_gains

    def errors(self, scenario: Scenario, beams: Beamforming) -> tuple[np.ndarray, DirectErrors]:
        """Return the errors of multipath and direct path; see `SurfaceModel.errors`."""
        radiation = element_radiation(scenario, beams)
        of_elements = self.factor[:2 * scenario.n_elements]
        scattered = scattered_errors(scenario, radiation, of_elements @ np.conj(of_elements.T))
        return (scattered * np.abs(self.band_gains[:, None, None])**2,
                functools.partial(self._direct_errors, scenario, radiation))

    def _direct_errors(self, scenario: Scenario, radiation: np.ndarray, band: int,
                       positions: np.ndarray) -> np.ndarray:
        of_elements, of_bands = np.split(self.factor, [2 * scenario.n_elements])
        design = direct_design(scenario, radiation, band, positions)
        mean = design @ np.concatenate([self.gains, self.offsets])
        return self.band_gains[band] * (design @ of_elements + mean[..., None] * of_bands[band])


def no_direct_errors(n_rows: int, band: int, positions: np.ndarray) -> np.ndarray:
    """Return `DirectErrors` of exact elements, for N_SB F rows, zeros [1, N_SB F, 1]."""
    return np.zeros((1, n_rows, 1))


def with_direct_errors(
        covariance: np.ndarray, direct: DirectErrors, positions: np.ndarray) -> np.ndarray:
    """Add the errors of the direct path at positions [N, 3] to a covariance [N_B, N_SB F, N_SB F].

    Returns complex128 [N, N_B, N_SB F, N_SB F].
    """
    total = np.empty((len(positions), *covariance.shape), complex)
    for band in range(len(covariance)):
        for block in blocks(len(positions), _BLOCK):
            errors = direct(band, positions[block])
            total[block, band] = covariance[band] + np.matmul(errors, adjoint(errors))
    return total


def has_errors(scenario: Scenario) -> bool:
    """Return whether a scenario declares errors or failures of elements."""
    return scenario.element_error_rms > 0 or scenario.failed_element_share > 0


def draw_surface(scenario: Scenario, rng: np.random.Generator) -> ElementErrors:
    """Draw the errors of a surface.

    Generators in the same state draw the same errors, scaled to the declared size. A higher share
    of failed elements only adds failures.
    """
    n_elements = scenario.n_elements
    fate, levels = rng.uniform(size=(2, n_elements))
    gains = 1 + scenario.element_error_rms * multipath.complex_normal((n_elements,), rng)
    return ElementErrors(
        gains, np.where(fate < scenario.failed_element_share, levels, np.nan))


def error_terms(scenario: Scenario) -> list[tuple[float, float]]:
    """Return the factors of the coefficients' covariance, as constants and slopes in c.

    The covariance of an element's coefficient between two frames is a sum of T terms: at most one
    for relative errors and two for failures. A term is a product of two factors, one per frame.
    """
    rms, share = scenario.element_error_rms, scenario.failed_element_share
    spread = np.sqrt((1 + rms**2) * share)
    centred = spread * np.sqrt(1 - share)
    terms = [(rms * share / 2, rms * (1 - share)), (spread / np.sqrt(12), 0.0),
             (centred / 2, -centred)]
    return [term for term in terms if any(term)]


def error_radiation(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Return the radiation for the factors of `error_terms`, [T, N_B, N_SB F, N_E]."""
    return np.array([
        radiation_matrix(scenario, beams, (slope, constant, 1.0))
        for constant, slope in error_terms(scenario)
    ]).reshape(-1, scenario.n_bands, scenario.n_subbands * scenario.n_frames, scenario.n_elements)


@functools.lru_cache(maxsize=16)
def element_correlation(
        scenario: Scenario, band: int, n_nodes: int = _ROI_NODES) -> np.ndarray:
    """Compute the correlation of each element's gain over the measurements of a band.

    It includes the direct path, averaged over the region of interest, and the multipath. Returns
    complex128 [N_SB F, N_SB F, N_E], read-only.
    """
    nodes, weights = gauss_legendre(n_nodes)
    low, high = scenario.roi_bounds_m
    axes = ((low + high) / 2 + nodes[:, None] * (high - low) / 2).T
    positions = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    shares = np.einsum('a,b,c->abc', *[weights / 2] * 3).ravel()
    direct = np.zeros((scenario.n_subbands, scenario.n_subbands, scenario.n_elements), complex)
    for block in blocks(len(positions), _BLOCK):
        gains = los_gain(scenario, positions[block], band)
        direct += np.einsum('n,njm,nlm->jlm', shares[block], gains, np.conj(gains))
    correlation = np.repeat(np.repeat(direct, scenario.n_frames, 0), scenario.n_frames, 1)
    power = multipath.spatial_covariance(scenario).power[band]
    correlation += multipath.measurement_correlation(scenario)[band][..., None] * power
    return read_only(correlation)


def element_radiation(scenario: Scenario, beams: Beamforming) -> np.ndarray:
    """Compute the weights of gains and offsets of the elements in every measurement.

    Returns complex128 [N_B, N_SB F, 2 N_E], for unit gains of the bands.
    """
    return np.concatenate([radiation_matrix(scenario, beams),
                           radiation_matrix(scenario, beams, (0.0, 1.0, 1.0))], axis=-1)


def direct_design(scenario: Scenario, radiation: np.ndarray, band: int,
                  positions: np.ndarray) -> np.ndarray:
    """Compute the derivative of a band's mean signals with respect to gains and offsets.

    Takes the result of `element_radiation`. Returns complex128 [N, N_SB F, 2 N_E] for band gain 1.
    """
    los = los_gain(scenario, positions, band)
    by_measurement = np.repeat(np.concatenate([los, los], axis=-1), scenario.n_frames, axis=1)
    return by_measurement * radiation[band]


def scattered_errors(
        scenario: Scenario, radiation: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Compute the covariance [W] that errors of the elements cause through the multipath.

    Takes the weights of `element_radiation` and the covariance of gains and offsets, complex128
    [2 N_E, 2 N_E]. Returns complex128 [N_B, N_SB F, N_SB F].
    """
    spatial = np.tile(multipath.multipath_covariance(scenario), (1, 2, 2))
    products = np.matmul(radiation @ (spatial * errors), adjoint(radiation))
    return multipath.measurement_correlation(scenario) * products
