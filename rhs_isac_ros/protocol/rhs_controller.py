"""The RHS controller, which applies configurations to the surface and reports them."""

import enum
from collections.abc import Mapping

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.library import EMPTY, Library
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import CodebookOffered, Outcome
from rhs_isac_ros.protocol.role import (
    ANY,
    REMEMBERED_CYCLES,
    CodebookCache,
    NewestDict,
    Row,
    StateMachine,
    on,
)


class RhsControllerState(enum.Enum):
    """States of the RHS controller."""

    IDLE = 'idle'                  # applies no configuration
    POSITIONING = 'positioning'    # applies the configurations of the bands, frame by frame
    TRANSMITTING = 'transmitting'  # applies the configuration of a beam


class RhsController(StateMachine):
    """The role that applies configurations to the surface.

    It keeps the latest codebooks and those of a library. Each command of the base station selects
    a codebook and a band.
    """

    SENDS = (m.RhsConfiguration,)

    STATES = RhsControllerState

    def __init__(self, library: Library = EMPTY) -> None:
        super().__init__(RhsControllerState.IDLE)
        self._codebooks: CodebookCache[Codebook] = CodebookCache(library.by_id)
        self._codebooks.update(library.by_id)
        self._library_id = library.id
        self._cycle_id = 0
        # Sender of the beam that was applied last.
        self._beam_sender = 0
        # The user of each granted cycle.
        self._granted: NewestDict[int, int] = NewestDict(REMEMBERED_CYCLES)
        # Bands and codebooks of the commands executed in each cycle.
        self._applied: NewestDict[int, set[tuple[int, str]]] = NewestDict(REMEMBERED_CYCLES)
        # Whether a rejected codebook has been logged since the last executed command.
        self._unknown_logged = False

    def status(self) -> Mapping[str, str]:
        """Return the id of the codebook in use, as ``codebook_id``."""
        return {'codebook_id': self._codebooks.in_use}

    # Guards

    def _unknown_codebook(self, event: m.RhsCommand) -> bool:
        return event.codebook_id not in self._codebooks

    def _repeats_command(self, event: m.RhsCommand) -> bool:
        return (self.state is RhsControllerState.POSITIONING and event.cycle_id == self._cycle_id
                and self._was_executed(event))

    def _was_executed(self, event: m.RhsCommand) -> bool:
        return (event.band, event.codebook_id) in self._applied.get(event.cycle_id, ())

    def _wrong_cycle(self, event: m.Beam) -> bool:
        return event.cycle_id != self._cycle_id

    def _wrong_user(self, event: m.Beam) -> bool:
        return self._granted.get(event.cycle_id, event.user) != event.user

    def _wrong_instance(self, event: m.Beam) -> bool:
        return (self.state is RhsControllerState.TRANSMITTING
                and not m.same_instance(self._beam_sender, event.sender))

    def _wrong_codebook(self, event: m.Beam) -> bool:
        return event.codebook_id not in ('', self._codebooks.in_use)

    # Steps

    def _store_codebook(self, event: CodebookOffered) -> None:
        self._codebooks.put(event.codebook.id, event.codebook)
        self.log(f'serving: codebook {event.codebook.id}')

    def _store_grant(self, event: m.Grant) -> None:
        self._granted.put(event.cycle_id, event.user)

    def _apply_band(self, event: m.RhsCommand) -> None:
        """Report that the configurations of a band are applied."""
        self._cycle_id, self._unknown_logged = event.cycle_id, False
        applied = self._applied.get(event.cycle_id, set())
        self._applied.put(event.cycle_id, applied | {(event.band, event.codebook_id)})
        analog = self._codebooks.take(event.codebook_id).analog[event.band]
        self.send(m.derive(m.RhsConfiguration, event, mode=m.Mode.POSITIONING, analog=analog))

    def _apply_beam(self, event: m.Beam) -> None:
        """Report that the configuration of a beam is applied."""
        self._beam_sender = event.sender
        self.send(m.derive(
            m.RhsConfiguration, event, mode=m.Mode.TRANSMISSION, analog=event.analog[None]))

    def _log_unknown_codebook(self, event: m.RhsCommand | m.Beam) -> None:
        """Log that a codebook is rejected, but only once until the next executed command."""
        if not self._unknown_logged:
            self._unknown_logged = True
            self.log(f'codebook {event.codebook_id!r} rejected; in use: '
                     f'{self._codebooks.in_use!r}, known: {len(self._codebooks)}, library: '
                     f'{self._library_id}',
                     warning=True, key='rejected codebook')

    TABLE = (
        *on(CodebookOffered, 'codebook')(
            Row(ANY, (_store_codebook,))),
        *on(m.Grant, 'grant')(
            Row(ANY, (_store_grant,))),
        *on(m.RhsCommand, 'command')(
            Row(ANY, (_log_unknown_codebook,), guard=_unknown_codebook,
                outcome=Outcome.WRONG_CODEBOOK),
            # The base station repeats a command if the answer may have been lost.
            Row(ANY, (_apply_band,), guard=_repeats_command, outcome=Outcome.DUPLICATE),
            Row(ANY, guard=_was_executed, outcome=Outcome.STALE_COMMAND),
            Row(ANY, (_apply_band,), RhsControllerState.POSITIONING)),
        *on(m.Beam, 'beam', {
            _wrong_cycle: Outcome.WRONG_CYCLE, _wrong_user: Outcome.WRONG_USER,
            _wrong_instance: Outcome.WRONG_INSTANCE})(
            Row(ANY, (_log_unknown_codebook,), guard=_wrong_codebook,
                outcome=Outcome.WRONG_CODEBOOK),
            Row((RhsControllerState.POSITIONING,), (_apply_beam,),
                RhsControllerState.TRANSMITTING),
            Row((RhsControllerState.TRANSMITTING,), (_apply_beam,), outcome=Outcome.DUPLICATE)),
    )
