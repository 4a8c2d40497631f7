"""The receiver of a surface that follows the cycles of another surface's base station."""

import enum

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.cycle import Reception, SignalCollector
from rhs_isac_ros.protocol.events import CodebookOffered, Outcome, SettingsOffered
from rhs_isac_ros.protocol.role import ANY, Row, on
from rhs_isac_ros.protocol.settings import PendingSettings, ReceiverSettings


class ReceiverState(enum.Enum):
    """States of the receiver."""

    LISTENING = 'listening'  # waits for a grant
    SOUNDING = 'sounding'    # waits for the feed signals of all bands


class Receiver(SignalCollector):
    """The role that receives the pilots of each granted cycle with a surface of its own.

    Pilots are uplink, so all surfaces receive the same ones. The receiver commands its surface
    when another surface's base station grants a cycle. It requests no repetition: signals that
    are incomplete when the next cycle begins are discarded.
    """

    SENDS = (m.RhsCommand, m.ReceivedSignals)

    STATES = ReceiverState

    def __init__(self, scenario: Scenario, seed: int, settings: ReceiverSettings | None = None
                 ) -> None:
        super().__init__(ReceiverState.LISTENING, scenario, seed, Reception(0))
        self._settings = PendingSettings(settings or ReceiverSettings())
        self._codebook: Codebook | None = None

    def status(self) -> dict[str, str]:
        """Return the settings and the codebook in use."""
        return self._settings.describe() | {'codebook_id': self._cycle.codebook_id}

    # Guards

    def _without_codebook(self, event: m.Grant) -> bool:
        return self._codebook is None

    def _same_cycle(self, event: m.Grant) -> bool:
        return event.cycle_id == self._cycle.cycle_id and event.user == self._cycle.user

    # Steps

    def _store_codebook(self, event: CodebookOffered) -> None:
        self._codebook = event.codebook

    def _apply_settings(self, event: SettingsOffered) -> None:
        self._settings.latest = event.settings
        self.log(self._settings.apply())

    def _give_up(self, event: m.Grant) -> None:
        user = self._cycle.user
        self.log_state(f'signals of user {user}', f'cycle {self._cycle.cycle_id}: no signals of '
                       f'user {user} in the bands {self._silent_bands()}', True)

    def _begin(self, event: m.Grant) -> None:
        """Begin a cycle, and command the configurations of all bands."""
        self._cycle = Reception(event.cycle_id, self._codebook, event.user,
                                event.user_instance)
        for band in sorted(self._bands):
            self.send(m.derive(m.RhsCommand, self._cycle, band=band))

    def _send_signals(self, event: m.FeedSignals) -> None:
        cycle = self._cycle
        self.send(self._combined(self._settings.in_use.receiver_noise))
        self.log_state(f'signals of user {cycle.user}', f'cycle {cycle.cycle_id}: signals of '
                       f'user {cycle.user} in all bands', False)

    TABLE = (
        *on(CodebookOffered, 'codebook')(Row(ANY, (_store_codebook,))),
        *on(SettingsOffered, 'settings')(Row(ANY, (_apply_settings,))),
        *on(m.Grant, 'grant', {_without_codebook: Outcome.WRONG_CODEBOOK,
                               _same_cycle: Outcome.DUPLICATE})(
            Row((ReceiverState.SOUNDING,), (_give_up, _begin), ReceiverState.SOUNDING,
                outcome=Outcome.INCOMPLETE),
            Row((ReceiverState.LISTENING,), (_begin,), ReceiverState.SOUNDING)),
        *on(m.FeedSignals, 'signals', SignalCollector._OF_SIGNALS)(
            Row((ReceiverState.SOUNDING,), (SignalCollector._store_signals, _send_signals),
                ReceiverState.LISTENING, guard=SignalCollector._last_signals),
            Row((ReceiverState.SOUNDING,), (SignalCollector._store_signals,))),
    )
