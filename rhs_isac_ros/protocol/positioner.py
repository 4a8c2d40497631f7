"""The positioner: turns received signals into a position."""

from collections.abc import Callable

import numpy as np

from rhs_isac_ros.bounds import Factors, crlb, factor
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Estimator, SignalError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import (
    Action,
    CodebookOffered,
    EstimatorFailed,
    EstimatorMade,
    Event,
    MakeEstimator,
    Note,
    Send,
)
from rhs_isac_ros.protocol.role import PlainRole
from rhs_isac_ros.protocol.shelf import Shelf


class Positioner(PlainRole):
    """The role of the positioner.

    The received signals tell with which of the codebooks that it knows they were taken. An
    estimator takes its time to make: one is made at a time, those for other codebooks serve
    meanwhile, and the newest signals of its own codebook wait for it.

    Parameters
    ----------
    scenario
        The scenario.
    stopwatch
        Function that returns a time [s], to measure the estimators with.
    """

    def __init__(self, scenario: Scenario, stopwatch: Callable[[], float]) -> None:
        super().__init__()
        self._scenario, self._stopwatch = scenario, stopwatch
        self._estimators: Shelf[tuple[Codebook, Factors, Estimator]] = Shelf()
        # The codebook whose estimator is being made, and the newest one offered since.
        self._making: Codebook | None = None
        self._next: Codebook | None = None
        self._waiting: m.ReceivedSignals | None = None
        # Whether the last signals told no position: said once in a row.
        self._is_lost = False
        # The signals that were answered last, and the answer.
        self._answered: tuple[m.ReceivedSignals, list[Action]] | None = None

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take a codebook, an estimator for one, or received signals.

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
                return self._want(codebook)
            case EstimatorMade(codebook, estimator, elapsed_s):
                factors = factor(self._scenario, codebook)
                self._estimators.put(codebook.id, (codebook, factors, estimator))
                note = Note(f'{estimator.name} is ready for codebook {codebook.id} after '
                            f'{elapsed_s:.1f} s')
                return [note, *self._go_on()]
            case EstimatorFailed(codebook, reason):
                note = Note(f'no estimator for codebook {codebook.id}: {reason}', warning=True)
                return [note, *self._go_on()]
            case m.ReceivedSignals():
                return self._receive(event)
        return []

    def _want(self, codebook: Codebook) -> list[Action]:
        if codebook.id in self._estimators:
            self._next = None
            return []
        if self._making is not None:
            self._next = codebook if codebook.id != self._making.id else None
            return []
        self._making = codebook
        return [MakeEstimator(codebook)]

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
        coming = {codebook.id for codebook in (self._making, self._next) if codebook}
        if received.codebook_id in coming:
            self._waiting = received
        else:
            self.counters['wrong_codebook'] += 1
        return []

    def _locate(self, received: m.ReceivedSignals) -> list[Action]:
        codebook, factors, estimator = self._estimators.take(received.codebook_id)
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
        bound = float(crlb(self._scenario, codebook, estimate.mean[None], factors)[0])
        return [Send(m.PositionEstimate(
            received.cycle_id, received.user, received.codebook_id,
            np.array(estimate.mean), np.array(estimate.covariance), bound, estimator.name,
            latency_s))]

    def _no_fix(self, received: m.ReceivedSignals, reason: str) -> list[Action]:
        self.counters['no_fix'] += 1
        sent = Send(m.NoFix(received.cycle_id, received.user, received.codebook_id, reason))
        note = Note(f'cycle {received.cycle_id}: no fix: {reason}', warning=True)
        said, self._is_lost = self._is_lost, True
        return [sent] if said else [sent, note]


def make_estimator_for(
        codebook: Codebook, make: Callable[[Codebook], Estimator],
        stopwatch: Callable[[], float]) -> EstimatorMade | EstimatorFailed:
    """Do what `MakeEstimator` asks for; this may run in another thread.

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
    EstimatorMade or EstimatorFailed
        The event for the role.
    """
    begin = stopwatch()
    try:
        estimator = make(codebook)
    # What a codebook, a model file or a full disk may be the reason of.
    except (ValueError, OSError, MemoryError) as error:
        return EstimatorFailed(codebook, str(error) or type(error).__name__)
    return EstimatorMade(codebook, estimator, stopwatch() - begin)
