"""The emulated channel: line of sight, multipath, surface, and losses and delays of messages."""

import dataclasses
import heapq
import itertools
from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.link import Beam, actual_capacity
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import DeclaredElements, draw_surface
from rhs_isac_ros.model.impairments import draw_factors
from rhs_isac_ros.model.los import direct_gain, draw_blocked
from rhs_isac_ros.model.multipath import draw_multipath, time_correlation
from rhs_isac_ros.model.surface import element_signals, feed_signals
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Action, Event, Outcome, Send, SettingsOffered, Timeout
from rhs_isac_ros.protocol.role import NewestDict, PlainRole, Role
from rhs_isac_ros.protocol.settings import Impairments, PendingSettings
from rhs_isac_ros.support import streams

# Number of users whose multipath is kept. With more, the time between two cycles of a user is far
# longer than the coherence time.
_MAX_USERS = 32


class Fading:
    """Source of multipath gains that depend on the seed and on the times of a user's cycles.

    The gains of a cycle are rho h + sqrt(1 - rho^2) w, where h are the gains of the user's
    previous cycle, rho is Eq. (4) for the time between them, and w is a new draw that depends on
    the seed, the user, the cycle and the band alone. Every cycle has the distribution of Eq. (2)
    to (4), and consecutive cycles have the correlation of Eq. (4); it is negative for some times.
    Over several cycles the correlation is the product of these, not Eq. (4): the exact
    conditional distribution would need all earlier cycles.

    With a channel file there is no fading: the paths of a user move with it.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        # The first draw factorises covariances. Draw once now, so that it does not delay the first
        # cycle.
        if not scenario.channel:
            draw_multipath(scenario, 0, 1, np.random.default_rng(0))
        # Time [s] and gains of the latest cycle of each user.
        self._latest: NewestDict[int, tuple[float, list[np.ndarray]]] = NewestDict(_MAX_USERS)

    def gains(self, user: int, cycle_id: int, now_s: float, *, memory: bool) -> list[np.ndarray]:
        """Return the gains of a cycle for each band, complex128 [N_SB, F, N_E].

        Without memory, they are independent of the previous cycle.
        """
        scenario = self._scenario
        if scenario.channel:
            shape = scenario.n_subbands, scenario.n_frames, scenario.n_elements
            return [np.zeros(shape, complex)] * scenario.n_bands
        gains = [
            draw_multipath(
                scenario, band, 1,
                streams.generator(self._seed, streams.CHANNEL, user, cycle_id, band)
            ).reshape(scenario.n_subbands, scenario.n_frames, scenario.n_elements)
            for band in range(scenario.n_bands)]
        if memory and user in self._latest:
            before_s, previous = self._latest[user]
            lag = np.array((now_s - before_s) / scenario.frame_duration_s)
            for band, earlier in enumerate(previous):
                rho = float(time_correlation(scenario, band, lag, np.array(0.0)))
                gains[band] = rho * earlier + np.sqrt(1 - rho**2) * gains[band]
        self._latest.put(user, (now_s, gains))
        return gains


# Maximum number of messages of each kind kept until related messages arrive. The cycle of an older
# message can no longer be completed.
_MAX_PENDING = 256
# Number of cycles kept to recognise late and duplicate positions.
_MAX_REMEMBERED = 8


class _Drawn:
    """Drawn impairments: of the surface, of users and of cycles.

    Each depends on the seed, the user and the cycle alone, so that a failed element remains
    failed, and a gain stays with its user.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        self.surface = (
            None if DeclaredElements(scenario).is_exact
            else draw_surface(scenario, streams.generator(seed, streams.SURFACE)))

    def blocked(self, truth: m.GroundTruth) -> np.ndarray:
        """Return whether the user has no direct path, bool [1]."""
        return draw_blocked(self._scenario, 1, streams.generator(
            self._seed, streams.BLOCKAGE, truth.user))

    def factors(self, truth: m.GroundTruth) -> np.ndarray | None:
        """Return the factors of the signals of a cycle [N_B, N_SB, F], or None if all are 1."""
        scenario, seed = self._scenario, self._seed
        factors = draw_factors(
            scenario, 1, streams.generator(seed, streams.USER_DEVIATION, truth.user),
            streams.generator(seed, streams.CYCLE_DEVIATION, truth.user, truth.cycle_id))
        return None if factors is None else factors.reshape(
            scenario.n_bands, scenario.n_subbands, scenario.n_frames)


class _Cycle:
    """The true position of a cycle and the channel that results from it.

    Attributes
    ----------
    los
        Gains of the direct path or of the paths of a channel file in each band, complex128
        [N_SB, N_E].
    multipath
        Multipath gains of each band, complex128 [N_SB, F, N_E].
    blocked
        Whether the user has no direct path, bool [1].
    surface
        Errors of the elements; None if there are none.
    factors
        Factors of all signals, complex128 [N_B, N_SB, F]; None if there are none.
    """

    def __init__(self, scenario: Scenario, truth: m.GroundTruth, multipath: list[np.ndarray],
                 drawn: _Drawn) -> None:
        self.truth, self.multipath = truth, multipath
        # Computed here rather than on the first pilot, while other roles prepare the cycle.
        self.blocked = drawn.blocked(truth)
        self.los = [direct_gain(scenario, truth.position[None], band, self.blocked)[0]
                    for band in range(scenario.n_bands)]
        self.surface, self.factors = drawn.surface, drawn.factors(truth)


class Channel(PlainRole):
    """The role of the channel.

    It answers the pilots of a band or a data packet once it has received the true position of the
    user and the configuration of the surface, in any order. The position applies to the whole
    cycle: messages take longer in the network than the signals that they emulate.

    Parameters
    ----------
    seed
        Seed of the multipath and of the impairments, see `Fading`.
    impairments
        Initial impairments of the signals; by default those of the scenario. Others take effect
        with the next cycle after they are offered.
    """

    SENDS = (m.FeedSignals, m.Data)
    RECEIVES = (m.GroundTruth, m.RhsConfiguration, m.Pilot, m.Beam, m.Data)

    def __init__(self, scenario: Scenario, seed: int,
                 impairments: Impairments | None = None) -> None:
        super().__init__()
        self._scenario, self._seed = scenario, seed
        self._draw(impairments or Impairments())
        self._cycle: _Cycle | None = None
        self._fading = Fading(scenario, seed)
        # Cycle, user, instance and position of the cycles begun.
        self._begun: NewestDict[tuple[float, ...], None] = NewestDict(_MAX_REMEMBERED)
        # Configurations and beams of the current and of future cycles.
        self._configurations: NewestDict[tuple[int, m.Mode, int], np.ndarray] = NewestDict(
            _MAX_PENDING)
        self._beams: NewestDict[tuple[int, int], m.Beam] = NewestDict(_MAX_PENDING)
        # Messages to answer, in order, by serial number.
        self._pending: NewestDict[int, m.Pilot | m.Data] = NewestDict(_MAX_PENDING)
        self._serial = itertools.count()

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Process a message and return feed signals and delivered data."""
        discarded = 0
        match event:
            case SettingsOffered(Impairments() as impairments):
                self._draw(impairments)
                return []
            case m.GroundTruth() if event.cycle_id:
                self._begin(event, now_s)
            case m.RhsConfiguration():
                discarded = self._configurations.put(
                    (event.cycle_id, event.mode, event.band), event.analog)
            case m.Beam():
                discarded = self._keep_beam(event)
            case m.Pilot() | m.Data(stage=m.Stage.OFFERED):
                discarded = self._pending.put(next(self._serial), event)
            case _:
                return []
        self.count(Outcome.OVERFLOW, discarded)
        return self._answer_pending(self._cycle) if self._cycle else []

    def _keep_beam(self, beam: m.Beam) -> int:
        """Store a beam unless another instance sent one for the cycle; return the overflow."""
        key = beam.cycle_id, beam.user
        known = self._beams.get(key)
        if known and not m.same_instance(known.sender, beam.sender):
            self.count(Outcome.WRONG_INSTANCE)
            return 0
        return self._beams.put(key, beam)

    def _draw(self, impairments: Impairments) -> None:
        self._has_memory = impairments.multipath_memory
        self._drawn = _Drawn(impairments.applied_to(self._scenario), self._seed)

    def _begin(self, truth: m.GroundTruth, now_s: float) -> None:
        # A restarted base station may repeat a cycle id, with the user at another position.
        key = truth.cycle_id, truth.user, truth.sender, *truth.position.tolist()
        if key in self._begun:
            self.count(Outcome.DUPLICATE)
            return
        self._begun.put(key, None)
        multipath = self._fading.gains(
            truth.user, truth.cycle_id, truth.time_s(now_s), memory=self._has_memory)
        self._cycle = _Cycle(self._scenario, truth, multipath, self._drawn)
        stale = [serial for serial, event in self._pending.items()
                 if event.cycle_id != truth.cycle_id]
        for serial in stale:
            del self._pending[serial]
        self.count(Outcome.STALE, len(stale))
        for configured in [key for key in self._configurations if key[0] != truth.cycle_id]:
            del self._configurations[configured]
        for steered in [key for key in self._beams if key[0] != truth.cycle_id]:
            del self._beams[steered]

    def _answer_pending(self, cycle: _Cycle) -> list[Action]:
        actions: list[Action] = []
        for serial, event in list(self._pending.items()):
            if event.cycle_id != cycle.truth.cycle_id:
                continue
            if event.user != cycle.truth.user:
                self.count(Outcome.WRONG_USER)
                del self._pending[serial]
                continue
            if _is_from_other_instance(event, cycle.truth):
                self.count(Outcome.WRONG_INSTANCE)
                del self._pending[serial]
                continue
            answer = self._answer(event, cycle)
            if answer is not None:
                actions.append(Send(answer))
                del self._pending[serial]
        return actions

    def _answer(self, event: m.Pilot | m.Data, cycle: _Cycle) -> m.Message | None:
        """Return the answer to a message of the cycle, or None if something is missing."""
        if isinstance(event, m.Data):
            return self._deliver(event, cycle)
        applied = self._applied(m.Mode.POSITIONING, event.band, cycle)
        return None if applied is None else self._propagate(event, cycle, applied)

    def _applied(self, mode: m.Mode, band: int, cycle: _Cycle) -> np.ndarray | None:
        """Return the configurations that the surface reported [F or 1, N_E], or None."""
        return self._configurations.get((cycle.truth.cycle_id, mode, band))

    def _propagate(self, pilot: m.Pilot, cycle: _Cycle, applied: np.ndarray) -> m.FeedSignals:
        band = pilot.band
        if cycle.surface is not None:
            applied = cycle.surface.applied(applied)
        feeds = np.stack([
            feed_signals(self._scenario, band, configuration, element_signals(
                cycle.los[band], cycle.multipath[band][:, frame], symbol))
            for frame, (configuration, symbol) in enumerate(
                zip(applied, pilot.symbols, strict=True))])
        if cycle.factors is not None:
            feeds = feeds * cycle.factors[band].T[:, :, None]
        return m.FeedSignals(
            cycle_id=pilot.cycle_id, stamp_ns=pilot.stamp_ns, user=pilot.user,
            user_instance=pilot.sender, band=band, signals=feeds)

    def _deliver(self, data: m.Data, cycle: _Cycle) -> m.Data | None:
        """Return the data within the capacity of the true channel; the rest is lost."""
        truth = cycle.truth
        beam = self._beams.get((truth.cycle_id, truth.user))
        if beam is None:
            return None
        applied = self._applied(m.Mode.TRANSMISSION, beam.band, cycle)
        if applied is None:
            return None
        configuration, digital = applied[0], beam.digital
        if cycle.surface is not None:
            configuration = cycle.surface.applied(configuration)
        if cycle.factors is not None:
            # Only the magnitude, the gain of the user, changes the capacity.
            digital = digital * np.abs(cycle.factors[beam.band, 0, 0])
        used = Beam(configuration, digital, beam.band)
        rate_bps = float(actual_capacity(
            self._scenario, used, truth.position[None], cycle.blocked)[0])
        bits = min(data.bits, rate_bps * data.duration_s // 1)
        return dataclasses.replace(data, stage=m.Stage.DELIVERED, bits=bits)


def _is_from_other_instance(event: m.Pilot | m.Data, truth: m.GroundTruth) -> bool:
    """Return whether another node than the one at the true position transmits."""
    if isinstance(event, m.Data) and event.direction is m.Direction.DOWNLINK:
        return False
    return not m.same_instance(event.sender, truth.sender)


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
