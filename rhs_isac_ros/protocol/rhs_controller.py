"""The controller of the surface: applies configurations and reports them."""

import enum
from collections.abc import Mapping

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, CodebookOffered, Event, Note, Send
from rhs_isac_ros.protocol.machine import ANY, SAME, Machine, Step
from rhs_isac_ros.protocol.shelf import Shelf


class State(enum.Enum):
    """States of the controller."""

    IDLE = 'idle'                  # no configuration applied
    POSITIONING = 'positioning'    # a band's configurations, frame after frame
    TRANSMITTING = 'transmitting'  # the configuration of a beam


class Input(enum.Enum):
    """Names of what can happen to the controller."""

    CODEBOOK = 'codebook'
    COMMAND = 'command'
    BEAM = 'beam'
    WRONG_CODEBOOK = 'wrong_codebook'
    WRONG_CYCLE = 'wrong_cycle'


S, I = State, Input  # noqa: E741

TABLE: Mapping[tuple[State | None, Input], Step] = {
    (ANY, I.CODEBOOK): Step(SAME, ('keep',)),
    (ANY, I.COMMAND): Step(S.POSITIONING, ('apply_band',)),
    (S.POSITIONING, I.BEAM): Step(S.TRANSMITTING, ('apply_beam',)),
    (S.TRANSMITTING, I.BEAM): Step(SAME, ('apply_beam',), counts='duplicate'),
    (ANY, I.WRONG_CODEBOOK): Step(SAME, ('complain',), counts='wrong_codebook'),
    (ANY, I.WRONG_CYCLE): Step(SAME, counts='wrong_cycle'),
}


class RhsController(Machine):
    """The role of the controller of the surface.

    Which of the codebooks it knows applies is for the base station's commands to say.
    """

    TABLE = TABLE

    def __init__(self) -> None:
        super().__init__(State.IDLE, {})
        self._codebooks: Shelf[Codebook] = Shelf()
        self._cycle_id = 0
        self._complaint = ''

    def _classify(self, event: Event) -> Input:
        match event:
            case CodebookOffered():
                return Input.CODEBOOK
            case m.RhsCommand():
                known = event.codebook_id in self._codebooks
                return Input.COMMAND if known else Input.WRONG_CODEBOOK
            case m.Beam():
                if event.cycle_id != self._cycle_id:
                    return Input.WRONG_CYCLE
                same = event.codebook_id == self._codebooks.in_use
                return Input.BEAM if same else Input.WRONG_CODEBOOK
        raise TypeError(f'{type(event).__name__} is no event of a controller of the surface')

    def _keep(self, event: CodebookOffered, now_s: float) -> None:
        self._codebooks.put(event.codebook.id, event.codebook)

    def _apply_band(self, event: m.RhsCommand, now_s: float) -> list[Action]:
        self._cycle_id = event.cycle_id
        analog = self._codebooks.take(event.codebook_id).analog[event.band]
        return [Send(m.RhsConfiguration(
            event.cycle_id, m.Mode.POSITIONING, event.band, event.codebook_id, analog))]

    def _apply_beam(self, event: m.Beam, now_s: float) -> list[Action]:
        return [Send(m.RhsConfiguration(
            event.cycle_id, m.Mode.TRANSMISSION, event.band, event.codebook_id,
            event.analog[None]))]

    def _complain(self, event: m.RhsCommand | m.Beam, now_s: float) -> list[Action]:
        if event.codebook_id == self._complaint:
            return []
        self._complaint = event.codebook_id
        return [Note(f'codebook {event.codebook_id!r} asked for, known: '
                     f'{self._codebooks.ids()}', warning=True)]
