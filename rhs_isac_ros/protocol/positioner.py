"""The positioner: turns received signals into a position."""

from collections.abc import Callable

import numpy as np

from rhs_isac_ros.bounds import Factors, crlb, factor
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Estimator, SignalError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, CodebookOffered, Event, Note, Send
from rhs_isac_ros.protocol.role import PlainRole
from rhs_isac_ros.protocol.shelf import Shelf


class Positioner(PlainRole):
    """The role of the positioner.

    The received signals tell with which of the codebooks that it knows they were taken.

    Parameters
    ----------
    scenario
        The scenario.
    make
        Function of a codebook that returns an estimator.
    stopwatch
        Function that returns a time [s], to measure the estimator with.
    """

    def __init__(
            self, scenario: Scenario, make: Callable[[Codebook], Estimator],
            stopwatch: Callable[[], float]) -> None:
        super().__init__()
        self._scenario, self._make, self._stopwatch = scenario, make, stopwatch
        self._estimators: Shelf[tuple[Codebook, Factors, Estimator]] = Shelf()

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take a codebook or received signals.

        Parameters
        ----------
        event
            The event.
        now_s
            The time [s].

        Returns
        -------
        list of Action
            The position estimate.
        """
        match event:
            case CodebookOffered(codebook):
                return self._keep(codebook)
            case m.ReceivedSignals() if event.codebook_id in self._estimators:
                try:
                    return [Send(self._locate(event))]
                except SignalError as error:
                    self.counters['unusable_signals'] += 1
                    return [Note(f'cycle {event.cycle_id}: no fix: {error}', warning=True)]
            case m.ReceivedSignals():
                self.counters['wrong_codebook'] += 1
        return []

    def _keep(self, codebook: Codebook) -> list[Action]:
        if codebook.id in self._estimators:
            return []
        begin = self._stopwatch()
        estimator = self._make(codebook)
        factors = factor(self._scenario, codebook)
        self._estimators.put(codebook.id, (codebook, factors, estimator))
        return [Note(f'{estimator.name} is ready for codebook {codebook.id} after '
                     f'{self._stopwatch() - begin:.1f} s')]

    def _locate(self, received: m.ReceivedSignals) -> m.PositionEstimate:
        codebook, factors, estimator = self._estimators.take(received.codebook_id)
        begin = self._stopwatch()
        signals = received.signals.reshape(len(received.signals), -1)
        estimate = estimator.estimate(signals)
        latency_s = self._stopwatch() - begin
        bound = float(crlb(self._scenario, codebook, estimate.mean[None], factors)[0])
        return m.PositionEstimate(
            received.cycle_id, received.user, received.codebook_id,
            np.array(estimate.mean), np.array(estimate.covariance), bound, estimator.name,
            latency_s)
