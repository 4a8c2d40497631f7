"""Steering: the beam with the highest capacity at a position, and the choice of its band."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.link.band_link import BandLink, band_index, representative_subbands
from rhs_isac_ros.link.candidates import candidate_configurations, tables
from rhs_isac_ros.link.capacity import Beamformer, actual_capacity, expected_capacities
from rhs_isac_ros.link.tuned import tuned_beam
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import checked_position
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.support.fields import whole
from rhs_isac_ros.support.threads import one_blas_thread

# Maximum number of rounds; usually two or three suffice.
_MAX_ROUNDS = 100
# Smallest relative increase of the capacity that justifies another round.
_MIN_GAIN = 1e-9


def ascend(link: BandLink, analog: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Improve configurations until no step increases their capacity.

    Each round finds the best digital part, and then a better configuration for it. The received
    power is convex in the configuration, so it is nowhere below its linear model at a point. With
    one sub-band, the vertex of the box [0, 1]^N_E in the direction of the gradient therefore never
    receives less power. With several, the vertex usually, but not always, increases the capacity.
    If it does not, the round moves a single element to an end of its range: the element that
    increases the capacity most. The capacity never falls below its value at the start.

    Takes links of several bands, and initial configurations `analog`, float64 [N_B, n, N_E], with
    entries in [0, 1]. Returns configurations of the same shape and range, and their capacities
    [nat/symbol] summed over the sub-bands, float64 [N_B, n].
    """
    # Power received from each element for unit radiation, float64 [N_B, 1, N_SB, N_E].
    spread = np.abs(link.los)**2 + link.spatial.power[:, None]
    spread = spread[:, None]
    point = _Point.at(link, spread, analog)
    # Whether the vertex has yet to be tried.
    is_new = np.ones(point.rate.shape, bool)
    for _ in range(_MAX_ROUNDS):
        to_vertex = is_new & (point.vertex != point.analog).any(axis=-1)
        by_element, gain = point.element_step()
        done = ~to_vertex & (gain <= _MIN_GAIN * point.rate)
        if done.all():
            break
        other = _Point.at(link, spread, np.where(
            done[..., None], point.analog,
            np.where(to_vertex[..., None], point.vertex, by_element)))
        is_new = other.rate - point.rate > _MIN_GAIN * point.rate
        # If the element does not increase the capacity after all, the ascent ends.
        if not (is_new | to_vertex).any():
            break
        point = other if (is_new | done).all() else other.where(is_new, point)
    return point.analog, point.rate


class _Point(NamedTuple):
    """Configurations, float64 [N_B, n, N_E], and the capacity with their best digital parts."""

    analog: np.ndarray
    rate: np.ndarray  # Capacities [nat/symbol], float64 [N_B, n].
    vertex: np.ndarray  # Vertex in the direction of the gradient, float64 [N_B, n, N_E].
    snr: np.ndarray  # Signal-to-noise ratios, float64 [N_B, n, N_SB].
    slope: np.ndarray  # Derivatives of the ratios, float64 [N_B, n, N_SB, N_E].
    curvature: np.ndarray  # Coefficients of an element's squared change, shaped like `slope`.

    @classmethod
    def at(cls, link: BandLink, spread: np.ndarray, analog: np.ndarray) -> '_Point':
        configured, scattered, direct = link.feeds(analog)
        gain, power, directions = link.eigenbeams(configured, scattered, direct)
        snr = gain * power
        digital = (directions * np.sqrt(power / link.noise_power_w)[..., None])[..., None, :]
        weights = np.matmul(digital, link.onboard[:, None])[..., 0, :]
        weights *= link.slope[:, None, None]
        received = np.conj(np.matmul(digital, direct)[..., 0])
        towards = received * link.los[:, None]
        towards += np.conj(np.matmul(digital, scattered)[..., 0, :])
        slope = 2 * (weights * towards).real
        curvature = (weights.real**2 + weights.imag**2) * spread
        ascending = np.sum(slope / (1 + snr)[..., None], axis=-2) > 0
        return cls(analog, np.log1p(snr).sum(axis=-1), ascending.astype(float), snr, slope,
                   curvature)

    def element_step(self) -> tuple[np.ndarray, np.ndarray]:
        """Return configurations after the best change of one element, and the rate gains [nat]."""
        # Axes: end, band, start, sub-band, element.
        steps = np.stack([-self.analog, 1 - self.analog])[:, :, :, None]
        # The power is quadratic in each element, so this is exact; only rounding can make it
        # negative.
        snr = self.snr[..., None] + steps * (self.slope + steps * self.curvature)
        low, high = np.log1p(np.maximum(snr, 0)).sum(axis=-2)
        rates = np.maximum(low, high)
        n_bands, n_starts, _ = rates.shape
        best = np.arange(n_bands)[:, None], np.arange(n_starts), rates.argmax(axis=-1)
        better = self.analog.copy()
        better[best] = high[best] > low[best]
        return better, rates[best] - self.rate

    def where(self, condition: np.ndarray, other: '_Point') -> '_Point':
        """Return these points where a condition, bool [N_B, n], holds, and `other` elsewhere."""
        return _Point(*(np.where(condition.reshape(*condition.shape, *[1] * (new.ndim - 2)),
                                 new, old) for new, old in zip(self, other, strict=True)))


# Number of ascents in each band.
_N_ASCENTS = 2
# Largest drift of phases from one sub-band of an ascent to the next, and largest number of these
# sub-bands.
_MAX_DRIFT_RAD = 0.05
_MAX_SUBBANDS = 64


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """A beam, and its capacity averaged over the posterior of the position [bit/s]."""

    beam: Beamformer
    expected_bps: float


@dataclasses.dataclass(frozen=True)
class CapacityReport:
    """Capacities of the beam in use and of the beam chosen with the true position [bit/s]."""

    actual_bps: float
    perfect_bps: float

    @property
    def loss_bps(self) -> float:
        """Capacity lost to the positioning error [bit/s]."""
        return self.perfect_bps - self.actual_bps

    @property
    def loss_percent(self) -> float:
        """The loss in per cent of `perfect_bps`; NaN if that is 0."""
        return 100 * self.loss_bps / self.perfect_bps if self.perfect_bps else math.nan


@one_blas_thread
def steer(scenario: Scenario, position: np.ndarray, band: int = 0,
          surface: SurfaceEstimate | None = None) -> Beamformer:
    """Find a beam that nearly maximises Eq. (10) for a user at a position, float64 [3] [m].

    A search from many starts, including the matched filter, proposes configurations. The best few
    are improved together with the digital part. Tunings are 0 or 1, which are valid for any
    number of levels. On a board whose coefficients are not affine in the tunings, the search is
    that of `tuned_beam`. The power over all sub-bands is P_max. The beam is deterministic.
    Bands are counted from 0. A calibrated surface applies its coefficients to the configuration.
    Raises ValueError if the position is not a finite [3] array, or the band is out of range.

    Examples
    --------
    >>> beam = steer(Scenario(), np.array([8.0, 1.0, 0.2]))
    >>> beam.analog.shape, beam.digital.shape
    ((100,), (8, 3))
    """
    return steer_bands(scenario, position, [band], surface)[0]


def steer_bands(
        scenario: Scenario, position: np.ndarray, bands: Sequence[int],
        surface: SurfaceEstimate | None = None) -> list[Beamformer]:
    """Find the beams of `steer` for several bands, in little more time than for one band.

    Raises ValueError as `steer` does, or if there are no bands.
    """
    if not len(bands):
        raise ValueError('bands: none, expected at least one')
    bands = [whole('band', band, high=scenario.n_bands - 1) for band in bands]
    if not scenario.board.is_affine:
        return [tuned_beam(scenario, position, band, surface) for band in bands]
    link = BandLink.to(scenario, position, bands, surface)
    starts = candidate_configurations(
        tables(scenario, surface), link, band_index(bands), _N_ASCENTS)
    subbands = representative_subbands(scenario, _MAX_DRIFT_RAD, _MAX_SUBBANDS)
    ends, rates = ascend(link.at_subbands(subbands), starts)
    best = ends[np.arange(len(ends)), rates.argmax(axis=1)]
    digital = link.best_digital(best[:, None])[:, 0]
    return [Beamformer(*parts) for parts in zip(best, digital, bands, strict=True)]


@one_blas_thread
def prepare_steering(scenario: Scenario, surface: SurfaceEstimate | None = None) -> None:
    """Compute the tables of a scenario and a surface before the first beam needs them."""
    choose_beam(scenario, np.array(scenario.roi_center_m), surface=surface)


def applied_beam(beam: Beamformer, surface: SurfaceEstimate | None) -> Beamformer:
    """Return a beam with the response of a calibrated surface, if any."""
    if surface is None:
        return beam
    return dataclasses.replace(
        beam, response=(surface.gains, surface.offsets, surface.band_gains[beam.band]))


@one_blas_thread
def choose_beam(
        scenario: Scenario, mean: np.ndarray, covariance: np.ndarray | None = None,
        bands: Sequence[int] | None = None, surface: SurfaceEstimate | None = None) -> Choice:
    """Steer a beam in each band to the mean position; choose the one of highest mean capacity.

    The posterior is Gaussian, with the mean, float64 [3] [m], and the covariance, float64 [3, 3]
    [m^2]; without a covariance, the position is exact. The capacity at the mean position alone
    would mislead: a stronger but narrower beam may lose more capacity to the positioning error
    than it gains. `bands` are counted from 0, by default all; in a tie, the first band is
    chosen. Raises ValueError if `mean` or `covariance` has a wrong shape or is not finite, there
    is no band, or a band is out of range.
    """
    mean = checked_position(mean, 'mean')
    covariance = np.zeros((3, 3)) if covariance is None else covariance
    bands = range(scenario.n_bands) if bands is None else bands
    beams = steer_bands(scenario, mean, bands, surface)
    expected = expected_capacities(
        scenario, [applied_beam(beam, surface) for beam in beams], mean, covariance)
    best = int(expected.argmax())
    return Choice(beams[best], float(expected[best]))


@one_blas_thread
def capacity_report(
        scenario: Scenario, beam: Beamformer, position: np.ndarray,
        bands: Sequence[int] | None = None,
        surface: SurfaceEstimate | None = None) -> CapacityReport:
    """Compare a beam with the beam that `choose_beam` finds for the true position.

    If the scenario has a channel file, both beams transmit over its paths, which `choose_beam`
    ignores. The search ends slightly below the maximum. The loss may therefore be negative;
    without a channel file, typically by less than a tenth of a per cent. `bands` and `surface` are
    passed to `choose_beam`. Raises ValueError if the position is not a finite [3] array, or the
    beam does not fit the scenario.
    """
    position = checked_position(position)

    def actual_bps(beam: Beamformer) -> float:
        return float(actual_capacity(scenario, applied_beam(beam, surface), position[None])[0])

    perfect = _perfect(scenario, tuple(position.tolist()),
                       None if bands is None else tuple(bands), surface)
    return CapacityReport(
        actual_bps(beam),
        actual_bps(perfect.beam) if scenario.channel else perfect.expected_bps)


# Users at rest have the same position in each cycle.
@functools.lru_cache(maxsize=64)
def _perfect(scenario: Scenario, position: tuple[float, ...], bands: tuple[int, ...] | None,
             surface: SurfaceEstimate | None) -> Choice:
    """Return the beam for a position that is known exactly."""
    return choose_beam(scenario, np.array(position), bands=bands, surface=surface)
