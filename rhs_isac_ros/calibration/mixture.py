"""The posterior of elements that work or have failed, from a Gaussian likelihood.

A working element has a gain and no offset, a failed one an offset and no gain. Given the states of
all elements, the posterior is Gaussian. The search changes the state of one element at a time
until no change increases the evidence. The final posterior averages over both states of each
element, given the states of all other elements. Without data, the posterior is the prior.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.gaussian import step_to_maximum

# Smallest prior standard deviation of a coefficient; it keeps matrices invertible.
_MIN_RMS = 1e-6
# Probability below which the less likely state of an element is neglected.
_MIN_PROBABILITY = 1e-7


@dataclasses.dataclass(frozen=True)
class SurfacePrior:
    """Knowledge of a surface before the calibration.

    The fields are the RMS of the relative errors of the coefficients, the probability that an
    element has failed, and the RMS of the relative errors of the bands' gains.
    """

    element_error_rms: float
    failed_element_share: float
    band_gain_rms: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError if a field is out of range."""
        for name, high in (('element_error_rms', 1.0), ('failed_element_share', 0.5),
                           ('band_gain_rms', 10.0)):
            value = getattr(self, name)
            if not 0 <= value <= high:
                raise ValueError(f'{name}: {value:g}, expected 0 to {high:g}')


class SurfacePosterior(NamedTuple):
    """Gaussian approximation of the posterior of P = 2 N_E + N_B complex parameters."""

    # Mean of gains, offsets and errors of band gains, complex128 [P], and covariance E[z z^H] of
    # their errors z, complex128 [P, P].
    mean: np.ndarray
    covariance: np.ndarray
    # Whether each element has probably failed, bool [N_E], and with what probability, [N_E].
    failed: np.ndarray
    failed_probability: np.ndarray


def without_data(prior: SurfacePrior, band_rms: np.ndarray, n_elements: int) -> SurfacePosterior:
    """Return the prior: the result of `surface_posterior` without information."""
    n, n_bands = n_elements, band_rms.shape[1]
    size = 2 + n_bands
    one = surface_posterior(np.zeros((2 * size, 2 * size)), np.zeros(2 * size), prior, band_rms,
                            np.zeros(1, bool))
    # All elements have the distribution of this one, and they are independent.
    like = np.repeat(np.arange(size), [n, n, *[1] * n_bands])
    owner = np.array([*range(n), *range(n), *[n] * n_bands])
    covariance = one.covariance[np.ix_(like, like)] * (owner[:, None] == owner)
    return SurfacePosterior(one.mean[like], covariance, np.repeat(one.failed, n),
                     np.repeat(one.failed_probability, n))


def surface_posterior(information: np.ndarray, shift: np.ndarray, prior: SurfacePrior,
                      band_rms: np.ndarray, failed: np.ndarray) -> SurfacePosterior:
    """Compute the posterior of a surface; the search starts from the states `failed` [N_E].

    The P parameters are gains and offsets of the elements, then errors of the bands' gains. The
    real and imaginary parts of the latter have the prior RMS `band_rms`, float64 [2, N_B]. The
    log-likelihood is ``-x^T information x / 2 + shift^T x``, where x lists the real and then the
    imaginary parts.
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
            other_covariance - covariance
            + (1 - weight) * np.outer(difference, np.conj(difference)))
    return SurfacePosterior(total_mean, total_covariance, state, np.where(state, 1 - other, other))


class _Search:
    """Search for the likeliest states of all elements; moments given the states."""

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
        """Return the indices of the parameters that are not zero, [2 N_E + 2 N_B]."""
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
        """Return the posterior mean [P] and covariance [P, P] given the states, complex128."""
        indices = self._indices(failed)
        means, parts = self._solve(indices)
        chosen, _ = np.split(indices, 2)
        (rr, ri), (ir, ii) = parts.reshape(2, len(chosen), 2, -1).swapaxes(1, 2)
        mean, covariance = np.zeros(self._size, complex), np.zeros([self._size] * 2, complex)
        mean[chosen] = [1, 1j] @ means.reshape(2, -1)
        covariance[np.ix_(chosen, chosen)] = rr + ii + 1j * (ir - ri)
        return mean, covariance

    def climb(self, failed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flip states while the evidence grows; return states and log odds of further flips."""
        log_odds = self._log_odds(failed)
        for _ in range(4 * self._n_elements):
            best = int(np.argmax(log_odds))
            if log_odds[best] <= 0:
                break
            failed[best] ^= True
            log_odds = self._log_odds(failed)
        return failed, log_odds

    def _log_odds(self, failed: np.ndarray) -> np.ndarray:
        """Return the log odds [N_E] of each element's other state, given all other states."""
        active, inactive = self._indices(failed), self._indices(~failed)
        mean, covariance = self._solve(active)
        # Real and imaginary part of each element [N_E, 2].
        own = np.arange(self._n_elements)[:, None] + [0, len(active) // 2]
        pairs = own[:, :, None], own[:, None]
        # Information about each element in its state, with all other elements eliminated ...
        curvature = np.linalg.inv(covariance[pairs])
        gradient = np.einsum('mxy,my->mx', curvature, mean[own])
        # ... and in its other state. The elimination of all parameters in `active` includes the
        # element itself, so the part that the element explains is added back.
        coupling = self._information[np.ix_(active, inactive)]
        product = covariance @ coupling
        explained, columns = product[pairs], coupling[:, own]
        x = inactive[own]
        other_curvature = (
            self._information[x[:, :, None], x[:, None]] + self._precision[x, None] * np.eye(2)
            - np.einsum('imx,imy->mxy', columns, product[:, own])
            + np.swapaxes(explained, 1, 2) @ curvature @ explained)
        other_gradient = (self._shift[x] - np.einsum('imx,i->mx', columns, mean)
                          + np.einsum('myx,my->mx', explained, gradient))
        odds = np.where(failed, -self._log_prior_odds, self._log_prior_odds)
        odds += self._log_evidence(x, other_curvature, other_gradient)
        odds -= self._log_evidence(active[own], curvature, gradient)
        return odds

    def _log_evidence(
            self, indices: np.ndarray, curvature: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the log evidence [N_E] of two parameters per element, relative to having none."""
        precision, mean = self._precision[indices], self._mean[indices]
        best = step_to_maximum(curvature, gradient)
        exponents = np.log(precision) + gradient * best - precision * mean**2
        evidence = exponents.sum(axis=1) - np.linalg.slogdet(curvature)[1]
        return evidence / 2
