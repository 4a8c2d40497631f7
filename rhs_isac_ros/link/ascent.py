"""Ascent of the capacity from configurations to maxima nearby."""

import dataclasses

import numpy as np

from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.link.water_filling import water_filling

# Maximum number of rounds; two or three are usual.
_MAX_ROUNDS = 100
# Smallest relative gain of the capacity that justifies another round.
_MIN_GAIN = 1e-9


def ascend(link: BandLink, analog: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Increase the capacity of configurations until no step increases it.

    Each round finds the best digital part and then, with that part fixed, a better configuration.
    The received power is convex in the configuration, so that it lies above its linear model at
    any point. The corner of the box [0, 1]^N_E to which the gradient points therefore receives
    more power, unless the point is that corner. The capacity usually increases with the power,
    but not always, and is therefore compared. If the corner does not increase it, the round moves
    one element to an end of its range: the one that increases it most. The capacity never falls
    below that of the start.

    Parameters
    ----------
    link
        The links of several bands.
    analog
        Starts, float64 [N_B, n, N_E], each entry in [0, 1].

    Returns
    -------
    tuple of numpy.ndarray
        Configurations, float64 [N_B, n, N_E], each entry in [0, 1], and their capacities
        [nat/symbol] summed over the sub-bands, float64 [N_B, n].
    """
    # Power received from each element for unit radiation, float64 [N_B, 1, N_SB, N_E].
    spread = np.abs(link.los)**2 + link.spatial.power[:, None]
    spread = spread[:, None]
    point = _Point.at(link, spread, analog)
    # Whether the corner remains to be tried.
    is_new = np.ones(point.rate.shape, bool)
    for _ in range(_MAX_ROUNDS):
        to_corner = is_new & (point.corner != point.analog).any(axis=-1)
        by_element, gain = point.element_step(link)
        done = ~to_corner & (gain <= _MIN_GAIN * point.rate)
        if done.all():
            break
        other = _Point.at(link, spread, np.where(
            done[..., None], point.analog,
            np.where(to_corner[..., None], point.corner, by_element)))
        is_new = other.rate - point.rate > _MIN_GAIN * point.rate
        # An element that does not increase the capacity after all ends the ascent.
        if not (is_new | to_corner).any():
            break
        point = other if (is_new | done).all() else other.where(is_new, point)
    return point.analog, point.rate


@dataclasses.dataclass(frozen=True, eq=False)
class _Point:
    """Configurations, and the local behaviour of the capacity with their best digital parts.

    Attributes
    ----------
    analog
        Float64 [N_B, n, N_E].
    rate
        Capacities [nat/symbol], float64 [N_B, n].
    corner
        The corner that the gradient points to, float64 [N_B, n, N_E].
    snr
        Signal-to-noise ratios, float64 [N_B, n, N_SB].
    slope, curvature
        Derivative of the ratios with respect to each element, and the coefficient of the square
        of a change, float64 [N_B, n, N_SB, N_E].
    """

    analog: np.ndarray
    rate: np.ndarray
    corner: np.ndarray
    snr: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray

    @classmethod
    def at(cls, link: BandLink, spread: np.ndarray, analog: np.ndarray) -> '_Point':
        configured, scattered, direct = link.feeds(analog)
        gains, directions = np.linalg.eigh(link.correlations(configured, scattered, direct))
        # The configuration may pass no signal; only rounding makes the gain negative.
        gain = np.maximum(gains[..., -1], 0) / link.noise_power_w
        power = water_filling(gain, link.power_w)
        snr = gain * power
        amplitude = np.sqrt(power / link.noise_power_w)
        digital = (np.conj(directions[..., -1]) * amplitude[..., None])[..., None, :]
        weights = np.matmul(digital, link.onboard[:, None])[..., 0, :]
        received = np.conj(np.matmul(digital, direct)[..., 0])
        towards = received * link.los[:, None]
        towards += np.conj(np.matmul(digital, scattered)[..., 0, :])
        slope = 2 * (weights * towards).real
        curvature = (weights.real**2 + weights.imag**2) * spread
        ascending = np.sum(slope / (1 + snr)[..., None], axis=-2) > 0
        corner = np.where(link.fixed, 1.0, ascending)
        return cls(analog, np.log1p(snr).sum(axis=-1), corner, snr, slope, curvature)

    def element_step(self, link: BandLink) -> tuple[np.ndarray, np.ndarray]:
        """Return the best change of one element to an end of its range, and its gain [nat]."""
        # Axes: end, band, start, sub-band, element.
        steps = np.stack([-self.analog, 1 - self.analog])[:, :, :, None] * ~link.fixed
        # The power is quadratic in each element, so that this is exact; only rounding can make
        # it negative.
        snr = self.snr[..., None] + steps * (self.slope + steps * self.curvature)
        low, high = np.log1p(np.maximum(snr, 0)).sum(axis=-2)
        rates = np.maximum(low, high)
        n_bands, n_starts, _ = rates.shape
        place = np.arange(n_bands)[:, None], np.arange(n_starts), rates.argmax(axis=-1)
        better = self.analog.copy()
        better[place] = high[place] > low[place]
        gain: np.ndarray = rates[place] - self.rate
        return better, gain

    def where(self, condition: np.ndarray, other: '_Point') -> '_Point':
        """Return these points where a condition, bool [N_B, n], holds, and others elsewhere."""
        pairs = zip(self._fields(), other._fields(), strict=True)
        return _Point(*(np.where(condition.reshape(*condition.shape, *[1] * (new.ndim - 2)),
                                 new, old) for new, old in pairs))

    def _fields(self) -> list[np.ndarray]:
        return [self.analog, self.rate, self.corner, self.snr, self.slope, self.curvature]
