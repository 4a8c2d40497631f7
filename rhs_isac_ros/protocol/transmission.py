"""The transmission: steers a beam to the estimated position and reports what it carries."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rhs_isac_ros.link import Beam, Outcome, RunningQuartiles, capacity, choose_beam, outcome
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.codebook_cache import CodebookCache
from rhs_isac_ros.protocol.events import Action, CodebookOffered, Event, Send, SettingsOffered
from rhs_isac_ros.protocol.pending_settings import PendingSettings
from rhs_isac_ros.protocol.role import PlainRole
from rhs_isac_ros.protocol.settings import TransmissionSettings

# Figures of a report that statistics are kept of; `CapacityStatistics` has the same names.
_FIGURES = ('expected_bps', 'actual_bps', 'perfect_bps', 'loss_bps', 'loss_percent')
# Cycles whose reports may still come.
_MOST_OPEN = 8


class _Steered(NamedTuple):
    """The beam of a cycle, its capacity at the estimate, and the bands to choose from."""

    beam: m.Beam
    at_estimate_bps: float
    bands: Sequence[int]


class Transmission(PlainRole):
    """The role that steers the beam.

    The true position only enters the reported capacities, never the beam.

    Parameters
    ----------
    scenario
        The scenario.
    settings
        The band, until another one is offered; by default in each cycle the best.
    """

    SENDS = (m.Beam, m.Capacity, m.CapacityStatistics)
    RECEIVES = (m.PositionEstimate, m.RhsConfiguration, m.GroundTruth)

    def __init__(self, scenario: Scenario, settings: TransmissionSettings | None = None) -> None:
        super().__init__()
        self._scenario = scenario
        self._settings = PendingSettings(settings or TransmissionSettings())
        self._codebooks: CodebookCache[None] = CodebookCache()
        # By cycle: the estimate, the beam, the true position, and whether its report is in the
        # statistics already.
        self._estimates: dict[int, m.PositionEstimate] = {}
        self._beams: dict[int, _Steered] = {}
        self._truths: dict[int, m.GroundTruth] = {}
        self._counted: dict[int, bool] = {}
        self._quartiles = RunningQuartiles(len(_FIGURES))

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take a codebook, settings, an estimate, a reported configuration or a true position.

        Parameters
        ----------
        event
            The event.
        now_s
            The time [s].

        Returns
        -------
        list of Action
            The beam, or the capacity and what has become of the statistics.
        """
        match event:
            case CodebookOffered(codebook):
                self._codebooks.put(codebook.id, None)
            case SettingsOffered(settings):
                # What belongs to a cycle that has a beam stays with its bands.
                self._settings.newest = settings
                return self._settings.apply()
            case m.GroundTruth() if event.cycle_id:
                _put(self._truths, event.cycle_id, event)
            case m.PositionEstimate() if event.codebook_id not in self._codebooks:
                self.counters['wrong_codebook'] += 1
            case m.PositionEstimate():
                return self._steer(event)
            case m.RhsConfiguration(mode=m.Mode.TRANSMISSION):
                return self._report(event)
        return []

    def status(self) -> Mapping[str, str]:
        """Return the settings and the codebook in use.

        Returns
        -------
        Mapping
            Values by name.
        """
        return self._settings.describe() | {'codebook_id': self._codebooks.in_use}

    def _bands(self, cycle_id: int) -> Sequence[int]:
        """Bands that a cycle may use: the same for all that is asked of it."""
        if cycle_id in self._beams:
            return self._beams[cycle_id].bands
        band = self._settings.in_use.band
        return range(self._scenario.n_bands) if band < 0 else (band,)

    def _steer(self, estimate: m.PositionEstimate) -> list[Action]:
        known = self._estimates.get(estimate.cycle_id)
        if known and m.same(known, estimate):
            self.counters['duplicate'] += 1
            return [Send(self._beams[estimate.cycle_id].beam)]
        self._codebooks.take(estimate.codebook_id)
        bands = self._bands(estimate.cycle_id)
        choice = choose_beam(self._scenario, estimate.position, estimate.covariance_m2, bands)
        beam = choice.beam
        sent = m.Beam(
            cycle_id=estimate.cycle_id, user=estimate.user, codebook_id=estimate.codebook_id,
            band=beam.band, analog=beam.analog, digital=beam.digital,
            expected_bps=choice.expected_bps)
        at_estimate_bps = float(capacity(self._scenario, beam, estimate.position[None])[0])
        _put(self._estimates, estimate.cycle_id, estimate)
        _put(self._beams, estimate.cycle_id, _Steered(sent, at_estimate_bps, bands))
        return [Send(sent)]

    def _report(self, applied: m.RhsConfiguration) -> list[Action]:
        beam, at_estimate_bps, bands = self._beams.get(applied.cycle_id, (None, math.nan, ()))
        truth = self._truths.get(applied.cycle_id)
        for wrong, found in (('wrong_cycle', beam is None),
                             ('wrong_codebook', beam and applied.codebook_id != beam.codebook_id),
                             ('wrong_band', beam and applied.band != beam.band)):
            if found:
                self.counters[wrong] += 1
                return []
        result = Outcome(math.nan, math.nan)
        if truth and truth.user == beam.user:
            used = Beam(applied.analog[0], beam.digital, beam.band)
            result = outcome(self._scenario, used, truth.position, bands)
        report = m.Capacity(
            cycle_id=beam.cycle_id, user=beam.user, codebook_id=beam.codebook_id, band=beam.band,
            expected_bps=beam.expected_bps, actual_bps=result.actual_bps,
            perfect_bps=result.perfect_bps, loss_bps=result.loss_bps,
            loss_percent=result.loss_percent, at_estimate_bps=at_estimate_bps)
        return [Send(report), *self._summarise(report)]

    def _summarise(self, report: m.Capacity) -> list[Action]:
        """Bring the statistics up to date, once for each cycle."""
        if not math.isfinite(report.loss_percent) or report.cycle_id in self._counted:
            return []
        _put(self._counted, report.cycle_id, True)
        self._quartiles.add([getattr(report, name) for name in _FIGURES])
        figures = dict(zip(_FIGURES, self._quartiles.quartiles(), strict=True))
        return [Send(m.CapacityStatistics(
            cycle_id=report.cycle_id, n_reports=len(self._quartiles), **figures))]


def _put(items: dict, cycle_id: int, item: Any) -> None:
    """Keep something of a cycle, and forget the oldest."""
    items.pop(cycle_id, None)
    items[cycle_id] = item
    if len(items) > _MOST_OPEN:
        del items[next(iter(items))]
