"""The likelihood of positions for a given set of failed elements.

A failed element is stuck at an amplitude that is uniform in [0, 1]. With its amplitude treated as
Gaussian, of mean 1/2 and variance 1/12, the signals are Gaussian: each failed element shifts the
mean, and adds to the covariance, for the direct path and the multipath.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.model.element_error import element_correlation, error_covariance
from rhs_isac_ros.model.los import los_and_derivative
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.surface import onboard_matrix
from rhs_isac_ros.positioning.polar import jacobian, to_positions
from rhs_isac_ros.positioning.region import likelihood_loss
from rhs_isac_ros.positioning.table import MIN_CURVATURE
from rhs_isac_ros.positioning.whitened import WhitenedModel

_STEP_LIMITS = np.array([0.02, 0.03, 0.03])
# The residual decreases with the amplitudes; the derivative is that of the mean.
_SIGNS = np.array([-1.0, 1.0, 1.0, 1.0])[:, None, None]
# Number of surfaces to keep.
_MAX_SURFACES = 256


class Surface(NamedTuple):
    """A set of failed elements.

    Attributes
    ----------
    failed
        The elements, in ascending order.
    scattered
        T V, complex128 [N_B, N_SB F, N_E].
    covariance
        Covariance of the signals without the direct path of the failed elements, complex128
        [N_B, N_SB F, N_SB F].
    """

    failed: tuple[int, ...]
    scattered: np.ndarray
    covariance: np.ndarray


class Site(NamedTuple):
    """The signals of a phase at a point.

    Attributes
    ----------
    point
        (r [m], u, v), float64 [3].
    columns
        Residual of an intact surface and derivatives of the mean, complex128
        [4, N_B, N_SB F].
    changes
        Changes of the columns if an element fails, complex128 [N_E, 4, N_B, N_SB F].
    spread
        Standard deviation of the direct path then, complex128 [N_E, N_B, N_SB F].
    """

    point: np.ndarray
    columns: np.ndarray
    changes: np.ndarray
    spread: np.ndarray


class Extensions(NamedTuple):
    """A set with one more failed element, for every element.

    Attributes
    ----------
    whitener
        Inverse Cholesky factor of the covariance as in `Surface`, complex128
        [N_B, N_E, N_SB F, N_SB F].
    volume
        Logarithm of the determinant of the covariance, float64 [N_E].
    """

    whitener: np.ndarray
    volume: np.ndarray


class Weighed(NamedTuple):
    """H hypotheses after a Gauss-Newton step from their site.

    Attributes
    ----------
    value
        Logarithm of prior times likelihood, relative to the prior of an intact surface, [H].
    step, curvature
        Step [H, 3] of the point, and curvature of the log-likelihood there [H, 3, 3].
    residual
        Energy of the whitened residual [H].
    """

    value: np.ndarray
    step: np.ndarray
    curvature: np.ndarray
    residual: np.ndarray


class FailureModel:
    """Likelihood of positions and sets of failed elements under the declared share of failures."""

    def __init__(self, model: WhitenedModel) -> None:
        scenario, codebook = model.scenario, model.codebook
        self.scenario, self._search_model = scenario, model
        intact = dataclasses.replace(scenario, failed_element_share=0.0)
        self._model = MeasurementModel(intact, codebook).prepare(jacobian=True)
        weights = np.matmul(codebook.digital, onboard_matrix(scenario))
        shift = (0.5 - codebook.analog[:, None]) * weights
        shape = self._model.radiation.shape
        self._shift, self._spread = (
            np.ascontiguousarray(np.moveaxis(array.reshape(shape), 2, 0))
            for array in (shift, weights / np.sqrt(12)))
        self._spatial = multipath_covariance(scenario)
        self._correlation = measurement_correlation(scenario)
        self._intact = Surface((), np.matmul(self._model.radiation, self._spatial),
                               self._model.covariance())
        self._surfaces: dict[tuple[int, ...], Surface] = {}
        self._error = error_covariance(
            dataclasses.replace(scenario, element_error_rms=0.0), codebook)
        self._extensions: dict[tuple[tuple[int, ...], float], Extensions] = {}
        share = scenario.failed_element_share
        self._log_odds = float(np.log(share / (1 - share)))

    def surface(self, failed: tuple[int, ...]) -> Surface:
        """Return the surface with these failed elements, in ascending order."""
        if not failed:
            return self._intact
        if failed not in self._surfaces:
            smaller, element = self.surface(failed[:-1]), failed[-1]
            shift = self._shift[element]
            scattered = smaller.scattered + shift[..., None] * self._spatial[:, None, element]
            growth = self._growth(smaller, slice(element, element + 1))[0]
            if len(self._surfaces) >= _MAX_SURFACES:
                self._surfaces.clear()
            self._surfaces[failed] = Surface(failed, scattered, smaller.covariance + growth)
        return self._surfaces[failed]

    def site(self, point: np.ndarray, received: np.ndarray) -> Site:
        """Evaluate the signals of a phase, complex128 [N_B, N_SB F], at a point."""
        position = to_positions(point[None])
        by_point = jacobian(point[None])[0]
        mean, slopes = self._model.mean_and_jacobian(position)
        columns = np.concatenate([received[None] - mean, np.tensordot(by_point.T, slopes[0], 1)])
        gains = []
        for band in range(self.scenario.n_bands):
            gain, slope = los_and_derivative(self.scenario, position, band)
            both = np.concatenate([gain, np.tensordot(by_point.T, slope[0], 1)])
            gains.append(np.repeat(both, self.scenario.n_frames, axis=1))
        elements = np.moveaxis(np.stack(gains), (0, 1, 2, 3), (2, 1, 3, 0))
        return Site(point, columns, _SIGNS * elements * self._shift[:, None],
                    elements[:, 0] * self._spread)

    def weigh(self, surface: Surface, site: Site) -> Weighed:
        """Weigh a surface at a site: H is 1."""
        columns, spread = self._at(surface, site)
        direct = np.matmul(spread, np.conj(np.swapaxes(spread, 1, 2)))
        roots = np.linalg.cholesky(surface.covariance + direct)
        white = np.linalg.solve(roots, np.moveaxis(columns, 0, 2))
        products = np.matmul(np.conj(np.swapaxes(white, 1, 2)), white).real.sum(axis=0)
        return _weigh(len(surface.failed) * self._log_odds - _log_determinant(roots).sum(),
                      products[None])

    def weigh_extensions(self, surface: Surface, site: Site, remainder: float = 0.0) -> np.ndarray:
        """Compute the values of `weigh` if one more element fails, float64 [N_E].

        Besides, further elements may have failed, the declared share times `remainder` of them.
        They add to the covariance, so that elements which explain a part of the signals have a
        higher value than elements which imitate the sum.
        """
        extended = self._extensions_of(surface.failed, remainder)
        columns, spread = self._at(surface, site)
        # For each band and element: residual and derivatives, then the spread of all failures.
        parts = np.concatenate([
            np.moveaxis(columns + site.changes, 2, 0),
            np.broadcast_to(np.swapaxes(spread, 1, 2)[:, None], (
                len(spread), len(site.spread), spread.shape[2], spread.shape[1])),
            np.swapaxes(site.spread, 0, 1)[:, :, None]], axis=2)
        white = np.matmul(parts, np.swapaxes(extended.whitener, 2, 3))
        columns, spread = white[:, :, :4], white[:, :, 4:]
        # The spread is a change of low rank: Woodbury's identity.
        adjoint = np.conj(np.swapaxes(columns, 2, 3))
        roots = np.linalg.cholesky(
            np.matmul(spread.conj(), np.swapaxes(spread, 2, 3)) + np.eye(spread.shape[2]))
        explained = np.linalg.solve(roots, np.conj(np.matmul(spread, adjoint)))
        products = (np.matmul(columns, adjoint).real - np.matmul(
            np.conj(np.swapaxes(explained, 2, 3)), explained).real).sum(axis=0)
        n_failed = len(surface.failed) + 1
        volume = extended.volume + _log_determinant(roots).sum(axis=0)
        return _weigh(n_failed * self._log_odds - volume, products).value

    def search_factor(self, failed: tuple[int, ...]) -> np.ndarray:
        """Compute the factor of the inverse covariance of a set for `TemplateTable.peaks_under`.

        The failed elements have their second moments, averaged over the region of interest.
        """
        covariance = self._intact.covariance.copy()
        for band, of_band in enumerate(covariance):
            correlation = element_correlation(self.scenario, band)
            for element in failed:
                parts = np.stack([self._shift[element, band], self._spread[element, band]], axis=1)
                of_band += (parts @ parts.conj().T) * correlation[..., element]
        ratio = np.linalg.solve(np.linalg.cholesky(covariance), self._search_model.root)
        factor: np.ndarray = np.conj(np.swapaxes(ratio, 1, 2))
        return factor

    def _at(self, surface: Surface, site: Site) -> tuple[np.ndarray, np.ndarray]:
        """Columns [4, N_B, S] of a surface at a site, and the spread [N_B, S, K] of failures."""
        failed = list(surface.failed)
        return (site.columns + site.changes[failed].sum(axis=0),
                np.moveaxis(site.spread[failed], 0, 2))

    def _extensions_of(self, failed: tuple[int, ...], remainder: float) -> Extensions:
        if (failed, remainder) not in self._extensions:
            surface = self.surface(failed)
            covariance = surface.covariance[:, None] + np.swapaxes(self._growth(surface), 0, 1)
            covariance += remainder * self._error[:, None]
            roots = np.linalg.cholesky(covariance)
            # Those of the intact surface serve all phases; each takes a few megabytes.
            self._extensions = {key: kept for key, kept in self._extensions.items() if not key[0]}
            self._extensions[failed, remainder] = Extensions(
                np.linalg.inv(roots), _log_determinant(roots).sum(axis=0))
        return self._extensions[failed, remainder]

    def _growth(self, surface: Surface, elements: slice = slice(None)) -> np.ndarray:
        """Change of a surface's covariance if an element fails, [N_E, N_B, S, S]."""
        shift, spread = self._shift[elements], self._spread[elements]
        power = np.diagonal(self._spatial, axis1=1, axis2=2).real.T[elements, :, None]
        cross = np.moveaxis(surface.scattered[..., elements], 2, 0) + power / 2 * shift
        # A product of two vectors plus its conjugate transpose, and one of the amplitudes.
        left = np.stack([shift, cross, power * spread], axis=-1)
        right = np.stack([cross, shift, spread], axis=-1)
        change: np.ndarray = np.matmul(left, np.conj(np.swapaxes(right, 2, 3)))
        change *= self._correlation
        return change


def _weigh(log_weight: np.ndarray | float, products: np.ndarray) -> Weighed:
    """Weigh hypotheses, from the log-probability without the energy, [H], and the columns.

    Takes the products [H, 4, 4] of the whitened columns.
    """
    energy = products[:, 0, 0]
    curvature = 2 * products[:, 1:, 1:] + np.diag(MIN_CURVATURE)
    gradient = 2 * products[:, 1:, 0]
    step = np.linalg.solve(curvature, gradient[..., None])[..., 0]
    step = np.clip(step, -_STEP_LIMITS, _STEP_LIMITS)
    gain = np.sum(gradient * step, axis=1) - likelihood_loss(step, curvature)
    return Weighed(log_weight - energy + gain, step, curvature, energy - gain)


def _log_determinant(roots: np.ndarray) -> np.ndarray:
    """Logarithm of the determinant from Cholesky factors [..., S, S]."""
    value: np.ndarray = 2 * np.log(np.diagonal(roots, axis1=-2, axis2=-1).real).sum(axis=-1)
    return value
