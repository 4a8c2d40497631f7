"""All roles on one bus in memory, with a virtual clock, faults and a log of all messages."""

import dataclasses
import functools
import heapq
import itertools
import types
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from example_messages import FIXED_PLACE, example_message
from system.invariants import RECEIVES, InvariantChecker

from rhs_isac_ros.codebook import Codebook, random_codebook
from rhs_isac_ros.codebook.library import EMPTY
from rhs_isac_ros.frontend import Air, EmulatedRadio, EmulatedSurface, FrontEnd, Surface
from rhs_isac_ros.link import Beamformer, CapacityReport
from rhs_isac_ros.model import Scenario, mobility
from rhs_isac_ros.model.geometry import frame_times_s
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.measurement import received_signal
from rhs_isac_ros.model.multipath import complex_normal, draw_multipath
from rhs_isac_ros.model.surface import radiation_matrix
from rhs_isac_ros.positioning import Estimate, ModelError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol import user as user_role
from rhs_isac_ros.protocol.base_station import BaseStation
from rhs_isac_ros.protocol.channel import Channel, apply_patterns
from rhs_isac_ros.protocol.events import (
    ApplyPatterns,
    BuildEstimator,
    CodebookOffered,
    LogMessage,
    PeersChanged,
    PrepareEstimator,
    PublishTrack,
    Reply,
    RevertSettings,
    Send,
    SettingsOffered,
    Timeout,
)
from rhs_isac_ros.protocol.positioner import Positioner, build_estimator
from rhs_isac_ros.protocol.rhs_controller import RhsController
from rhs_isac_ros.protocol.settings import BaseStationSettings, Impairments, PositionerSettings
from rhs_isac_ros.protocol.transmission import Transmission
from rhs_isac_ros.ros.roster import MEMBERS, ROSTER
from rhs_isac_ros.support import streams

ROLES = {name: member.role for name, member in ROSTER.items() if member.role}
SUBSCRIPTIONS = {name: role.RECEIVES for name, role in ROLES.items()}
PEERS = {name: ROSTER[name].requires for name in ('bs', 'user')}
USE_CODEBOOKS = tuple(name for name, member in MEMBERS.items() if member.has_codebook)
LATENCY_S = 1e-3
BEACON_TIMEOUT_S = 3.0
# A model file that does not match any codebook.
UNFIT = 'unfit'


class Fixed:
    """An estimator that always returns the same position."""

    def __init__(self, name: str, position: Sequence[float] = FIXED_PLACE) -> None:
        self.name, self._position = name, np.array(position)

    def estimate(self, received: np.ndarray) -> Estimate:
        return Estimate(self._position, np.eye(3))


def plain_choice(scenario: Scenario, position: np.ndarray, covariance_m2: np.ndarray,
                 bands: Sequence[int], surface: Any) -> Any:
    """Take the place of `choose_beam`, with a beam that depends on the position alone."""
    angles = np.arange(scenario.n_elements) * np.abs(position).sum()
    shape = scenario.n_subbands, scenario.n_feeds
    digital = np.full(shape, (scenario.max_power_w / np.prod(shape))**0.5 + 0j)
    return types.SimpleNamespace(
        beam=Beamformer(0.5 + 0.5 * np.cos(angles), digital, bands[0]), expected_bps=1e6)


PLAIN_BEAMS = {'choose': plain_choice, 'evaluate': lambda *_: CapacityReport(1e6, 1.1e6)}


class Sent(NamedTuple):
    time_s: float
    sender: str
    message: m.Message


class Logged(NamedTuple):
    time_s: float
    role: str
    message: LogMessage


Transport = Callable[[m.Message, str], Iterable[tuple[float, m.Message]]]


def on_time(message: m.Message, recipient: str) -> list[tuple[float, m.Message]]:
    """Deliver a message once; a transport returns pairs of a delay [s] and a delivered message."""
    return [(LATENCY_S, message)]


class Fault:
    """Affects `n` messages of a class to a recipient, which have the given fields.

    The first `skip` of them are on time. The others arrive once after each of the delays, or not
    at all; `alter` changes those that arrive.
    """

    def __init__(self, kind: type[m.Message], recipient: str, *delays_s: float, n: float = np.inf,
                 skip: int = 0, alter: Callable[[Any], m.Message] = lambda message: message,
                 **fields: Any) -> None:
        self.kind, self.recipient, self.delays_s, self.alter = kind, recipient, delays_s, alter
        self.n, self.fields, self.n_affected = n, fields, -skip

    def affects(self, message: m.Message, recipient: str) -> bool:
        return (self.n_affected < self.n and recipient == self.recipient
                and isinstance(message, self.kind) and all(
                    getattr(message, name) == value for name, value in self.fields.items()))

    def __call__(self, message: m.Message, recipient: str) -> list[tuple[float, m.Message]]:
        if not self.affects(message, recipient):
            return on_time(message, recipient)
        self.n_affected += 1
        if self.n_affected <= 0:
            return on_time(message, recipient)
        return [(delay_s, self.alter(message)) for delay_s in self.delays_s]


def faults(*each: Fault) -> Transport:
    """Return a transport in which the first fault that affects a message applies."""
    return lambda message, recipient: next(
        (fault for fault in each if fault.affects(message, recipient)), on_time)(
        message, recipient)


def emulated_front_end(scenario: Scenario, surface: Surface | None = None) -> FrontEnd:
    air = Air(scenario, np.random.default_rng(0))
    return FrontEnd(
        surface or EmulatedSurface(scenario.n_elements), EmulatedRadio(scenario, air), air)


def feed(role: Any, events: Iterable[Any]) -> list[list[m.Message]]:
    """Return the messages that a role sends, one list for each event.

    The surface confirms all configurations, and the radio measures them without noise.
    """
    def sent(event, now_s):
        for action in role.handle(event, now_s):
            if isinstance(action, Send):
                yield action.message
            elif isinstance(action, ApplyPatterns):
                yield from sent(apply_patterns(
                    emulated_front_end(role._scenario), action), now_s)
    return [[*sent(event, float(n))] for n, event in enumerate(events)]


class Noisy:
    """Loses, duplicates and delays messages at random; a lost message reaches no recipient."""

    def __init__(
            self, seed: int, loss: float = 0.0, doubles: float = 0.0,
            jitter_s: float = 0.0) -> None:
        self._rng = np.random.default_rng(seed)
        self._loss, self._doubles, self._jitter_s = loss, doubles, jitter_s
        self._last, self._copies = None, 1

    def __call__(self, message: m.Message, recipient: str) -> list[tuple[float, m.Message]]:
        if message is not self._last:
            self._last = message
            self._copies = int(self._rng.random() >= self._loss)
            self._copies += self._copies and int(self._rng.random() < self._doubles)
        return [(LATENCY_S + self._jitter_s * self._rng.random(), message)
                for _ in range(self._copies)]


class Network:
    """The roles, coupled by a bus.

    `users` maps user numbers to positions or mobilities; `settings` are those of the base station,
    by default without repetitions and without a limit of acks; `make` builds the estimator of a
    codebook, which takes `make_s`; `ordered` keeps the order of messages of a class from one role
    to another. `plain_beams` replaces the optimisation of beams, which takes most of a cycle, by a
    simple function. The roles have the `library`, except for those in `without_library`.
    `world_rate` is the speed of the clock that stamps the signals, relative to that of the roles.
    """

    def __init__(
            self, scenario: Scenario, codebook, users, *, seed: int = 0,
            transport: Transport = on_time, ordered: bool = True, make=None, make_s: float = 0.0,
            absent: Iterable[str] = (), begin_s: float = 0.0, plain_beams: bool = True,
            positioner=None, library=EMPTY, without_library: Iterable[str] = (),
            world_rate: float = 1.0, **settings: Any) -> None:
        self._positioner, self._library = positioner, library
        self._world_rate = world_rate
        self._without_library = frozenset(without_library)
        self.scenario, self.seed = scenario, seed
        self._beams: dict[str, Any] = PLAIN_BEAMS if plain_beams else {}
        self.transport, self.ordered = transport, ordered
        self.now_s = begin_s
        self.front_end = emulated_front_end(scenario)
        self.settings = BaseStationSettings(**{'retries': 0, 'ack_rate_hz': np.inf} | settings)
        # Whether the base station adds noise, by cycle.
        self._noise: dict[int, bool] = {}
        self.log: list[Sent] = []
        self.logs: list[Logged] = []
        self.kept: list[Any] = []
        # Replies to operators.
        self.replies: list[Reply] = []
        self.tracks: list[PublishTrack] = []
        # Estimators to prepare in the background, which is left out.
        self.prepared: list[Any] = []
        self._ends: list[tuple[int, int, str]] = []
        self.codebooks = dict(library.by_id)
        if codebook is not None:
            self.codebooks[codebook.id] = codebook
        self._roles: dict[str, Any] = {}
        # Instance of each role, in the order in which they were started.
        self.instances: dict[str, int] = {}
        self._next_instance = itertools.count(1)
        self._queue: list[tuple[float, int, str, Any, m.Message]] = []
        self._serial = itertools.count()
        self._last_arrival_s: dict[tuple[str, str, type], float] = {}
        self._codebook = codebook
        self._reported: dict[Any, tuple[str, ...]] = {}
        self._mobilities = {}
        self._make = make
        self._make_s = make_s
        self._n_starts = 0
        self._started = False
        for user, place in users.items():
            self.add_user(user, place)
        for name in (*(role for role in ROLES if role not in ('user', 'bs')), 'bs'):
            if name not in absent:
                self.add(name)
        self._started = True
        self._report_missing()

    def __getitem__(self, name: str):
        return self._roles[name]

    def __contains__(self, name: str) -> bool:
        return name in self._roles

    def world_s(self) -> float:
        return self._world_rate * self.now_s

    def add_user(self, user: int, place, suffix: str = '') -> None:
        """Start a user; with the suffix ``_twin``, it may have the number of another user."""
        self.add_users({user: place}, f'user{user}{suffix}')

    def add_users(self, places, name: str) -> None:
        """Start a node with several users."""
        self._mobilities[name] = {
            user: place if hasattr(place, 'state') else mobility.Static(place)
            for user, place in places.items()}
        self.add(name)

    def add(self, name: str) -> None:
        """Start a role, or start it again; ``<name>_twin`` is a second instance."""
        self.instances[name] = next(self._next_instance)
        role = self._roles[name] = self._build(name)
        if self._kind(name) in USE_CODEBOOKS and self._codebook_of(name) is not None:
            self.dispatch(name, CodebookOffered(self._codebook_of(name)))
        self._reported.pop(role, None)
        self._report_missing()

    def remove(self, name: str, noticed: bool = True) -> None:
        """Crash a role; unless this is `noticed`, its peers detect it only at the next change."""
        del self._roles[name]
        if noticed:
            self._report_missing()

    def restart(self, name: str, noticed: bool = False) -> None:
        self.remove(name, noticed)
        self.add(name)

    def offer(self, codebook) -> None:
        """Offer a codebook to all roles that use one, at the same time."""
        self._codebook = codebook
        self.codebooks[codebook.id] = codebook
        for name in list(self._roles):
            if self._kind(name) in USE_CODEBOOKS:
                self.dispatch(name, CodebookOffered(codebook))

    def change(self, name: str, **values) -> None:
        """Offer a role the settings that were offered last, with these values replaced."""
        role = self._roles[name]
        self.dispatch(name, SettingsOffered(dataclasses.replace(role._settings.latest, **values)))

    def dispatch(self, name: str, event) -> None:
        for action in self._roles[name].handle(event, self.now_s):
            if isinstance(action, Send):
                self.publish(action.message, name)
            elif isinstance(action, BuildEstimator):
                self._make_estimator(name, action)
            elif isinstance(action, PrepareEstimator):
                self.prepared.append(action.estimator)
            elif isinstance(action, ApplyPatterns):
                self.dispatch(name, apply_patterns(self.front_end, action))
            elif isinstance(action, RevertSettings):
                self.kept.append(action.settings)
            elif isinstance(action, Reply):
                self.replies.append(action)
            elif isinstance(action, PublishTrack):
                self.tracks.append(action)
            else:
                self.logs.append(Logged(self.now_s, name, action))

    def _make_estimator(self, name: str, action: BuildEstimator) -> None:
        """Build an estimator, at once or with a delay."""
        def centre(codebook):
            if action.settings.model_file == UNFIT:
                raise ModelError('model_file: unfit')
            # The default estimator has a name of its own.
            usual = action.settings == PositionerSettings()
            return Fixed('centre' if usual else action.settings.estimator,
                         self.scenario.roi_center_m)
        event = build_estimator(
            action.codebook, self._make or centre, lambda: self.now_s)
        if not self._make_s:
            self.dispatch(name, event)
            return
        heapq.heappush(self._queue, (self.now_s + self._make_s, next(self._serial), name,
                                     self._roles[name], event))

    def publish(self, message: m.Message, sender: str = 'external') -> None:
        """Deliver a message to all roles that receive it."""
        m.check(message, self.scenario)
        if sender in self.instances:
            message = dataclasses.replace(message, sender=self.instances[sender])
        if isinstance(message, m.FeedSignals) and self._world_rate != 1.0:
            message = dataclasses.replace(message, stamp_ns=int(1e9 * self.world_s()))
        self.log.append(Sent(self.now_s, sender, message))
        if isinstance(message, m.Grant) and self._kind(sender) == 'bs':
            self._noise[message.cycle_id] = self._roles[sender]._settings.in_use.receiver_noise
        if isinstance(message, m.ProtocolState) and message.outcome:
            self._ends.append((message.cycle_id, message.user, message.outcome))
        for name, role in self._roles.items():
            if not self._receives(name, message, sender):
                continue
            for delay_s, arriving in self.transport(message, name):
                key = (sender, name, type(message))
                time_s = self.now_s + delay_s
                if self.ordered:
                    time_s = max(time_s, self._last_arrival_s.get(key, 0.0))
                    self._last_arrival_s[key] = time_s
                heapq.heappush(
                    self._queue, (time_s, next(self._serial), name, role, arriving))

    def run(self, until: Callable[[], bool] | None = None, limit_s: float = 60.0) -> None:
        """Run for `limit_s`, or until a condition holds, which must happen within that time."""
        end_s = self.now_s + limit_s
        since_s, events = self.now_s, 0
        while until is None or not until():
            since_s, events = (since_s, events + 1) if self.now_s == since_s else (self.now_s, 0)
            assert events < 10_000, f'time does not advance; counters {self.counters()}'
            due_s, name = min(
                ((deadline_s, name) for name, role in self._roles.items()
                 if (deadline_s := role.next_deadline()) is not None), default=(np.inf, ''))
            arrival_s = self._queue[0][0] if self._queue else np.inf
            if min(due_s, arrival_s) > end_s:
                self.now_s = end_s
                if until is not None:
                    pytest.fail(f'not within {limit_s} s; counters {self.counters()}')
                return
            if due_s < arrival_s:
                self.now_s = max(self.now_s, due_s)
                self.dispatch(name, Timeout())
            else:
                self.now_s, _, name, role, message = heapq.heappop(self._queue)
                if self._roles.get(name) is role:
                    self.dispatch(name, message)

    def run_cycles(self, n: int, limit_s: float = 60.0) -> None:
        """Run until `n` more cycles have ended, with or without service, and been reported."""
        wanted = len(self._ends) + n
        self.run(lambda: len(self._ends) >= wanted, limit_s)
        for name, role in self._roles.items():
            while isinstance(role, Transmission) and role.next_deadline() is not None:
                self.dispatch(name, Timeout())

    def run_to(self, state, name: str = 'bs', limit_s: float = 60.0) -> None:
        self.run(lambda: self._roles[name].state is state, limit_s)

    def sent(self, kind: type[m.Message], since: int = 0, **fields) -> list:
        """Return messages of a class with these field values, from index `since` of the log."""
        return [sent.message for sent in self.log[since:] if type(sent.message) is kind
                and all(getattr(sent.message, k) == v for k, v in fields.items())]

    def outcomes(self) -> list[tuple[int, int, str]]:
        """Return cycle, user and outcome of the cycles that have ended."""
        return list(self._ends)

    def ends(self) -> list[str]:
        """Return the outcomes of the cycles that have ended."""
        return [outcome for *_, outcome in self._ends]

    def served(self) -> list[int]:
        return [user for _, user, outcome in self.outcomes() if outcome == 'served']

    def counters(self) -> dict[str, dict[str, int]]:
        """Return the counters of the roles that have counted something."""
        return {name: dict(role.counters) for name, role in self._roles.items() if role.counters}

    def logged(self, name: str) -> list[str]:
        """Return the texts that a role logged, except for those that begin with ``serving``."""
        return [text for text in self.logged_texts(name) if not text.startswith('serving: ')]

    def logged_texts(self, name: str) -> list[str]:
        return [logged.message.text for logged in self.logs if logged.role == name]

    def verify(self) -> None:
        """Check that no result mixes cycles, users, codebooks or positions."""
        truths = {}
        for _, sender, message in self.log:
            match message:
                case m.GroundTruth():
                    truths[message.cycle_id, message.user, message.sender] = message
                case m.ReceivedSignals() if sender != 'external':
                    truth = truths[message.cycle_id, message.user, message.user_instance]
                    expected = self.expected_signals(
                        message.cycle_id, message.user, message.codebook_id, truth)
                    np.testing.assert_allclose(
                        message.signals, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())
        assert self.check_invariants().violations == []

    def checker(self) -> InvariantChecker:
        """Return a checker of invariants that knows the codebooks."""
        checker = InvariantChecker(self.scenario)
        for codebook in self.codebooks.values():
            checker.add_codebook(codebook)
        return checker

    def check_invariants(self, messages: Iterable[m.Message] | None = None) -> InvariantChecker:
        """Return a checker that has checked the results among all messages, or the given ones."""
        checker = self.checker()
        if messages is None:
            timed = [(sent.time_s, sent.message) for sent in self.log
                     if sent.sender != 'external']
        else:
            timed = [(0.0, message) for message in messages]
        for time_s, message in timed:
            if isinstance(message, RECEIVES):
                checker.add(message, time_s)
        # Belongs to no cycle; its late arrival makes all earlier results due.
        checker.add(m.Grant(cycle_id=0, user=1), 1e9)
        return checker

    def expected_signals(
            self, cycle_id: int, user: int, codebook_id: str, truth: m.GroundTruth) -> np.ndarray:
        """Return the received signals by the matrix form of the model, [N_B, N_SB, F]."""
        scenario = self.scenario
        shape = (scenario.n_bands, scenario.n_subbands, scenario.n_frames)
        noise = complex_normal(
            shape, streams.generator(self.seed, streams.RECEIVER, user, cycle_id))
        noise *= np.sqrt(scenario.noise_power_w) * self._noise[cycle_id]
        signals = np.empty(shape, complex)
        patterns = radiation_matrix(scenario, self.codebooks[codebook_id])
        for band, pattern in enumerate(patterns):
            rng = streams.generator(self.seed, streams.CHANNEL, user, cycle_id, band)
            gains = draw_multipath(scenario, band, 1, rng)
            places = truth.position + frame_times_s(scenario)[band][:, None] * truth.velocity
            of_frame = pattern.reshape(*shape[1:], -1)
            direct = np.einsum('fjm,jfm->jf', los_gain(scenario, places, band), of_frame)
            signals[band] = received_signal(
                direct.reshape(1, -1), gains, pattern, 0.0).reshape(shape[1:])
        return signals + noise

    @staticmethod
    @functools.cache
    def _kind(name: str) -> str:
        return name.rpartition('/')[2].removesuffix('_twin').rstrip('0123456789')

    def _codebook_of(self, name: str) -> Codebook | None:
        return self._codebook

    def _receives(self, name: str, message: m.Message, sender: str) -> bool:
        return type(message) in SUBSCRIPTIONS[self._kind(name)]

    def _build(self, name: str):
        scenario, step_s = self.scenario, self.settings.step_timeout_s
        library = EMPTY if name in self._without_library else self._library
        match kind := self._kind(name):
            case 'bs':
                rng = streams.generator(self.seed, streams.BASE_STATION)
                # Cycle ids are never repeated, as with the clock of the node.
                first = 1_000_000 * self._n_starts + 1
                self._n_starts += 1
                return BaseStation(
                    scenario, self.settings, rng, self.seed, first, library, self.world_s)
            case 'rhs_controller':
                return RhsController(library)
            case 'user':
                return user_role.User(
                    self._mobilities[name], scenario, step_s, BEACON_TIMEOUT_S,
                    self.instances[name], self.world_s)
            case 'channel':
                # Two channels differ in their multipath. Without memory, the expected signals
                # depend on the seed alone.
                return Channel(scenario, self.seed + name.endswith('_twin'),
                               Impairments(multipath_memory=False))
            case 'positioner':
                return Positioner(
                    scenario, lambda: self.now_s, self._positioner, library=library)
            case 'transmission':
                return Transmission(scenario, **self._beams, library=library)
        return ROLES[kind]()

    def _report_missing(self) -> None:
        """Report changes of the missing roles to the roles that need them."""
        for name in list(self._roles) if self._started else ():
            role = self._roles[name]
            present = {self._kind(other) for other in self._roles}
            missing = tuple(p for p in PEERS.get(self._kind(name), ()) if p not in present)
            if self._kind(name) in PEERS and self._reported.get(role) != missing:
                self._reported[role] = missing
                self.dispatch(name, PeersChanged(missing))


@pytest.fixture(scope='session')
def scenario() -> Scenario:
    """A small scenario; a cycle takes milliseconds."""
    return Scenario(n_subbands=3, n_frames=2, n_feeds=2, elements_per_side=4)


@pytest.fixture(scope='session')
def codebooks(scenario):
    """Three codebooks for the small scenario."""
    return [random_codebook(scenario, np.random.default_rng(seed)) for seed in range(3)]


@pytest.fixture(scope='session')
def places(scenario) -> np.ndarray:
    """Positions of users."""
    return scenario.sample_positions(5, np.random.default_rng(7))


@pytest.fixture(scope='session')
def network(scenario, codebooks, places):
    """Function that returns a network; `users` is a number of users or a mapping."""
    def make(users=1, codebook=codebooks[0], **options) -> Network:
        if isinstance(users, int):
            users = {user: places[user - 1] for user in range(1, users + 1)}
        return Network(scenario, codebook, users, **options)
    return make


@pytest.fixture(scope='session')
def example(scenario):
    """Function that returns a message of a class with zeros or random numbers, or given values.

    Positions are in front of the surface, and symbols have unit magnitude.
    """
    return functools.partial(example_message, scenario)
