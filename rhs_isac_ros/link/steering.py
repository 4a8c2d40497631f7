"""Steering: the beam of the highest capacity at a position, and the choice of its band."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.link.ascent import ascend
from rhs_isac_ros.link.band_link import BandLink, band_index, representative_subbands
from rhs_isac_ros.link.capacity import Beam, actual_capacity, expected_capacities
from rhs_isac_ros.link.search import candidate_configurations, tables
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface_estimate import SurfaceEstimate
from rhs_isac_ros.model.threads import one_blas_thread

# Number of ascents in each band.
_N_ASCENTS = 2
# An ascent ignores drifts of the phases between sub-bands below this, unless that takes more
# sub-bands than the limit.
_MAX_DRIFT_RAD = 0.05
_MAX_SUBBANDS = 64


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """A beam, and its capacity averaged over the posterior of the position [bit/s]."""

    beam: Beam
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
          surface: SurfaceEstimate | None = None) -> Beam:
    """Find a beam that maximises Eq. (10) for a user at a position, float64 [3] [m].

    A search from many starts and the matched filter proposes configurations. The best few of them
    are then improved together with the digital part. Amplitudes of the beam are 0 or 1, which
    every number of amplitude levels includes. It has the power P_max over all sub-bands. The same
    position always gives the same beam. Bands are counted from 0. A calibrated surface applies
    its own coefficients to the configuration of the beam.

    Raises
    ------
    ValueError
        If the position is not a finite [3] array, or the band is out of range.
    """
    return steer_bands(scenario, position, [band], surface)[0]


def steer_bands(
        scenario: Scenario, position: np.ndarray, bands: Sequence[int],
        surface: SurfaceEstimate | None = None) -> list[Beam]:
    """Find the beam of `steer` for each of some bands, all of them together; errors are the same.

    This takes hardly longer than a single band.
    """
    if not len(bands):
        raise ValueError('bands: none, expected at least one')
    for band in bands:
        if not 0 <= band < scenario.n_bands:
            raise ValueError(f'band: {band}, expected 0 to {scenario.n_bands - 1}')
    link = BandLink.to(scenario, position, bands, surface)
    starts = candidate_configurations(
        tables(scenario, surface), link, band_index(bands), _N_ASCENTS)
    subbands = representative_subbands(scenario, _MAX_DRIFT_RAD, _MAX_SUBBANDS)
    ends, rates = ascend(link.at_subbands(subbands), starts)
    best = ends[np.arange(len(ends)), rates.argmax(axis=1)]
    digital = link.best_digital(best[:, None])[:, 0]
    return [Beam(*parts) for parts in zip(best, digital, bands, strict=True)]


@one_blas_thread
def prepare_steering(scenario: Scenario, surface: SurfaceEstimate | None = None) -> None:
    """Compute the tables of a scenario and surface, for which the first beam would have to wait.

    They are kept for the most recent 16 scenarios and surfaces.
    """
    choose_beam(scenario, np.array(scenario.roi_center_m), surface=surface)


def applied_beam(beam: Beam, surface: SurfaceEstimate | None) -> Beam:
    """Return a beam with the coefficients and the gain that a calibrated surface applies."""
    if surface is None:
        return beam
    return Beam(surface.applied(beam.analog), surface.band_gains[beam.band] * beam.digital,
                beam.band)


@one_blas_thread
def choose_beam(
        scenario: Scenario, mean: np.ndarray, covariance: np.ndarray | None = None,
        bands: Sequence[int] | None = None, surface: SurfaceEstimate | None = None) -> Choice:
    """Steer a beam of each band to the mean position and choose that of highest mean capacity.

    The capacity at the mean alone would mislead: a band with a stronger but narrower beam may
    lose more capacity to the positioning error than its strength adds. If several are equal, the
    first is chosen.

    Parameters
    ----------
    mean
        Float64 [3] [m].
    covariance
        Float64 [3, 3] [m^2]; None if the position is known exactly.
    bands
        Bands to choose from, counted from 0; None for all.
    surface
        A calibrated surface; by default that of the scenario.

    Raises
    ------
    ValueError
        If `mean` or `covariance` has a wrong shape or is not finite, there is no band, or a band
        is out of range.
    """
    covariance = np.zeros((3, 3)) if covariance is None else covariance
    bands = range(scenario.n_bands) if bands is None else bands
    beams = steer_bands(scenario, mean, bands, surface)
    expected = expected_capacities(
        scenario, [applied_beam(beam, surface) for beam in beams], mean, covariance)
    best = int(expected.argmax())
    return Choice(beams[best], float(expected[best]))


@one_blas_thread
def capacity_report(
        scenario: Scenario, beam: Beam, position: np.ndarray,
        bands: Sequence[int] | None = None,
        surface: SurfaceEstimate | None = None) -> CapacityReport:
    """Compare a beam with the one chosen with the true position, float64 [3] [m].

    Both transmit over the paths of a channel file, if the scenario has one. The latter is chosen
    from `bands` for `surface`, as in `choose_beam`. The search for a beam ends slightly below the
    maximum, so that the loss with an accurate estimate may be negative, typically by less than a
    tenth of a per cent.

    Raises
    ------
    ValueError
        If the position is not a finite [3] array, or the beam does not fit the scenario.
    """
    perfect = choose_beam(scenario, position, bands=bands, surface=surface)
    used, place = applied_beam(beam, surface), np.asarray(position, dtype=float)
    perfect_bps = perfect.expected_bps
    if scenario.channel:
        best = applied_beam(perfect.beam, surface)
        perfect_bps = float(actual_capacity(scenario, best, place[None])[0])
    return CapacityReport(float(actual_capacity(scenario, used, place[None])[0]), perfect_bps)
