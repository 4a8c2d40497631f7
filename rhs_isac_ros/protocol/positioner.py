"""The positioner: turns received signals into a position."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds import Factors, crlb, factor
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Estimator, SignalError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.codebook_cache import CodebookCache
from rhs_isac_ros.protocol.events import (
    Action,
    BuildEstimator,
    CodebookOffered,
    EstimatorFailed,
    EstimatorReady,
    Event,
    LogMessage,
    Send,
    SettingsOffered,
    SettingsReverted,
)
from rhs_isac_ros.protocol.pending_settings import PendingSettings
from rhs_isac_ros.protocol.role import PlainRole
from rhs_isac_ros.protocol.settings import PositionerSettings


class _Job(NamedTuple):
    """An estimator to make."""

    codebook: Codebook
    settings: PositionerSettings

    def is_as(self, other: '_Job | None') -> bool:
        return other is not None and (self.codebook.id, self.settings) == (
            other.codebook.id, other.settings)


class _Made(NamedTuple):
    """An estimator, what it was made of, and what tells its bound."""

    job: _Job
    factors: Factors
    estimator: Estimator


class Positioner(PlainRole):
    """The role of the positioner.

    The received signals tell with which of the codebooks that it knows they were taken. An
    estimator takes its time to make: one is made at a time, those for other codebooks serve
    meanwhile, and the newest signals of its own codebook wait for it. Where there is one for the
    same codebook, with other settings, that one serves until the new one is ready, and stays
    where none can be made.

    Parameters
    ----------
    scenario
        The scenario.
    stopwatch
        Function that returns a time [s], to measure the estimators with.
    settings
        Which estimator to use, until others are offered; by default the usual one.
    """

    SENDS = (m.PositionEstimate, m.NoFix)
    RECEIVES = (m.ReceivedSignals,)

    def __init__(
            self, scenario: Scenario, stopwatch: Callable[[], float],
            settings: PositionerSettings | None = None) -> None:
        super().__init__()
        self._scenario, self._stopwatch = scenario, stopwatch
        self._settings = PendingSettings(settings or PositionerSettings())
        # Why the last change of settings came to nothing, if it did.
        self._failure = ''
        self._estimators: CodebookCache[_Made] = CodebookCache()
        self._codebook: Codebook | None = None
        # The estimator that is being made, and the newest one wanted since.
        self._making: _Job | None = None
        self._next: _Job | None = None
        self._waiting: m.ReceivedSignals | None = None
        # Whether the last signals told no position: said once in a row.
        self._is_lost = False
        # The signals that were answered last, and the answer.
        self._answered: tuple[m.ReceivedSignals, list[Action]] | None = None

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take a codebook, settings, an estimator, or received signals.

        Parameters
        ----------
        event
            The event.
        now_s
            The time [s].

        Returns
        -------
        list of Action
            The position estimate, or why there is none; an estimator to make.
        """
        match event:
            case CodebookOffered(codebook):
                self._codebook = codebook
                return self._want(_Job(codebook, self._settings.newest))
            case SettingsOffered(settings):
                return self._take_settings(settings)
            case EstimatorReady(codebook, estimator, elapsed_s):
                return [*self._keep(self._job_of(codebook), estimator, elapsed_s),
                        *self._go_on()]
            case EstimatorFailed(codebook, reason):
                return [*self._do_without(self._job_of(codebook), reason), *self._go_on()]
            case m.ReceivedSignals():
                return self._receive(event)
        return []

    def status(self) -> Mapping[str, str]:
        """Return the settings and the codebook in use, those that wait, and what failed.

        Returns
        -------
        Mapping
            Values by name.
        """
        failed = {'failed.estimator': self._failure} if self._failure else {}
        return self._settings.describe() | failed | {'codebook_id': self._estimators.in_use}

    def _take_settings(self, settings: PositionerSettings) -> list[Action]:
        self._settings.newest, self._failure = settings, ''
        if self._codebook is None:
            return self._settings.apply()
        return self._want(_Job(self._codebook, settings))

    def _want(self, job: _Job) -> list[Action]:
        made = self._estimators.peek(job.codebook.id)
        if made and job.is_as(made.job):
            self._next = None
            return []
        if self._making is not None:
            self._next = None if job.is_as(self._making) else job
            return []
        self._making = job
        return [BuildEstimator(job.codebook, job.settings)]

    def _job_of(self, codebook: Codebook) -> _Job:
        return self._making or _Job(codebook, self._settings.newest)

    def _keep(self, job: _Job, estimator: Estimator, elapsed_s: float) -> list[Action]:
        """Use an estimator from the next signals on, unless another one is wanted by now."""
        codebook = job.codebook
        is_wanted = job.settings == self._settings.newest
        if not is_wanted and codebook.id in self._estimators:
            return []
        self._estimators.put(codebook.id, _Made(job, factor(self._scenario, codebook), estimator))
        self._settings.in_use = job.settings
        return [LogMessage(f'{estimator.name} is ready for codebook {codebook.id} after '
                     f'{elapsed_s:.1f} s')]

    def _do_without(self, job: _Job, reason: str) -> list[Action]:
        """Stay with the settings in use if others were the reason that nothing was made."""
        kept = self._settings.in_use
        if job.settings == kept:
            return [LogMessage(
                f'no estimator for codebook {job.codebook.id}: {reason}', warning=True)]
        if job.settings != self._settings.newest:
            return []
        self._settings.newest = kept
        self._failure = f'{job.settings.estimator}: {reason}'
        # Whichever codebook is wanted by now, it is wanted with the settings in use.
        self._next = _Job((self._next or job).codebook, kept)
        return [LogMessage(f'estimator {job.settings.estimator} not used, {kept.estimator} stays: '
                     f'{reason}', warning=True), SettingsReverted(kept)]

    def _go_on(self) -> list[Action]:
        """After an estimator was made: the signals that waited for it, and the next one."""
        waiting, wanted = self._waiting, self._next
        self._making = self._next = self._waiting = None
        actions = self._want(wanted) if wanted else []
        return actions + (self._receive(waiting) if waiting else [])

    def _receive(self, received: m.ReceivedSignals) -> list[Action]:
        if self._answered and m.same(self._answered[0], received):
            self.counters['duplicate'] += 1
            return self._answered[1]
        if received.codebook_id in self._estimators:
            self._answered = received, self._locate(received)
            return self._answered[1]
        coming = {job.codebook.id for job in (self._making, self._next) if job}
        if received.codebook_id in coming:
            self._waiting = received
        else:
            self.counters['wrong_codebook'] += 1
        return []

    def _locate(self, received: m.ReceivedSignals) -> list[Action]:
        job, factors, estimator = self._estimators.take(received.codebook_id)
        begin = self._stopwatch()
        signals = received.signals.reshape(len(received.signals), -1)
        try:
            estimate = estimator.estimate(signals)
        except SignalError as error:
            return self._no_fix(received, str(error))
        latency_s = self._stopwatch() - begin
        if not estimate.fix:
            return self._no_fix(received, estimate.reason)
        self._is_lost = False
        bound = float(crlb(self._scenario, job.codebook, estimate.mean[None], factors)[0])
        return [Send(m.PositionEstimate(
            cycle_id=received.cycle_id, user=received.user, codebook_id=received.codebook_id,
            position=np.array(estimate.mean), covariance_m2=np.array(estimate.covariance),
            crlb_m2=bound, estimator=estimator.name, latency_s=latency_s))]

    def _no_fix(self, received: m.ReceivedSignals, reason: str) -> list[Action]:
        self.counters['no_fix'] += 1
        sent = Send(m.NoFix(
            cycle_id=received.cycle_id, user=received.user, codebook_id=received.codebook_id,
            reason=reason))
        note = LogMessage(f'cycle {received.cycle_id}: no fix: {reason}', warning=True)
        said, self._is_lost = self._is_lost, True
        return [sent] if said else [sent, note]


def build_estimator(
        codebook: Codebook, make: Callable[[Codebook], Estimator],
        stopwatch: Callable[[], float]) -> EstimatorReady | EstimatorFailed:
    """Do what `BuildEstimator` asks for; this may run in another thread.

    Parameters
    ----------
    codebook
        The codebook.
    make
        Function of a codebook that returns an estimator.
    stopwatch
        Function that returns a time [s].

    Returns
    -------
    EstimatorReady or EstimatorFailed
        The event for the role.
    """
    begin = stopwatch()
    try:
        estimator = make(codebook)
    # What a codebook, a model file or a full disk may be the reason of.
    except (ValueError, OSError, MemoryError) as error:
        return EstimatorFailed(codebook, str(error) or type(error).__name__)
    return EstimatorReady(codebook, estimator, stopwatch() - begin)
