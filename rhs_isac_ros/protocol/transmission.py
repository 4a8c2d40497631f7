"""The role that steers the beam of a surface to estimated positions, and reports its capacity."""

import collections
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.codebook.library import EMPTY, Library
from rhs_isac_ros.link import (
    Beamformer,
    CapacityReport,
    Choice,
    applied_beam,
    capacity,
    capacity_report,
    choose_beam,
)
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Event, Outcome
from rhs_isac_ros.protocol.ground_truth import TruePositions
from rhs_isac_ros.protocol.role import REMEMBERED_CYCLES, CodebookCache, NewestDict, Role
from rhs_isac_ros.protocol.settings import PendingSettings, TransmissionSettings

# Fields of `Capacity`; `CapacityStatistics` contains their quartiles under the same names.
_FIGURES = ('expected_bps', 'actual_bps', 'perfect_bps', 'loss_bps', 'loss_percent')
# Maximum number of reports in the statistics; the limit lets them follow a changing network.
_WINDOW = 1000
# A report is computed once no message of a cycle has arrived for this time [s], so that it does
# not delay a cycle if other roles run in the same process.
_IDLE_S = 5e-3
# Maximum time [s] by which messages, or a missing true position, postpone a report, and maximum
# number of postponed reports.
_MAX_DELAY_S = 0.25
_MAX_WAITING = 8


class _Steered(NamedTuple):
    """The beam of a cycle, and the estimate, bands and surface for which it was chosen."""

    estimate: m.PositionEstimate
    beam: m.Beam
    bands: Sequence[int]
    surface: SurfaceEstimate | None


class _Waiting(NamedTuple):
    """A report on the beam applied in a cycle, to be computed by `deadline_s` [s]."""

    steered: _Steered
    applied: m.RhsConfiguration
    deadline_s: float


class Transmission(Role):
    """The role that steers the beam.

    The true position affects only the reported capacities, never the beam. A report takes as long
    to compute as a beam, so reports are usually computed between cycles. `surface_of` takes the
    name of a calibration file, and returns the surface in the file, or None for an empty name.
    `choose` and `evaluate` replace `choose_beam` and `capacity_report`. Estimates may
    have the codebooks of a `library`, too.
    """

    SENDS = (m.Beam, m.Capacity, m.CapacityStatistics)
    RECEIVES = (m.PositionEstimate, m.RhsConfiguration, m.GroundTruth)

    def __init__(
            self, scenario: Scenario, settings: TransmissionSettings | None = None,
            surface_of: Callable[[str], SurfaceEstimate | None] = lambda file: None,
            choose: Callable[..., Choice] = choose_beam,
            evaluate: Callable[..., CapacityReport] = capacity_report,
            library: Library = EMPTY) -> None:
        super().__init__()
        self._scenario, self._surface_of = scenario, surface_of
        self._choose, self._evaluate = choose, evaluate
        self._settings = PendingSettings(settings or TransmissionSettings())
        self._codebooks: CodebookCache[None] = CodebookCache(library.by_id)
        self._codebooks.update(dict.fromkeys(library.by_id))
        # Beams by cycle, true positions, and cycles in the statistics.
        self._steered: NewestDict[int, _Steered] = NewestDict(REMEMBERED_CYCLES)
        self._truths = TruePositions(REMEMBERED_CYCLES + _MAX_WAITING)
        self._counted: NewestDict[int, None] = NewestDict(REMEMBERED_CYCLES)
        self._waiting: collections.deque[_Waiting] = collections.deque()
        self._active_s = -math.inf
        # Figures of the newest reports.
        self._reported: collections.deque[list[float]] = collections.deque(maxlen=_WINDOW)

    def react(self, event: Event) -> None:
        """Process an event: send the beam, or the capacity and its statistics."""
        if isinstance(event, m.Message) and event.cycle_id:
            self._active_s = self.now_s
        match event:
            case events.Timeout() if self._waiting:
                # Messages that arrived during a report are processed before the next report.
                self._active_s = self.now_s
                self._report_next()
            case events.CodebookOffered(codebook):
                self._codebooks.put(codebook.id, None)
                self.log(f'serving: codebook {codebook.id}')
            case events.SettingsOffered(settings):
                # A cycle that has a beam keeps its bands and its surface.
                self._settings.latest = settings
                self.log(self._settings.apply())
            case m.GroundTruth():
                self._truths.add(event)
            case m.PositionEstimate() if event.codebook_id not in ('', *self._codebooks):
                self.count(Outcome.WRONG_CODEBOOK)
            case m.PositionEstimate() if self._place_of(event)[0] <= 0:
                self.count(Outcome.BEHIND)
            case m.PositionEstimate():
                self._steer(event)
            case m.RhsConfiguration(mode=m.Mode.TRANSMISSION):
                self._await_report(event)
                if len(self._waiting) > _MAX_WAITING:
                    self._report_next()

    def next_deadline(self) -> float | None:
        """Return the time at which the next report is due [s], or None."""
        if not self._waiting:
            return None
        deadline_s = self._waiting[0].deadline_s
        if any(map(self._truth_of, self._waiting)):
            deadline_s = min(deadline_s, self._active_s + _IDLE_S)
        return deadline_s

    def status(self) -> Mapping[str, str]:
        """Return the settings and the codebook in use."""
        return self._settings.describe() | {'codebook_id': self._codebooks.in_use}

    def _place_of(self, event: m.PositionEstimate | m.GroundTruth) -> np.ndarray:
        return self._scenario.pose.to_surface(event.position)

    def _steer(self, estimate: m.PositionEstimate) -> None:
        known = self._steered.get(estimate.cycle_id)
        is_other = known and not m.same_instance(known.estimate.sender, estimate.sender)
        if known and (is_other or m.same(known.estimate, estimate)):
            # A repeated estimate, or an estimate of another positioner, yields the same beam.
            self.count(Outcome.WRONG_INSTANCE if is_other else Outcome.DUPLICATE)
            self.send(known.beam)
            return
        if estimate.codebook_id:
            self._codebooks.take(estimate.codebook_id)
        if known:
            bands, surface = known.bands, known.surface
        else:
            settings = self._settings.in_use
            bands = range(self._scenario.n_bands) if settings.band < 0 else (settings.band,)
            surface = self._surface_of(settings.calibration_file)
        choice = self._choose(
            self._scenario, self._place_of(estimate),
            self._scenario.pose.covariances_to_surface(estimate.covariance_m2), bands, surface)
        beam = choice.beam
        sent = m.derive(
            m.Beam, estimate, band=beam.band, analog=beam.analog, digital=beam.digital,
            expected_bps=choice.expected_bps)
        self._steered.put(estimate.cycle_id, _Steered(estimate, sent, bands, surface))
        self.send(sent)

    def _await_report(self, applied: m.RhsConfiguration) -> None:
        steered = self._steered.get(applied.cycle_id)
        if steered is None:
            self.count(Outcome.WRONG_CYCLE)
        elif applied.codebook_id != steered.beam.codebook_id:
            self.count(Outcome.WRONG_CODEBOOK)
        elif applied.band != steered.beam.band:
            self.count(Outcome.WRONG_BAND)
        else:
            self._waiting.append(_Waiting(steered, applied, self.now_s + _MAX_DELAY_S))

    def _report_next(self) -> None:
        """Report on the first waiting beam to a user of known true position, else on the first."""
        waiting = next(filter(self._truth_of, self._waiting), self._waiting[0])
        self._waiting.remove(waiting)
        steered, applied, _ = waiting
        beam, result = steered.beam, CapacityReport(math.nan, math.nan)
        if truth := self._truth_of(waiting):
            used = Beamformer(applied.analog[0], beam.digital, beam.band)
            result = self._evaluate(
                self._scenario, used, self._place_of(truth), steered.bands, steered.surface)
        steering = applied_beam(Beamformer(beam.analog, beam.digital, beam.band), steered.surface)
        at_estimate_bps = float(capacity(
            self._scenario, steering, self._place_of(steered.estimate)[None])[0])
        report = m.derive(
            m.Capacity, beam, expected_bps=beam.expected_bps, actual_bps=result.actual_bps,
            perfect_bps=result.perfect_bps, loss_bps=result.loss_bps,
            loss_percent=result.loss_percent, at_estimate_bps=at_estimate_bps)
        self.send(report)
        self._summarize(report)

    def _truth_of(self, waiting: _Waiting) -> m.GroundTruth | None:
        """Return the true position of the user to whom the beam is directed; None if unknown."""
        return self._truths.of(waiting.steered.estimate)

    def _summarize(self, report: m.Capacity) -> None:
        if not math.isfinite(report.loss_percent) or report.cycle_id in self._counted:
            return
        self._counted.put(report.cycle_id, None)
        self._reported.append([getattr(report, name) for name in _FIGURES])
        quartiles = np.quantile(self._reported, (0.25, 0.5, 0.75), axis=0).T
        self.send(m.derive(m.CapacityStatistics, report, n_reports=len(self._reported),
                           **dict(zip(_FIGURES, quartiles, strict=True))))
