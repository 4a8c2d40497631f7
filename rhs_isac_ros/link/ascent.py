"""Ascent of the capacity from a configuration to a maximum nearby."""

import dataclasses

import numpy as np

from rhs_isac_ros.link.band_link import BandLink

# Maximum number of rounds; one or two are usual.
_MAX_ROUNDS = 50
# Smallest relative gain of the capacity that justifies another round.
_MIN_GAIN = 1e-9


def ascend(link: BandLink, analog: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Increase the capacity of a configuration, float64 [N_E], until no step increases it.

    Each round finds the best digital part and then, with that part fixed, a better configuration.
    The received power is convex in the configuration, so that it lies above its linear model at
    any point. The corner of the box [0, 1]^N_E to which the gradient points therefore receives
    more power, unless the point is that corner. The capacity usually increases with the power,
    but not always, and is therefore compared. If the corner does not increase it, the round moves
    one element to an end of its range: the one that increases it most. The capacity never falls
    below that of the start.

    Returns a configuration, float64 [N_E], each entry in [0, 1], and the best digital part for
    it, complex128 [N_SB, K] [sqrt(W)].
    """
    point = _Point.at(link, analog)
    for _ in range(_MAX_ROUNDS):
        better = point.corner_step()
        if better is None:
            better = point.element_step()
        if better is None:
            break
        point = _Point.at(link, better)
    return point.analog, point.digital


@dataclasses.dataclass(frozen=True, eq=False)
class _Point:
    """A configuration, the best digital part for it, and the local behaviour of the capacity.

    Attributes
    ----------
    weights
        Digital part times on-board propagation, over the noise amplitude, complex128
        [N_SB, N_E].
    los_weights
        `weights` times the line-of-sight gains, complex128 [N_SB, N_E].
    snr
        Signal-to-noise ratios, float64 [N_SB].
    snr_gradient
        Derivative of the ratios with respect to the configuration, float64 [N_SB, N_E].
    """

    link: BandLink
    analog: np.ndarray
    digital: np.ndarray
    weights: np.ndarray
    los_weights: np.ndarray
    snr: np.ndarray
    snr_gradient: np.ndarray

    @classmethod
    def at(cls, link: BandLink, analog: np.ndarray) -> '_Point':
        digital = link.best_digital(analog)
        weights = np.einsum('jk,jkm->jm', digital, link.onboard) / np.sqrt(link.noise_power_w)
        los_weights = weights * link.los
        direct, radiation = los_weights @ analog, weights * analog
        diffuse = np.conj(link.scatter(radiation))
        snr = np.abs(direct)**2 + np.sum(radiation * diffuse, axis=1).real
        gradient = 2 * (np.conj(direct)[:, None] * los_weights + weights * diffuse).real
        return cls(link, analog, digital, weights, los_weights, snr, gradient)

    def corner_step(self) -> np.ndarray | None:
        """Return the corner that the gradient points to.

        Return None if it does not increase the capacity.
        """
        corner: np.ndarray = (1 / (1 + self.snr) @ self.snr_gradient > 0).astype(float)
        corner[self.link.fixed] = 1.0
        direct, radiation = self.los_weights @ corner, self.weights * corner
        scattered = np.sum(self.link.scatter(radiation) * np.conj(radiation), axis=1).real
        return corner if self._gains(np.abs(direct)**2 + scattered) else None

    def element_step(self) -> np.ndarray | None:
        """Return the best change of one element to an end of its range.

        Return None if no change increases the capacity.
        """
        curvatures = np.abs(self.los_weights)**2
        curvatures += np.abs(self.weights)**2 * np.diag(self.link.spatial)
        steps = np.stack([-self.analog, 1 - self.analog])[:, None] * ~self.link.fixed
        # The power is quadratic in each element, so that this is exact; only rounding can make
        # it negative.
        snr = self.snr[:, None] + steps * self.snr_gradient + steps**2 * curvatures
        snr = np.maximum(snr, 0)
        end, element = np.unravel_index(
            np.log1p(snr).sum(axis=1).argmax(), (2, len(self.analog)))
        if not self._gains(snr[end, :, element]):
            return None
        better: np.ndarray = self.analog.copy()
        better[element] = end
        return better

    def _gains(self, snr: np.ndarray) -> bool:
        """Return whether the given signal-to-noise ratios yield a higher capacity."""
        rate = np.log1p(self.snr).sum()
        return bool(np.log1p(snr).sum() - rate > _MIN_GAIN * rate)
