"""The links between the surface and one position, and the division of power among channels."""

import abc
import dataclasses
import functools
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import checked_position, read_only
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.geometry import (
    element_positions,
    feed_positions,
    subband_frequencies_hz,
)
from rhs_isac_ros.model.los import los_waves
from rhs_isac_ros.model.multipath import SpatialCovariance, spatial_covariance
from rhs_isac_ros.model.surface import NOMINAL, onboard_matrix, ports_of

# Gains above this limit have finite reciprocals.
_MIN_GAIN = 1e-300
_LinkT = TypeVar('_LinkT', bound='Link')


def water_filling(gains: np.ndarray, power_w: float) -> np.ndarray:
    """Divide power [W] among channels so that the sum of log(1 + gain * share) is highest.

    The gains are relative to noise, float64 [..., N] [1/W]; each row is a separate problem. The
    shares, float64 [..., N] [W], are not negative and add up to `power_w` in each row. If no gain
    in a row is positive, its shares are equal.
    """
    n = gains.shape[-1]
    if n == 1:
        return np.full(gains.shape, power_w)
    if gains.min() > _MIN_GAIN:
        floors = 1 / gains
        level = (power_w + floors.sum(axis=-1, keepdims=True)) / n
        if (level > floors).all():
            # The level is above every floor, as usual.
            return level - floors
    # If no gain is positive, all levels and floors are infinite.
    with np.errstate(divide='ignore', over='ignore', invalid='ignore'):
        floors = 1 / np.maximum(gains, 0)
        ranked = np.sort(floors, axis=-1)
        levels = (power_w + np.cumsum(ranked, axis=-1)) / np.arange(1, n + 1)
        # The channels that receive power are the first ones in the order of the floors.
        n_filled = np.sum(levels > ranked, axis=-1, keepdims=True)
        level = np.take_along_axis(levels, np.maximum(n_filled - 1, 0), axis=-1)
        shares = np.maximum(level - floors, 0.0)
    if n_filled.all():
        return shares
    # The gains are so small that the power is lost in the rounding of the level.
    best = power_w * (np.arange(n) == np.argmax(gains, axis=-1)[..., None])
    even = np.broadcast_to(power_w / n, gains.shape)
    lost = np.where(gains.max(axis=-1, keepdims=True) > 0, best, even)
    return np.where(n_filled > 0, shares, lost)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Link(abc.ABC):
    """The links between the surface and a user in the n_b bands of a choice.

    Methods take configurations, float64 [n_b, n, N_E], or [N_E] for one in all bands, with n = 1.
    A subclass defines `channels`, and the links `at_subbands`.
    """

    los: np.ndarray  #: Line-of-sight gains, complex128 [n_b, N_SB, N_E].
    spatial: SpatialCovariance  #: V_i.
    noise_power_w: float  #: Noise power of a sub-band [W].
    power_w: float  #: Power of the digital part, summed over sub-bands [W].

    @abc.abstractmethod
    def channels(self, analog: np.ndarray) -> np.ndarray:
        """Return the transfer of configurations, complex128 [n_b, n, N_SB, K, N_E]."""

    def at_subbands(self: _LinkT, subbands: np.ndarray) -> _LinkT:
        """Return the links in a subset of the sub-bands, with their share of the power."""
        share = len(subbands) / self.los.shape[-2]
        return dataclasses.replace(
            self, los=self.los[..., subbands, :], power_w=self.power_w * share)

    def best_digital(self, analog: np.ndarray) -> np.ndarray:
        """Return the best digital parts of configurations, complex128 [n_b, n, N_SB, K] [sqrt(W)].

        In each sub-band, it is a multiple of the conjugate of the principal eigenvector of the
        channels' correlation matrix at the feeds. Water-filling divides the power.
        """
        _, power, directions = self.eigenbeams(*self.feeds(analog))
        return directions * np.sqrt(power)[..., None]

    def best_rate(self, analog: np.ndarray) -> np.ndarray:
        """Return the capacity with the best digital part, summed over sub-bands [nat/symbol]."""
        gains, power, _ = self.eigenbeams(*self.feeds(analog))
        return np.log1p(gains * power).sum(axis=-1)

    def feeds(self, analog: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the `channels` between the feeds and the air for configurations.

        Also returns their product with V_i, complex128 [n_b, n, N_SB, K, N_E], and that with the
        line-of-sight gains, complex128 [n_b, n, N_SB, K, 1].
        """
        configured = self.channels(analog)
        direct = np.matmul(configured, self.los[:, None, ..., None])
        return configured, self.spatial.scatter(configured), direct

    def eigenbeams(self, configured: np.ndarray, scattered: np.ndarray, direct: np.ndarray
                   ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the best beam in each sub-band, for the channels of `feeds`.

        The results are its gain relative to noise [1/W] and its power [W], float64 [n_b, n, N_SB],
        and its direction, complex128 [n_b, n, N_SB, K].
        """
        gains, directions = np.linalg.eigh(
            direct * np.conj(np.swapaxes(direct, -1, -2))
            + np.matmul(scattered, np.conj(np.swapaxes(configured, -1, -2))))
        # A configuration may block all signals; only rounding makes the gain negative.
        gain = np.maximum(gains[..., -1], 0) / self.noise_power_w
        # s is a row: s M s^H is largest along the conjugate of the eigenvector.
        return gain, water_filling(gain, self.power_w), np.conj(directions[..., -1])


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class BandLink(Link):
    """Links of a board whose coefficients are affine in the configuration."""

    onboard: np.ndarray  #: B_j with the gain of the band, complex128 [n_b, N_SB, K, N_E].
    slope: np.ndarray  #: Slopes of the coefficients in the configuration, [n_b, N_E].
    offset: np.ndarray  #: Coefficients for the configuration 0, [n_b, N_E].

    @classmethod
    def to(cls, scenario: Scenario, position: np.ndarray, bands: Sequence[int],
           surface: SurfaceEstimate | None = None) -> 'BandLink':
        """Return the links to a position, float64 [3] [m], in the given bands, counted from 0.

        Raises ValueError if the position is not a finite [3] array.
        """
        onboard, slope, offset = arrays(scenario, surface)
        place, index = checked_position(position)[None], band_index(bands)
        waves, _, _ = los_waves(scenario, place, bands, slopes=False)
        los = waves[:, :, 0] / subband_frequencies_hz(scenario)[index, :, None]
        return cls(onboard=onboard[index], los=los, spatial=spatial_covariance(scenario)[index],
                   noise_power_w=scenario.noise_power_w, power_w=scenario.max_power_w,
                   slope=slope[index], offset=offset[index])

    def channels(self, analog: np.ndarray) -> np.ndarray:
        """Return B_j times the coefficients; see `Link.channels`."""
        coefficients = self.slope[:, None] * analog + self.offset[:, None]
        return self.onboard[:, None] * coefficients[..., None, None, :]

    def at_subbands(self, subbands: np.ndarray) -> 'BandLink':
        """Return the links in a subset of the sub-bands; see `Link.at_subbands`."""
        return dataclasses.replace(
            super().at_subbands(subbands), onboard=self.onboard[..., subbands, :, :])


def band_index(bands: Sequence[int]) -> slice | list[int]:
    """Return an array index that selects bands; if possible a slice, which avoids a copy."""
    first, n = bands[0], len(bands)
    return slice(first, first + n) if list(bands) == list(range(first, first + n)) else list(bands)


@functools.lru_cache(maxsize=16)
def arrays(scenario: Scenario, surface: SurfaceEstimate | None
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `onboard`, `slope` and `offset` of the links in all bands, read-only."""
    slope, offset, gains = surface.response if surface else NOMINAL
    ends = np.zeros((scenario.n_bands, 2, scenario.n_elements))
    ends[:, 1] = 1.0
    low, high = np.moveaxis(scenario.board.coefficients(ports_of(scenario), ends)[:, 0], 1, 0)
    off = slope * low + offset + np.zeros_like(high)
    return (read_only(np.reshape(gains, (-1, 1, 1, 1)) * onboard_matrix(scenario)),
            read_only(slope * (high - low)), read_only(off))


@functools.lru_cache(maxsize=16)
def representative_subbands(
        scenario: Scenario, max_drift_rad: float, max_count: int) -> np.ndarray:
    """Return indices of evenly spread sub-bands, at most `max_count`.

    Unless `max_count` is too small for this, the phases of the elements drift apart by at most
    `max_drift_rad` from one of these sub-bands to the next.
    """
    elements, feeds = element_positions(scenario), feed_positions(scenario)
    on_board = np.linalg.norm(elements - feeds[:, None], axis=-1)
    across = np.linalg.norm(np.ptp(elements, axis=0))
    span_m = scenario.refractive_index * np.ptp(on_board) + across
    span_hz = (scenario.n_subbands - 1) * scenario.spacing_hz
    drift = 2 * np.pi * span_hz / SPEED_OF_LIGHT_MPS * span_m
    n = int(min(scenario.n_subbands, 1 + drift // max_drift_rad, max_count))
    return ((np.arange(n) + 0.5) * scenario.n_subbands / n).astype(int)
