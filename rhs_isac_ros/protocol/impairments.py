"""A channel that loses, duplicates, delays and reorders messages."""

import dataclasses
import heapq
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, Event, Send, SettingsOffered, Timeout
from rhs_isac_ros.protocol.role import PendingSettings, PlainRole, Role
from rhs_isac_ros.protocol.settings import setting


def _of_scenario(name: str) -> Any:
    """Declare a setting that replaces a field of the scenario."""
    declared = {field.name: field for field in dataclasses.fields(Scenario)}[name].metadata
    first_sentence = declared['text'].partition('. ')[0].rstrip('.')
    return setting(
        -1.0, f'{first_sentence}; negative: the value of the scenario.', unit=declared['unit'],
        low=-1.0, high=declared['high'])


@dataclasses.dataclass(frozen=True)
class Impairments:
    """Impairments of the air interface, and deviations from the model of the signals.

    The network does not learn of deviations that replace those of the scenario.
    """

    loss_probability: float = setting(
        0.0, 'Probability that a message is lost.', low=0.0, high=1.0)
    double_probability: float = setting(
        0.0, 'Probability that a message that arrives is duplicated.', low=0.0, high=1.0)
    delay_s: float = setting(
        0.0, 'Minimum delay of each message.', unit='s', low=0.0, high=10.0)
    jitter_s: float = setting(
        0.0, 'Maximum additional random delay; messages may be reordered.', unit='s',
        low=0.0, high=10.0)
    multipath_memory: bool = setting(
        True, 'Whether the multipath of a user is correlated over its cycles by Eq. (4); '
        'otherwise it is independent, and depends on the seed and not on times.')
    user_gain_std_db: float = _of_scenario('user_gain_std_db')
    phase_std_rad: float = _of_scenario('phase_std_rad')
    band_phase_std_rad: float = _of_scenario('band_phase_std_rad')
    timing_std_s: float = _of_scenario('timing_std_s')
    carrier_offset_std_hz: float = _of_scenario('carrier_offset_std_hz')
    element_error_rms: float = _of_scenario('element_error_rms')
    failed_element_share: float = _of_scenario('failed_element_share')

    def applied_to(self, scenario: Scenario) -> Scenario:
        """Return the scenario with the deviations that are set."""
        known = {field.name for field in dataclasses.fields(Scenario)}
        values = dataclasses.asdict(self)
        return dataclasses.replace(scenario, **{
            name: value for name, value in values.items() if name in known and value >= 0})


class ImpairedChannel(PlainRole):
    """A channel role whose outgoing messages are subject to impairments.

    The role receives new impairments as `SettingsOffered`, for the deviations of its signals.

    New impairments take effect at the start of the next cycle, when its true position arrives.

    Parameters
    ----------
    role
        A role without states and deadlines.
    impairments
        Initial impairments.
    rng
        Random source of losses, duplicates and delays.

    Attributes
    ----------
    counters
        The counters of the role, and ``emulated_loss`` and ``emulated_double``.
    """

    def __init__(self, role: Role, impairments: Impairments, rng: np.random.Generator) -> None:
        super().__init__()
        self.counters, self.SENDS, self.RECEIVES = role.counters, role.SENDS, role.RECEIVES
        self._role, self._settings, self._rng = role, PendingSettings(impairments), rng
        self._cycle_id = 0
        self._serial = itertools.count()
        # Time of arrival, serial number as a tie-break, message.
        self._in_flight: list[tuple[float, int, Send]] = []

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Pass an event to the role and return the messages that arrive by `now_s` [s]."""
        arriving: list[Action] = []
        actions: list[Action] = []
        match event:
            case Timeout():
                pass
            case SettingsOffered(impairments):
                self._settings.latest = impairments
            case _:
                arriving += self._begin_cycle(event, now_s)
                actions = self._role.handle(event, now_s)
        for action in actions:
            if isinstance(action, Send):
                self._send(action, now_s)
            else:
                arriving.append(action)
        while self._in_flight and self._in_flight[0][0] <= now_s:
            arriving.append(heapq.heappop(self._in_flight)[2])
        return arriving

    def status(self) -> Mapping[str, str]:
        """Return the impairments in use and pending, by name."""
        return self._settings.describe()

    def next_deadline(self) -> float | None:
        """Return when the next message arrives [s], or None if no message is in flight."""
        return self._in_flight[0][0] if self._in_flight else None

    def _begin_cycle(self, event: Event, now_s: float) -> list[Action]:
        if not isinstance(event, m.GroundTruth) or event.cycle_id in (0, self._cycle_id):
            return []
        self._cycle_id = event.cycle_id
        notes = self._settings.apply()
        if notes:
            self._role.handle(SettingsOffered(self._settings.in_use), now_s)
        return [*notes]

    def _send(self, action: Send, now_s: float) -> None:
        impairments = self._settings.in_use
        # The number of draws is fixed, so that the impairments of one message do not affect
        # those of others.
        loss, duplication, *delays = self._rng.random(4)
        if loss < impairments.loss_probability:
            self.counters['emulated_loss'] += 1
            return
        copies = 1
        if duplication < impairments.double_probability:
            copies = 2
            self.counters['emulated_double'] += 1
        for delay in delays[:copies]:
            arrival_s = now_s + impairments.delay_s + impairments.jitter_s * delay
            heapq.heappush(self._in_flight, (arrival_s, next(self._serial), action))
