"""The front end: a surface and a radio, and the emulated channel in front of them.

The channel has a line of sight, multipath, and losses and delays of messages. Surface and radio
may be hardware; their faults are those of a measurement, and no signals are sent for it.
"""

import dataclasses
import heapq
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from rhs_isac_ros.frontend import FrontEnd, RadioFault, Sounding, SurfaceFault
from rhs_isac_ros.link import Beamformer, actual_capacity
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import DeclaredElements, SurfaceEstimate, draw_surface
from rhs_isac_ros.model.geometry import frame_times_s
from rhs_isac_ros.model.impairments import draw_factors
from rhs_isac_ros.model.los import direct_gain, draw_blocked
from rhs_isac_ros.model.multipath import draw_multipath, time_correlation
from rhs_isac_ros.model.surface import NOMINAL, Response, element_signals, feed_signals
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import REMEMBERED_CYCLES, NewestDict, Role
from rhs_isac_ros.protocol.settings import Impairments, PendingSettings
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.plugins import trace_of

# Number of users whose multipath is kept. With more users, the time between two cycles of a user
# usually far exceeds the coherence time.
_MAX_USERS = 32
# Maximum number of messages of each kind that wait for related messages. Older ones belong to
# cycles that can no longer be completed.
_MAX_PENDING = 256


class Fading:
    """Draws multipath gains, which may be correlated over the cycles of a user.

    The gains of a cycle are rho h + sqrt(1 - rho^2) w, where h are the gains of the user's
    previous cycle, rho is the correlation of Eq. (4) for the time between the two cycles, and w is
    a new draw that depends only on the seed, the user, the cycle and the band. In each cycle, the
    gains have the distribution of Eq. (2) to (4). Consecutive cycles of a user have the
    correlation of Eq. (4), which is negative for some intervals. For cycles further apart, the
    correlations in between multiply. Draws that follow Eq. (4) would need all earlier gains.

    If the scenario has a channel file, the file replaces the multipath, and the gains are 0.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        # The first draw factorises covariances. Draw once now, so that no cycle is delayed.
        if not scenario.channel:
            draw_multipath(scenario, 0, 1, np.random.default_rng(0))
        # Time [s] and gains of the latest cycle of each user.
        self._latest: NewestDict[int, tuple[float, list[np.ndarray]]] = NewestDict(_MAX_USERS)

    def gains(self, user: int, cycle_id: int, now_s: float, *, memory: bool) -> list[np.ndarray]:
        """Return the gains of a cycle for each band, complex128 [N_SB, F, N_E].

        `now_s` is the time of the cycle [s]. Without `memory`, the gains are a new draw.
        """
        scenario = self._scenario
        shape = scenario.n_subbands, scenario.n_frames, scenario.n_elements
        if scenario.channel:
            return [np.zeros(shape, complex)] * scenario.n_bands
        gains = [draw_multipath(scenario, band, 1, streams.generator(
            self._seed, streams.CHANNEL, user, cycle_id, band)).reshape(shape)
            for band in range(scenario.n_bands)]
        if memory and user in self._latest:
            before_s, previous = self._latest[user]
            correlation = time_correlation(scenario, now_s - before_s)
            for band, (earlier, rho) in enumerate(zip(previous, correlation, strict=True)):
                gains[band] = rho * earlier + np.sqrt(1 - rho**2) * gains[band]
        self._latest.put(user, (now_s, gains))
        return gains


class Delivery:
    """The emulated delivery of messages, with random losses, duplicates and delays."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng, self._serial = rng, itertools.count()
        # A heap of arrival times [s], serial numbers, which break ties, and messages.
        self.in_flight: list[tuple[float, int, m.Message]] = []

    def send(self, message: m.Message, impairments: Impairments, now_s: float) -> str:
        """Send a message at `now_s` [s]; return 'emulated_loss', 'emulated_double' or ''."""
        # The number of draws is the same for each message, so that no outcome shifts later draws.
        loss, duplication, *delays = self._rng.random(4)
        if loss < impairments.loss_probability:
            return 'emulated_loss'
        is_doubled = duplication < impairments.double_probability
        for delay in delays[:1 + is_doubled]:
            arrival_s = now_s + impairments.delay_s + impairments.jitter_s * delay
            heapq.heappush(self.in_flight, (arrival_s, next(self._serial), message))
        return 'emulated_double' if is_doubled else ''

    def arrived(self, now_s: float) -> list[m.Message]:
        """Remove and return the messages that have arrived at or before `now_s` [s], in order."""
        messages = []
        while self.in_flight and self.in_flight[0][0] <= now_s:
            messages.append(heapq.heappop(self.in_flight)[2])
        return messages


@dataclasses.dataclass
class _Cycle:
    """The movement of the user in a cycle, and the resulting channel."""

    truth: m.GroundTruth
    # Position at the reference time, in the frame of the surface, float64 [1, 3].
    position: np.ndarray
    multipath: list[np.ndarray]  # of each band, complex128 [N_SB, F, N_E]
    # Whether the user has no direct path, bool [1].
    blocked: np.ndarray
    # Gains of the direct path, or of the paths in a channel file, of each band: complex128
    # [N_SB, F, N_E].
    los: list[np.ndarray]
    # Factors that multiply all signals, complex128 [N_B, N_SB, F]; None if all are 1.
    factors: np.ndarray | None
    # Capacity of the applied beam [bit/s]; None until a beam is applied.
    rate_bps: float | None = None


@dataclasses.dataclass(frozen=True)
class _Exchange:
    """A message of a cycle, and the configurations that the surface shows for its answer."""

    event: m.Pilot | m.Data
    cycle: _Cycle
    configurations: np.ndarray

    def covers(self, event: m.Pilot | m.Data, cycle: _Cycle) -> bool:
        """Return whether another message of the cycle asks for the same answer."""
        own = self.event
        return cycle is self.cycle and (
            isinstance(own, m.Pilot) and isinstance(event, m.Pilot) and own.band == event.band
            or isinstance(own, m.Data) and isinstance(event, m.Data)
            and own.direction is event.direction)


def apply_patterns(
        front_end: FrontEnd, request: events.ApplyPatterns
) -> events.PatternsApplied | events.FrontEndFailed:
    """Show and measure configurations one after the other, until one fails."""
    feeds = None
    try:
        if request.sounding:
            feeds = front_end.sound(request.configurations, request.sounding)
        else:
            front_end.show(request.configurations)
    except SurfaceFault as fault:
        return events.FrontEndFailed(request.key, f'surface_{fault.kind}', f'surface: {fault}')
    except RadioFault as fault:
        return events.FrontEndFailed(
            request.key, 'radio', f'radio: {fault}', trace_of(fault.__cause__))
    # The surface cannot show such a configuration, or a driver of another package fails.
    except Exception as error:
        kind = type(error).__name__
        return events.FrontEndFailed(
            request.key, f'surface_{kind}', f'surface: {kind}: {error}', trace_of(error))
    return events.PatternsApplied(request.key, feeds)


class Channel(Role):
    """The role that steps the front end, and emulates the channel and the loss of messages.

    It answers pilots once it has received the true position of the user and the configurations
    for the band. It answers data once it has received the position, the beam and its
    configuration. Before each answer, the surface shows the configurations of the frames, and the
    radio measures pilots. If one of these fails, there is no answer: the base station asks again,
    and finally gives the cycle up. The user moves straight during the emulated frames, which have
    the times of `frame_times_s`, however long surface and radio take. Changed impairments take
    effect with the next cycle. If `states` are given, the elements have the coefficients that this
    estimate expects.
    """

    SENDS = (m.FeedSignals, m.Data)
    RECEIVES = (m.GroundTruth, m.RhsConfiguration, m.Pilot, m.Beam, m.Data)

    def __init__(self, scenario: Scenario, seed: int,
                 impairments: Impairments | None = None,
                 states: SurfaceEstimate | None = None) -> None:
        super().__init__()
        self._scenario, self._seed, self._states = scenario, seed, states
        self._settings = PendingSettings(impairments or Impairments())
        self._use(self._settings.in_use)
        self._cycle: _Cycle | None = None
        self._fading = Fading(scenario, seed)
        self._delivery = Delivery(streams.generator(seed, streams.AIR))
        # Id, user, instance and position of each cycle that has begun.
        self._begun: NewestDict[tuple[float, ...], None] = NewestDict(REMEMBERED_CYCLES)
        # Configurations and beams of the current cycle and of future ones.
        self._configurations: NewestDict[tuple[int, m.Mode, int], np.ndarray] = NewestDict(
            _MAX_PENDING)
        self._beams: NewestDict[tuple[int, int], m.Beam] = NewestDict(_MAX_PENDING)
        # Messages to answer, in order, by cycle and serial number.
        self._pending: NewestDict[tuple[int, int], m.Pilot | m.Data] = NewestDict(_MAX_PENDING)
        self._applying: dict[tuple[int, int], _Exchange] = {}
        # Description of the present fault of the front end, or empty.
        self._fault = ''
        self._serial = itertools.count()

    def _use(self, impairments: Impairments) -> None:
        """Apply impairments; draw the surface from the seed, so the same elements fail again."""
        self._deviating = impairments.applied_to(self._scenario)
        self._elements = (
            None if DeclaredElements(self._deviating).is_exact
            else draw_surface(self._deviating, streams.generator(self._seed, streams.SURFACE)))
        self._pose = impairments.pose_of(self._scenario)

    def next_deadline(self) -> float | None:
        """Return the time at which the next message arrives [s], or None if none is in flight."""
        return self._delivery.in_flight[0][0] if self._delivery.in_flight else None

    def status(self) -> Mapping[str, str]:
        """Return the impairments in use, the pending ones and the fault of the front end."""
        warning = {'warning.front_end': self._fault} if self._fault else {}
        return self._settings.describe() | warning

    def react(self, event: events.Event) -> None:
        """Process an event, then send the signals and data whose delay has passed."""
        match event:
            case events.SettingsOffered(settings):
                self._settings.latest = settings
            case m.GroundTruth() if event.cycle_id:
                self._begin(event)
            case m.RhsConfiguration():
                self.count(events.Outcome.OVERFLOW, self._configurations.put(
                    (event.cycle_id, event.mode, event.band), event.analog))
            case m.Beam():
                self._keep_beam(event)
            case m.Pilot() | m.Data(stage=m.Stage.OFFERED):
                self.count(events.Outcome.OVERFLOW, self._pending.put(
                    (event.cycle_id, next(self._serial)), event))
            case events.PatternsApplied():
                self._resume(event)
            case events.FrontEndFailed():
                del self._applying[event.key]
                self._fault = event.text
                self.counters[event.kind] += 1
                self.log(f'{event.text}{event.trace}', warning=True, key=event.kind)
        if self._cycle and isinstance(event, m.Message):
            if isinstance(event, m.Beam | m.RhsConfiguration):
                # Compute the capacity, which is the same in both directions, before data arrive.
                self._cycle.rate_bps = self._rate_bps(self._cycle)
            self._answer_pending(self._cycle)
        for message in self._delivery.arrived(self.now_s):
            self.send(message)

    def _keep_beam(self, beam: m.Beam) -> None:
        """Store a beam unless another instance has sent one for the same cycle and user."""
        key = beam.cycle_id, beam.user
        known = self._beams.get(key)
        if known and not m.same_instance(known.sender, beam.sender):
            self.count(events.Outcome.WRONG_INSTANCE)
        else:
            self.count(events.Outcome.OVERFLOW, self._beams.put(key, beam))

    def _begin(self, truth: m.GroundTruth) -> None:
        # A restarted base station may repeat a cycle id, with the user at another position.
        key = truth.cycle_id, truth.user, truth.sender, *truth.position.tolist()
        if key in self._begun:
            self.count(events.Outcome.DUPLICATE)
            return
        self._begun.put(key, None)
        if changes := self._settings.apply():
            self.log(changes)
            self._use(self._settings.in_use)
        position = self._pose.to_surface(truth.position[None])
        shifts = frame_times_s(self._scenario)[..., None] * self._pose.vectors_to_surface(
            truth.velocity)
        if position[0, 0] + min(shifts[..., 0].min(), 0.0) <= 0:
            # Another surface of the site may have the user in sight.
            self.count(events.Outcome.BEHIND)
            return
        multipath = self._fading.gains(
            truth.user, truth.cycle_id, truth.time_s(self.now_s),
            memory=self._settings.in_use.multipath_memory)
        self._cycle = self._draw(truth, position, shifts, multipath)
        self.count(events.Outcome.STALE, sum(key[0] != truth.cycle_id for key in self._pending))
        stores: tuple[NewestDict[Any, Any], ...] = (
            self._pending, self._configurations, self._beams)
        for store in stores:
            for stale in [key for key in store if key[0] != truth.cycle_id]:
                del store[stale]
        self._cycle.rate_bps = self._rate_bps(self._cycle)

    def _draw(self, truth: m.GroundTruth, position: np.ndarray, shifts: np.ndarray,
              multipath: list[np.ndarray]) -> _Cycle:
        """Draw the channel of a cycle in advance, so that answers to pilots are not delayed.

        `shifts`, [N_B, F, 3] [m], are the distances from the position in each frame.
        """
        scenario, seed, user = self._scenario, self._seed, truth.user
        blocked = draw_blocked(
            self._deviating, 1, streams.generator(seed, streams.BLOCKAGE, user))
        factors = draw_factors(
            self._deviating, 1, streams.generator(seed, streams.USER_DEVIATION, user),
            streams.generator(seed, streams.CYCLE_DEVIATION, user, truth.cycle_id))
        if factors is not None:
            factors = factors.reshape(scenario.n_bands, scenario.n_subbands, scenario.n_frames)
        los = [np.swapaxes(direct_gain(
            scenario, np.repeat(position, len(of_band), axis=0), band,
            np.repeat(blocked, len(of_band)), of_band), 0, 1)
            for band, of_band in enumerate(shifts)]
        return _Cycle(truth, position, multipath, blocked, los, factors)

    def _answer_pending(self, cycle: _Cycle) -> None:
        for key, event in list(self._pending.items()):
            if event.cycle_id != cycle.truth.cycle_id:
                continue
            if event.user != cycle.truth.user:
                self.count(events.Outcome.WRONG_USER)
            elif _is_from_other_instance(event, cycle.truth):
                self.count(events.Outcome.WRONG_INSTANCE)
            elif any(exchange.covers(event, cycle) for exchange in self._applying.values()):
                self.count(events.Outcome.DUPLICATE)
            elif (configurations := self._configurations_for(event, cycle)) is not None:
                sounding = self._sounding(event, cycle, configurations)
                self._applying[key] = _Exchange(event, cycle, configurations)
                self.act(events.ApplyPatterns(key, configurations, sounding))
            else:
                continue
            del self._pending[key]

    def _configurations_for(
            self, event: m.Pilot | m.Data, cycle: _Cycle) -> np.ndarray | None:
        """Return what the surface is to show for a message, [F, N_E]; None if still unknown."""
        if isinstance(event, m.Pilot):
            return self._configurations.get((event.cycle_id, m.Mode.POSITIONING, event.band))
        steered = self._steered(cycle)
        return steered and steered[1]

    def _steered(self, cycle: _Cycle) -> tuple[m.Beam, np.ndarray] | None:
        """Return the beam of a cycle, and what the surface shows for it, [1, N_E]."""
        beam = self._beams.get((cycle.truth.cycle_id, cycle.truth.user))
        if beam is None:
            return None
        shown = self._configurations.get((beam.cycle_id, m.Mode.TRANSMISSION, beam.band))
        return None if shown is None else (beam, shown)

    def _resume(self, applied: events.PatternsApplied) -> None:
        """Answer a message whose configurations were shown, unless its cycle is over."""
        if self._fault:
            self._fault = ''
            self.log_state('front end', 'surface and radio work again', False)
        exchange = self._applying.pop(applied.key)
        if exchange.cycle is not self._cycle:
            self.count(events.Outcome.STALE)
        elif impaired := self._delivery.send(
                self._answer(exchange, applied.feeds), self._settings.in_use, self.now_s):
            self.counters[impaired] += 1

    def _answer(self, exchange: _Exchange, feeds: np.ndarray | None) -> m.Message:
        event, cycle = exchange.event, exchange.cycle
        if isinstance(event, m.Pilot):
            return m.derive(m.FeedSignals, event, stamp_ns=event.stamp_ns,
                            user_instance=event.sender, signals=feeds)
        # A plug-in may have failed when the beam arrived.
        rate_bps = self._rate_bps(cycle) if cycle.rate_bps is None else cycle.rate_bps
        assert rate_bps is not None
        # Data in excess of the true capacity are lost.
        bits = min(event.bits, rate_bps * event.duration_s // 1)
        return dataclasses.replace(event, stage=m.Stage.DELIVERED, bits=bits)

    def _response(self, band: int) -> Response:
        """Return the response of the elements in a band: known states, and then errors."""
        slope, offset, gain = NOMINAL
        if self._states:
            slope, offset, gains = self._states.response
            gain = np.ravel(gains)[band]
        if self._elements:
            errors, stuck, _ = self._elements.response
            slope, offset = errors * slope, errors * offset + stuck / gain
        return slope, offset, gain

    def _sounding(self, event: m.Pilot | m.Data, cycle: _Cycle,
                  configurations: np.ndarray) -> Sounding | None:
        """Return the emulated air in each frame of a pilot; None for data."""
        if isinstance(event, m.Data):
            return None
        band = event.band
        elements = element_signals(cycle.los[band], cycle.multipath[band], 1.0)
        feeds = feed_signals(self._scenario, band, configurations, elements.swapaxes(0, 1),
                             self._response(band))
        if cycle.factors is not None:
            feeds = feeds * cycle.factors[band].T[:, :, None]
        return Sounding(event.cycle_id, band, event.symbols, feeds, event.user,
                        cycle.truth.position, cycle.truth.velocity, event.stamp_ns)

    def _rate_bps(self, cycle: _Cycle) -> float | None:
        """Return the true capacity [bit/s]; None until the beam and its configuration arrive."""
        if (steered := self._steered(cycle)) is None:
            return None
        beam, shown = steered
        digital = beam.digital
        if cycle.factors is not None:
            # The phases of the factors do not change the capacity.
            digital = digital * np.abs(cycle.factors[beam.band, 0, 0])
        return float(actual_capacity(
            self._scenario,
            Beamformer(shown[0], digital, beam.band, self._response(beam.band)),
            cycle.position, cycle.blocked)[0])


def _is_from_other_instance(event: m.Pilot | m.Data, truth: m.GroundTruth) -> bool:
    """Return whether pilots or uplink data come from another instance than `truth`."""
    is_downlink = isinstance(event, m.Data) and event.direction is m.Direction.DOWNLINK
    return not is_downlink and not m.same_instance(event.sender, truth.sender)
