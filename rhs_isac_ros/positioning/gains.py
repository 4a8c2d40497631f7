"""Likelihoods of places as functions of an unknown gain.

A gain multiplies the direct path and the multipath, but not the thermal noise. Where noise is a
part of the signals, the likelihood is thus no simple function of the gain: at low gains, noise
hides the signals, and any lower gain is as likely.
"""

import numpy as np

from rhs_isac_ros.model import gaussian

# Limits of shares of noise, and step of their log odds between groups.
_SHARES, _SHARE_STEP = (1e-9, 1 - 1e-9), 0.25
# Largest gain, in standard deviations; distance of gains to start from [nepers], which is also the
# largest step, and number of steps from the best of them.
_REACH, _STEP, _STEPS = 5.0, 0.5, 5


class GainLikelihoods:
    """The likelihoods of one shot for means with uniform phases of the bands.

    Takes the signals, complex128 [N_B, n], and the means at a distance of 1 m of P places for T
    ranges of their wavefront, complex [N_B, T, P, n]. Both are whitened for a gain of 0. `noise`,
    float64 [N_B n], is the share of thermal noise in the signals. `std` is the standard deviation
    of the gain [nepers], and `least_information` that of `NuisancePrior` about it.
    """

    def __init__(self, whitened: np.ndarray, means: np.ndarray, noise: np.ndarray, std: float,
                 least_information: float) -> None:
        # Measurements of similar shares of noise count together.
        shares = np.clip(noise, *_SHARES)
        odds, group = np.unique(
            np.round(np.log(shares / (1 - shares)) / _SHARE_STEP), return_inverse=True)
        member = np.eye(len(odds))[group.reshape(whitened.shape)]
        self._noise = 1 / (1 + np.exp(-_SHARE_STEP * odds))
        self._sizes = member.sum(axis=(0, 1))
        self._powers = np.einsum('bn,bnk->k', np.abs(whitened)**2, member)
        # Outputs of matched filters, [T, P, N_B, K], and energies of means, [T, P, K].
        self._outputs = np.moveaxis(
            (means.conj() * whitened[:, None, None]) @ member[:, None], 0, 2)
        self._energies = (np.abs(means)**2 @ member[:, None]).sum(axis=0)
        self._precision, self._reach = std**-2, _REACH * std
        self._least = least_information

    def starts(self, amplitudes: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the best gains of a coarse grid at R ranges, and log-likelihoods, [R, P] each.

        At a range, the means are those of the `nodes`, int [R], times `amplitudes`, float64 [R].
        """
        # From the gain of the weakest visible mean to that of one with all of the energy.
        energies = self._energies.sum(axis=2)
        low, high = np.clip(np.log([
            self._noise.min() / (energies.max() * amplitudes.max()**2),
            4 * self._powers.sum() / (energies.min() * amplitudes.min()**2)
            ]) / 2, -self._reach, self._reach)
        gains = np.linspace(low, high, 2 + int((high - low) / _STEP))
        weights = 1 / (self._noise + (1 - self._noise) * np.exp(2 * gains)[:, None])
        factors = np.exp(gains) * amplitudes[:, None, None]
        values = factors * (
            2 * np.abs(self._outputs @ weights.T).sum(axis=2)[nodes]
            - factors * (self._energies @ weights.T)[nodes]) + (
                np.log(weights) @ self._sizes - weights @ self._powers
                - self._precision * gains**2 / 2)
        return gains[values.argmax(axis=2)], values.max(axis=2)

    def log_integrals(self, nodes: np.ndarray, places: np.ndarray, amplitudes: np.ndarray,
                      gains: np.ndarray) -> np.ndarray:
        """Integrate over the gain around its best value, from starts [M], float64 [M].

        The logarithms of Laplace's integrals lack a constant.
        """
        outputs, energies = self._outputs[nodes, places], self._energies[nodes, places]
        for step in range(_STEPS + 1):
            variance = self._noise + (1 - self._noise) * np.exp(2 * gains)[:, None]
            scattered, factors = 1 - self._noise / variance, amplitudes * np.exp(gains)
            filtered, energy = outputs / variance[:, None], energies / variance
            by_band = filtered.sum(axis=2)
            sizes = np.abs(by_band)
            information = np.maximum(self._least, self._precision + 4 * (
                scattered**2 @ self._sizes) + 2 * factors**2 * energy.sum(axis=1))
            if step == _STEPS:
                break
            change = np.sum((1 - 2 * scattered)[:, None] * filtered, axis=2)
            slopes = np.real(by_band.conj() * change) / np.maximum(sizes, np.finfo(float).tiny)
            gradient = 2 * (
                factors * slopes.sum(axis=1)
                - factors**2 * np.sum((1 - scattered) * energy, axis=1)
                + np.sum(scattered * (self._powers / variance - self._sizes), axis=1)
                ) - self._precision * gains
            gains = gains + np.clip(gradient / information, -_STEP, _STEP)
        found: np.ndarray = (
            gaussian.log_bessel(2 * factors[:, None] * sizes).sum(axis=1)
            - factors**2 * energy.sum(axis=1) - np.sum(self._powers / variance, axis=1)
            - np.log(variance) @ self._sizes - self._precision * gains**2 / 2
            - np.log(information) / 2)
        return found
