"""The controller of the surface: applies configurations and reports them."""

import collections
import enum
from collections.abc import Mapping

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.codebook_cache import CodebookCache
from rhs_isac_ros.protocol.events import Action, CodebookOffered, Event, LogMessage, Send
from rhs_isac_ros.protocol.state_machine import ANY, SAME, StateMachine, Transition


class State(enum.Enum):
    """States of the controller."""

    IDLE = 'idle'                  # no configuration applied
    POSITIONING = 'positioning'    # a band's configurations, frame after frame
    TRANSMITTING = 'transmitting'  # the configuration of a beam


class Input(enum.Enum):
    """Names of what can happen to the controller."""

    CODEBOOK = 'codebook'
    GRANT = 'grant'
    COMMAND = 'command'
    STALE_COMMAND = 'stale_command'
    DUPLICATE = 'duplicate'
    BEAM = 'beam'
    WRONG_CODEBOOK = 'wrong_codebook'
    WRONG_CYCLE = 'wrong_cycle'
    WRONG_USER = 'wrong_user'


S, I = State, Input  # noqa: E741

TABLE: Mapping[tuple[State | None, Input], Transition] = {
    (ANY, I.CODEBOOK): Transition(SAME, ('keep',)),
    (ANY, I.GRANT): Transition(SAME, ('note_grant',)),
    (ANY, I.COMMAND): Transition(S.POSITIONING, ('apply_band',)),
    (S.POSITIONING, I.BEAM): Transition(S.TRANSMITTING, ('apply_beam',)),
    (S.TRANSMITTING, I.BEAM): Transition(SAME, ('apply_beam',), counts='duplicate'),
    # Who asks again may not have heard the answer.
    (ANY, I.DUPLICATE): Transition(SAME, ('apply_band',), counts='duplicate'),
    (ANY, I.STALE_COMMAND): Transition(SAME, counts='stale_command'),
    (ANY, I.WRONG_CODEBOOK): Transition(SAME, ('complain',), counts='wrong_codebook'),
    (ANY, I.WRONG_CYCLE): Transition(SAME, counts='wrong_cycle'),
    (ANY, I.WRONG_USER): Transition(SAME, counts='wrong_user'),
}
# Grants and commands that are known again when they come late or doubled.
_MOST_KNOWN = 8


class RhsController(StateMachine):
    """The role of the controller of the surface.

    Which of the codebooks it knows applies is for the base station's commands to say.
    """

    SENDS = (m.RhsConfiguration,)
    RECEIVES = (m.Grant, m.RhsCommand, m.Beam)

    TABLE = TABLE

    def __init__(self) -> None:
        super().__init__(State.IDLE, {})
        self._codebooks: CodebookCache[Codebook] = CodebookCache()
        self._cycle_id = 0
        self._granted: collections.deque[m.Grant] = collections.deque(maxlen=_MOST_KNOWN)
        # Cycle, band and codebook of what was applied, the present one last.
        self._applied: collections.deque[tuple[int, int, str]] = collections.deque(
            maxlen=_MOST_KNOWN)
        # Said once until a command is obeyed.
        self._has_complained = False

    def status(self) -> Mapping[str, str]:
        """Return the codebook in use.

        Returns
        -------
        Mapping
            Values by name.
        """
        return {'codebook_id': self._codebooks.in_use}

    def _classify(self, event: Event) -> Input:
        match event:
            case CodebookOffered():
                return Input.CODEBOOK
            case m.Grant():
                return Input.GRANT
            case m.RhsCommand():
                return self._classify_command(event)
            case m.Beam():
                if event.cycle_id != self._cycle_id:
                    return Input.WRONG_CYCLE
                if self._users(event.cycle_id) - {event.user}:
                    return Input.WRONG_USER
                same = event.codebook_id == self._codebooks.in_use
                return Input.BEAM if same else Input.WRONG_CODEBOOK
        raise TypeError(f'{type(event).__name__} is no event of a controller of the surface')

    def _classify_command(self, command: m.RhsCommand) -> Input:
        if command.codebook_id not in self._codebooks:
            return Input.WRONG_CODEBOOK
        key = command.cycle_id, command.band, command.codebook_id
        if key not in self._applied:
            return Input.COMMAND
        present = self.state is State.POSITIONING and key == self._applied[-1]
        return Input.DUPLICATE if present else Input.STALE_COMMAND

    def _users(self, cycle_id: int) -> set[int]:
        """Whom a cycle was granted to, as far as the grant was heard."""
        newest = [grant.user for grant in self._granted if grant.cycle_id == cycle_id]
        return set(newest[-1:])

    def _note_grant(self, event: m.Grant, now_s: float) -> None:
        self._granted.append(event)

    def _keep(self, event: CodebookOffered, now_s: float) -> None:
        self._codebooks.put(event.codebook.id, event.codebook)

    def _apply_band(self, event: m.RhsCommand, now_s: float) -> list[Action]:
        self._cycle_id, self._has_complained = event.cycle_id, False
        key = event.cycle_id, event.band, event.codebook_id
        if key not in self._applied:
            self._applied.append(key)
        analog = self._codebooks.take(event.codebook_id).analog[event.band]
        return [Send(m.RhsConfiguration(
            event.cycle_id, m.Mode.POSITIONING, event.band, event.codebook_id, analog))]

    def _apply_beam(self, event: m.Beam, now_s: float) -> list[Action]:
        return [Send(m.RhsConfiguration(
            event.cycle_id, m.Mode.TRANSMISSION, event.band, event.codebook_id,
            event.analog[None]))]

    def _complain(self, event: m.RhsCommand | m.Beam, now_s: float) -> list[Action]:
        if self._has_complained:
            return []
        self._has_complained = True
        return [LogMessage(f'codebook {event.codebook_id!r} asked for, known: '
                     f'{self._codebooks.ids()}', warning=True)]
