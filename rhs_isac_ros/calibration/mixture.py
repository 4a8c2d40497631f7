"""The posterior of elements that work or have failed, from a Gaussian likelihood.

Each element has a gain if it works, or an offset if it has failed; the other number is zero. Given
which elements have failed, the posterior is Gaussian. The search starts with the elements that are
taken to work, and changes the state of one element at a time while that increases the
evidence. The posterior that it returns averages over the states of every single element, given
those of the others; without data, this is the prior.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

# Smallest prior deviation of a coefficient, which keeps matrices regular.
_MIN_RMS = 1e-6
# Probability of the less likely state below which it is neglected.
_MIN_PROBABILITY = 1e-7


@dataclasses.dataclass(frozen=True)
class SurfacePrior:
    """What is known of a surface before the calibration.

    Attributes
    ----------
    element_error_rms
        RMS of the relative errors of the coefficients.
    failed_element_share
        Probability that an element has failed; from 0 to below 1.
    band_gain_rms
        RMS of the relative errors of the bands' gains.
    """

    element_error_rms: float
    failed_element_share: float
    band_gain_rms: float = 1.0

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, high in (('element_error_rms', 1.0), ('failed_element_share', 0.5),
                           ('band_gain_rms', 10.0)):
            value = getattr(self, name)
            if not 0 <= value <= high:
                raise ValueError(f'{name}: {value:g}, expected 0 to {high:g}')


class Posterior(NamedTuple):
    """Gaussian approximation of a posterior, over real and then imaginary parts.

    Attributes
    ----------
    mean, covariance
        Of the P = 2 N_E + N_B gains, offsets and band gains, float64 [2 P] and [2 P, 2 P].
    failed
        The most likely states, bool [N_E].
    failed_probability
        Float64 [N_E].
    """

    mean: np.ndarray
    covariance: np.ndarray
    failed: np.ndarray
    failed_probability: np.ndarray

    def complex_mean(self) -> np.ndarray:
        """Return the mean, complex128 [P]."""
        real, imag = np.split(self.mean, 2)
        mean: np.ndarray = real + 1j * imag
        return mean

    def complex_covariance(self) -> np.ndarray:
        """Return the covariance E[z z^H] of the errors z, complex128 [P, P]."""
        p = len(self.mean) // 2
        c = self.covariance
        covariance: np.ndarray = (
            c[:p, :p] + c[p:, p:] + 1j * (c[p:, :p] - c[:p, p:]))
        return covariance


def without_data(prior: SurfacePrior, band_rms: np.ndarray, n_elements: int) -> Posterior:
    """Return the prior, which `surface_posterior` also yields from no information."""
    n, size = n_elements, 2 * n_elements + band_rms.shape[1]
    share, variance = prior.failed_element_share, max(prior.element_error_rms, _MIN_RMS)**2 / 2
    mixing = share * (1 - share)
    mean, variances = np.zeros(2 * size), np.zeros(2 * size)
    mean[:n], mean[n:2 * n] = 1 - share, share / 2
    variances[:n] = (1 - share) * variance + mixing
    variances[n:2 * n] = share * (1 / 12 + variance / 3) + mixing / 4
    variances[size:size + n] = (1 - share) * variance
    variances[size + n:size + 2 * n] = share * variance / 3
    variances[2 * n:size], variances[size + 2 * n:] = np.maximum(band_rms, _MIN_RMS)**2
    covariance = np.diag(variances)
    gains = np.arange(n)
    covariance[gains, gains + n] = covariance[gains + n, gains] = -mixing / 2
    return Posterior(mean, covariance, np.zeros(n, bool), np.full(n, share))


def surface_posterior(information: np.ndarray, shift: np.ndarray, prior: SurfacePrior,
                      band_rms: np.ndarray, failed: np.ndarray) -> Posterior:
    """Compute the posterior of a surface.

    Parameters
    ----------
    information, shift
        The log-likelihood is ``-x^T information x / 2 + shift^T x``, float64 [2 P, 2 P] and
        [2 P], for real and then imaginary parts.
        The P parameters are gains and offsets of the elements, then errors of the bands' gains.
    band_rms
        RMS of real and imaginary parts of the latter before, float64 [2, N_B].
    failed
        States of the elements to start from, bool [N_E].
    """
    search = _Search(information, shift, prior, band_rms)
    state, log_odds = search.climb(failed.copy())
    other = 1 / (1 + np.exp(np.minimum(-log_odds, 700.0)))
    mean, covariance = search.moments(state)
    total_mean, total_covariance = mean.copy(), covariance.copy()
    for element in np.nonzero(other > _MIN_PROBABILITY)[0]:
        flipped = state.copy()
        flipped[element] ^= True
        other_mean, other_covariance = search.moments(flipped)
        difference, weight = other_mean - mean, other[element]
        total_mean += weight * difference
        total_covariance += weight * (
            other_covariance - covariance + (1 - weight) * np.outer(difference, difference))
    if other.sum() > 1:
        # The correction for each element assumes that the others do not change as well.
        values, vectors = np.linalg.eigh(total_covariance)
        total_covariance = vectors * np.maximum(values, 0.0) @ vectors.T
    return Posterior(total_mean, total_covariance, state, np.where(state, 1 - other, other))


class _Search:
    """Evidence of the states of all elements, and moments given the states."""

    def __init__(self, information: np.ndarray, shift: np.ndarray, prior: SurfacePrior,
                 band_rms: np.ndarray) -> None:
        self._size, n_bands = len(shift) // 2, band_rms.shape[1]
        self._n_elements = n = (self._size - n_bands) // 2
        self._n_bands = n_bands
        rms = max(prior.element_error_rms, _MIN_RMS)
        real, imag = np.empty(self._size), np.empty(self._size)
        real[:n] = imag[:n] = 2 / rms**2
        # The amplitude of a failed element is uniform in [0, 1]; its square averages to 1 / 3.
        real[n:2 * n], imag[n:2 * n] = 1 / (1 / 12 + rms**2 / 6), 6 / rms**2
        real[2 * n:], imag[2 * n:] = 1 / np.maximum(band_rms, _MIN_RMS)**2
        self._precision = np.concatenate([real, imag])
        self._mean = np.concatenate([np.ones(n), np.full(n, 0.5), np.zeros(n_bands + self._size)])
        self._information = information
        self._shift = shift + self._precision * self._mean
        share = np.clip(prior.failed_element_share, 1e-300, 1 - 1e-12)
        self._log_prior_odds = float(np.log(share) - np.log1p(-share))

    def _indices(self, failed: np.ndarray) -> np.ndarray:
        """Indices of the parameters that are not zero, [2 N_E + 2 N_B]."""
        n = self._n_elements
        chosen = np.concatenate(
            [np.arange(n) + n * failed, np.arange(2 * n, 2 * n + self._n_bands)])
        return np.concatenate([chosen, chosen + self._size])

    def _solve(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        precision = self._information[np.ix_(indices, indices)]
        precision = precision + np.diag(self._precision[indices])
        # Prior precisions differ by many orders of magnitude.
        scale = 1 / np.sqrt(np.diagonal(precision))
        covariance = np.linalg.inv(precision * scale[:, None] * scale) * scale[:, None] * scale
        return covariance @ self._shift[indices], (covariance + covariance.T) / 2

    def moments(self, failed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean [2 P] and covariance [2 P, 2 P] given the states."""
        indices = self._indices(failed)
        mean, covariance = np.zeros(2 * self._size), np.zeros((2 * self._size, 2 * self._size))
        mean[indices], covariance[np.ix_(indices, indices)] = self._solve(indices)
        return mean, covariance

    def climb(self, failed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flip states while that raises the evidence; also return the log odds of each flip."""
        log_odds = self._log_odds(failed)
        for _ in range(4 * self._n_elements):
            best = int(np.argmax(log_odds))
            if log_odds[best] <= 0:
                break
            failed[best] ^= True
            log_odds = self._log_odds(failed)
        return failed, log_odds

    def _log_odds(self, failed: np.ndarray) -> np.ndarray:
        """Log odds of the other state of each element, given the states of the others [N_E]."""
        active, inactive = self._indices(failed), self._indices(~failed)
        mean, covariance = self._solve(active)
        half = len(active) // 2
        coupling = self._information[np.ix_(active, inactive)]
        product = covariance @ coupling
        result = np.empty(self._n_elements)
        for m in range(self._n_elements):
            own = np.array([m, m + half])
            block = covariance[:, own]
            inverse = np.linalg.inv(block[own])
            # Marginal of the element given all others, as it is.
            present = self._log_evidence(active[own], inverse, inverse @ mean[own])
            # The same for the other state, after the element was removed from the others.
            column = coupling[:, own].copy()
            reduced = product[:, own] - block @ column[own]
            column[own] = 0.0
            without = mean - block @ self._shift[active[own]]
            removed = column.T @ block @ inverse
            schur = column.T @ reduced - removed @ (block.T @ column)
            moved = column.T @ without - removed @ without[own]
            x = inactive[own]
            curvature = np.diag(self._precision[x]) + self._information[np.ix_(x, x)] - schur
            absent = self._log_evidence(x, curvature, self._shift[x] - moved)
            prior = self._log_prior_odds if not failed[m] else -self._log_prior_odds
            result[m] = absent - present + prior
        return result

    def _log_evidence(
            self, indices: np.ndarray, curvature: np.ndarray, gradient: np.ndarray) -> float:
        """Log evidence of two parameters, relative to their absence."""
        precision, mean = self._precision[indices], self._mean[indices]
        determinant = curvature[0, 0] * curvature[1, 1] - curvature[0, 1] * curvature[1, 0]
        value = np.log(precision).sum() - np.log(determinant)
        value += gradient @ np.linalg.solve(curvature, gradient) - precision @ mean**2
        return float(value) / 2
