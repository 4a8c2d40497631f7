"""The transmission: steers a beam to the estimated position and reports what it carries."""

import math

import numpy as np

from rhs_isac_ros.link import Beam, capacity, steer
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, CodebookOffered, Event, Send
from rhs_isac_ros.protocol.role import PlainRole
from rhs_isac_ros.protocol.shelf import Shelf


class Transmission(PlainRole):
    """The role that steers the beam.

    The true position only enters the reported capacities, never the beam.

    Parameters
    ----------
    scenario
        The scenario.
    band
        Band of the transmission, from 0.
    """

    def __init__(self, scenario: Scenario, band: int) -> None:
        super().__init__()
        self._scenario, self._band = scenario, band
        self._codebooks: Shelf[None] = Shelf()
        self._beam: m.Beam | None = None
        self._truth: m.GroundTruth | None = None

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take a codebook, a position estimate, a reported configuration or a true position.

        Parameters
        ----------
        event
            The event.
        now_s
            The time [s].

        Returns
        -------
        list of Action
            The beam, or the capacity.
        """
        match event:
            case CodebookOffered(codebook):
                self._codebooks.put(codebook.id, None)
            case m.GroundTruth() if event.cycle_id:
                self._truth = event
            case m.PositionEstimate() if event.codebook_id not in self._codebooks:
                self.counters['wrong_codebook'] += 1
            case m.PositionEstimate():
                return self._steer(event)
            case m.RhsConfiguration(mode=m.Mode.TRANSMISSION):
                return self._report(event)
        return []

    def _steer(self, estimate: m.PositionEstimate) -> list[Action]:
        self._codebooks.take(estimate.codebook_id)
        beam = steer(self._scenario, estimate.position, self._band)
        expected = self._capacity(beam, estimate.position)
        self._beam = m.Beam(
            estimate.cycle_id, estimate.user, estimate.codebook_id, beam.band, beam.analog,
            beam.digital, expected)
        return [Send(self._beam)]

    def _report(self, applied: m.RhsConfiguration) -> list[Action]:
        beam, truth = self._beam, self._truth
        if beam is None or applied.cycle_id != beam.cycle_id:
            self.counters['wrong_cycle'] += 1
            return []
        actual = perfect = math.nan
        if truth and (truth.cycle_id, truth.user) == (beam.cycle_id, beam.user):
            used = Beam(applied.analog[0], beam.digital, beam.band)
            best = steer(self._scenario, truth.position, beam.band)
            actual = self._capacity(used, truth.position)
            perfect = self._capacity(best, truth.position)
        loss = perfect - actual
        return [Send(m.Capacity(
            beam.cycle_id, beam.user, beam.codebook_id, beam.band, beam.expected_bps, actual,
            perfect, loss, 100 * loss / perfect))]

    def _capacity(self, beam: Beam, position: np.ndarray) -> float:
        return float(capacity(self._scenario, beam, position[None])[0])
