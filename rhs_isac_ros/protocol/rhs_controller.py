"""The RHS controller, which applies configurations to the surface and reports them."""

import enum
from collections.abc import Mapping

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, CodebookOffered, LogMessage, Outcome, Send
from rhs_isac_ros.protocol.role import (
    ANY,
    CodebookCache,
    EventT,
    NewestDict,
    StateMachine,
    Transition,
)

# Number of cycles kept to recognise late and repeated messages.
_MAX_REMEMBERED = 8


class State(enum.Enum):
    """States of the RHS controller."""

    IDLE = 'idle'                  # applies no configuration
    POSITIONING = 'positioning'    # applies the bands' configurations, one for each frame
    TRANSMITTING = 'transmitting'  # applies the configuration of a beam


class Row(Transition[State, 'RhsController', EventT]):
    """A row of the table."""


class RhsController(StateMachine[State]):
    """The role of the RHS controller.

    It holds the latest codebooks; the commands of the base station select the one to apply.
    """

    SENDS = (m.RhsConfiguration,)
    RECEIVES = (m.Grant, m.RhsCommand, m.Beam)

    STATES = State
    EVENT_NAMES = {CodebookOffered: 'codebook', m.Grant: 'grant', m.RhsCommand: 'command',
                   m.Beam: 'beam'}


    def __init__(self) -> None:
        super().__init__(State.IDLE, {})
        self._codebooks: CodebookCache[Codebook] = CodebookCache()
        self._cycle_id = 0
        # Instance that sent the beam applied last.
        self._beam_sender = 0
        # The user of each granted cycle.
        self._granted: NewestDict[int, int] = NewestDict(_MAX_REMEMBERED)
        # Band and codebook of the executed commands of each cycle.
        self._applied: NewestDict[int, set[tuple[int, str]]] = NewestDict(_MAX_REMEMBERED)
        # Reset by the next executed command, so that each outage is logged once.
        self._unknown_logged = False

    def status(self) -> Mapping[str, str]:
        """Return the codebook in use, as ``codebook_id``."""
        return {'codebook_id': self._codebooks.in_use}

    # Guards

    def unknown_codebook(self, event: m.RhsCommand, now_s: float) -> bool:
        """Whether the codebook of a command was never offered, or was discarded."""
        return event.codebook_id not in self._codebooks

    def repeats_command(self, event: m.RhsCommand, now_s: float) -> bool:
        """Whether a command of the current cycle was executed before."""
        return (self.state is State.POSITIONING and event.cycle_id == self._cycle_id
                and self._is_applied(event))

    def stale_command(self, event: m.RhsCommand, now_s: float) -> bool:
        """Whether a command was executed before, and its cycle or its positioning has ended."""
        return self._is_applied(event)

    def _is_applied(self, command: m.RhsCommand) -> bool:
        return (command.band, command.codebook_id) in self._applied.get(command.cycle_id, ())

    def wrong_cycle(self, event: m.Beam, now_s: float) -> bool:
        """Whether a beam belongs to a cycle other than that of the last command."""
        return event.cycle_id != self._cycle_id

    def wrong_user(self, event: m.Beam, now_s: float) -> bool:
        """Whether the cycle of a beam is known to be granted to another user."""
        return self._granted.get(event.cycle_id, event.user) != event.user

    def wrong_instance(self, event: m.Beam, now_s: float) -> bool:
        """Whether the beam of another sender is applied in the cycle."""
        return (self.state is State.TRANSMITTING
                and not m.same_instance(self._beam_sender, event.sender))

    def wrong_codebook(self, event: m.Beam, now_s: float) -> bool:
        """Whether a beam belongs to a codebook other than the one applied."""
        return event.codebook_id != self._codebooks.in_use

    # Actions

    def store_codebook(self, event: CodebookOffered, now_s: float) -> None:
        """Store a codebook."""
        self._codebooks.put(event.codebook.id, event.codebook)

    def log_codebook(self, event: CodebookOffered, now_s: float) -> list[Action]:
        """Log that commands with the codebook can be executed."""
        return [LogMessage(f'serving: codebook {event.codebook.id}')]

    def store_grant(self, event: m.Grant, now_s: float) -> None:
        """Store the user of a cycle."""
        self._granted.put(event.cycle_id, event.user)

    def apply_band(self, event: m.RhsCommand, now_s: float) -> list[Action]:
        """Report the codebook's configurations of a band."""
        self._cycle_id, self._unknown_logged = event.cycle_id, False
        applied = self._applied.get(event.cycle_id, set())
        self._applied.put(event.cycle_id, applied | {(event.band, event.codebook_id)})
        analog = self._codebooks.take(event.codebook_id).analog[event.band]
        return [Send(m.RhsConfiguration(
            cycle_id=event.cycle_id, mode=m.Mode.POSITIONING, band=event.band,
            codebook_id=event.codebook_id, analog=analog))]

    def apply_beam(self, event: m.Beam, now_s: float) -> list[Action]:
        """Report the configuration of a beam."""
        self._beam_sender = event.sender
        return [Send(m.RhsConfiguration(
            cycle_id=event.cycle_id, mode=m.Mode.TRANSMISSION, band=event.band,
            codebook_id=event.codebook_id, analog=event.analog[None]))]

    def log_unknown_codebook(self, event: m.RhsCommand | m.Beam, now_s: float) -> list[Action]:
        """Log the first message of an outage whose codebook cannot be applied."""
        if self._unknown_logged:
            return []
        self._unknown_logged = True
        return [LogMessage(
            f'codebook {event.codebook_id!r} rejected; in use: {self._codebooks.in_use!r}, '
            f'available: {self._codebooks.ids()}', warning=True)]

    # Messages that are dropped in every state, before the rows of the table.
    DROPS = {m.Beam: {wrong_cycle: Outcome.WRONG_CYCLE, wrong_user: Outcome.WRONG_USER,
                      wrong_instance: Outcome.WRONG_INSTANCE}}

    TABLE = (
        Row(ANY, CodebookOffered, actions=(store_codebook, log_codebook)),
        Row(ANY, m.Grant, actions=(store_grant,)),

        Row(ANY, m.RhsCommand, guard=unknown_codebook, actions=(log_unknown_codebook,),
            outcome=Outcome.WRONG_CODEBOOK),
        # The base station repeats a command if it may have missed the report.
        Row(ANY, m.RhsCommand, guard=repeats_command, actions=(apply_band,),
            outcome=Outcome.DUPLICATE),
        Row(ANY, m.RhsCommand, guard=stale_command, outcome=Outcome.STALE_COMMAND),
        Row(ANY, m.RhsCommand, actions=(apply_band,), target=State.POSITIONING),

        Row(ANY, m.Beam, guard=wrong_codebook, actions=(log_unknown_codebook,),
            outcome=Outcome.WRONG_CODEBOOK),
        Row((State.POSITIONING,), m.Beam, actions=(apply_beam,), target=State.TRANSMITTING),
        Row((State.TRANSMITTING,), m.Beam, actions=(apply_beam,), outcome=Outcome.DUPLICATE),
    )
