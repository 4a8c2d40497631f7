"""A network in three dimensions and in charts, over its cycles."""

import collections
import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import cycle_log
from rhs_isac_ros.monitoring import shapes as scene
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle, CycleLog
from rhs_isac_ros.monitoring.network_state import NodeStatus, SceneState
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.monitoring.shapes import (
    Clear,
    Entity,
    Entry,
    Lines,
    Number,
    Points,
    Series,
    Text,
    user_colour,
)
from rhs_isac_ros.positioning import WeightedModes
from rhs_isac_ros.positioning.alternatives import describe_doubts
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import NewestDict

# Title of each chart by the path that its series begin with.
TITLES: Mapping[str, str] = {
    'error': 'Position error [m]',
    'capacity': 'Capacity [Mbit/s]',
    'loss': 'Loss of capacity [%]',
    'latency': 'Latency [ms]',
    'drops': 'Drops and given-up cycles',
}
# Number of users and of nodes with a series of their own: a longer legend hides the chart.
_MAX_SERIES = 4
# Number of nodes whose messages are counted; their names come from messages.
_MAX_NODES = 4096
_MEGA = 1e6
_MILLI = 1e-3
_RED, _WHITE, _GREEN, _BLUE, _ORANGE, _GREY = (
    (0.95, 0.3, 0.3), (0.95, 0.95, 0.95), (0.35, 0.8, 0.4), (0.4, 0.6, 1.0), (1.0, 0.65, 0.2),
    (0.6, 0.6, 0.6))
_PHASE_COLOURS = dict(zip(m.Phase, (_BLUE, _GREEN, _ORANGE, _RED), strict=True))


class Sample(NamedTuple):
    """A value on a path, and the style of its series."""

    path: str
    value: float
    style: Series


class Charts:
    """Computes the samples of the charts.

    Attributes
    ----------
    bounds_m
        Root of the global bound [m] by the id of the codebook, as far as it is known.
    """

    def __init__(self) -> None:
        self.bounds_m: dict[str, float] = {}
        self._styles: dict[str, Series] = {}
        self._square_m2 = 0.0
        self._n_fixes = self._n_given_up = 0
        self._n_dropped: NewestDict[str, int] = NewestDict(_MAX_NODES)
        # Users and nodes with a series of their own.
        self._users: set[int] = set()
        self._nodes: set[str] = set()

    def add(self, cycle: int, samples: Iterator[Sample]) -> list[Entry]:
        """Return samples as entries of a cycle; the first of a series comes with its style.

        Values that are not finite are left out.
        """
        entries = []
        for path, value, style in samples:
            if not math.isfinite(value):
                continue
            if path not in self._styles:
                self._styles[path] = style
                entries.append(Entry(0, path, style))
            entries.append(Entry(cycle, path, Number(float(value))))
        return entries

    def dropped(self, node: str, count: int) -> Iterator[Sample]:
        """Yield the number of messages that a node dropped since its start, and that of all.

        Only the first four nodes that dropped a message have a series of their own.
        """
        self._n_dropped.put(node, count)
        yield Sample('drops/all', sum(self._n_dropped.values()), Series('all nodes', _WHITE))
        name = node.rpartition('/')[2]
        if count and len(self._nodes) < _MAX_SERIES:
            self._nodes.add(name)
        if name in self._nodes:
            # Python's hash of a string differs between processes.
            yield Sample(f'drops/{name}', count, Series(name, user_colour(sum(name.encode()))))

    def given_up(self) -> Iterator[Sample]:
        """Count a cycle that was given up, and yield their number."""
        self._n_given_up += 1
        yield Sample('drops/given_up', self._n_given_up, Series('cycles given up', _RED))

    def of_cycle(self, cycle: CompleteCycle) -> Iterator[Sample]:
        """Yield the samples of a complete cycle.

        Only the first four users have a series of their own; the others share one.
        """
        if len(self._users) < _MAX_SERIES:
            self._users.add(cycle.user)
        if cycle.user in self._users:
            yield Sample(f'error/user_{cycle.user}', cycle.error_m,
                         Series(f'user {cycle.user}', user_colour(cycle.user), dots=True))
        else:
            yield Sample('error/others', cycle.error_m, Series('other users', _GREY, dots=True))
        yield from self._errors(cycle)
        capacity = cycle.capacity
        # A small loss would hide one of two lines behind the other, so the actual values are dots.
        for name, value, colour in (
                ('perfect', capacity.perfect_bps, _WHITE),
                ('actual', capacity.actual_bps, _GREEN),
                ('expected', capacity.expected_bps, _BLUE)):
            yield Sample(f'capacity/{name}', value / _MEGA,
                         Series(name, colour, dots=name == 'actual'))
        yield Sample('loss/percent', capacity.loss_percent, Series('loss', _ORANGE, dots=True))
        for phase, duration_s in cycle.durations_s().items():
            name = phase.name.lower()
            yield Sample(f'latency/{name}', duration_s / _MILLI,
                         Series(name, _PHASE_COLOURS[phase]))
        yield Sample('latency/estimator', cycle.estimate.latency_s / _MILLI,
                     Series('estimator', _WHITE))

    def _errors(self, cycle: CompleteCycle) -> Iterator[Sample]:
        estimate = cycle.estimate
        self._square_m2 += cycle.error_m**2
        self._n_fixes += 1
        yield Sample('error/root_mean_square', math.sqrt(self._square_m2 / self._n_fixes),
                     Series('root mean square so far', _RED))
        yield Sample('error/crlb', math.sqrt(max(estimate.crlb_m2, 0.0)),
                     Series('sqrt(CRLB)', _GREEN))
        yield Sample('error/global_bound', self.bounds_m.get(estimate.codebook_id, math.nan),
                     Series('global bound', _WHITE))


# Half the width of the chart, the distance of its labels, and the height of the probability 1 [m].
REACH_M = 3.0
_STEP_M = 0.6
HEIGHT_M = 3.0
_LABEL_OFFSET_M = 0.2
_GRID_LEVELS = (0.25, 0.5, 0.75, 1.0)
_GRID_COLOUR = (0.3, 0.3, 0.3)
_GRID_WIDTH, _LINE_WIDTH, _BAR_WIDTH = 0.6, 2.0, 9.0
# Labels have no ball that would be visible.
_INVISIBLE_M = 1e-3


def mode_axes() -> tuple[Lines, Points]:
    """Return the grid of the chart and its labels."""
    places = np.arange(-REACH_M, REACH_M + _STEP_M / 2, _STEP_M)
    grid = [_line(place, HEIGHT_M) for place in places]
    grid += [np.array([[-REACH_M, -level * HEIGHT_M], [REACH_M, -level * HEIGHT_M]])
             for level in (0.0, *_GRID_LEVELS)]
    labels = [*((place, _LABEL_OFFSET_M, f'{place:+.1f}') for place in places[1:-1:2]),
              *((-REACH_M, -level * HEIGHT_M, f'{level:.0%}') for level in _GRID_LEVELS)]
    return (Lines(tuple(grid), _GRID_COLOUR, _GRID_WIDTH),
            Points(np.array([label[:2] for label in labels]), np.full((len(labels), 3), 0.7),
                   np.full(len(labels), _INVISIBLE_M), tuple(label[2] for label in labels)))


def mode_bars(user: int, found: WeightedModes, origin: np.ndarray) -> Lines:
    """Return the modes as bars in the colour of a user.

    Parameters
    ----------
    origin
        Position whose range is the origin, float64 [3] [m].
    """
    errors = np.linalg.norm(found.positions, axis=1) - np.linalg.norm(origin)
    return Lines(tuple(_line(error, HEIGHT_M * probability) for error, probability in zip(
        errors.tolist(), found.probabilities.tolist(), strict=True)),
        user_colour(user), _BAR_WIDTH)


def mode_estimate(position: np.ndarray, origin: np.ndarray) -> Lines:
    """Return an estimate, float64 [3] [m], as a white line; the origin is as in `mode_bars`."""
    error = float(np.linalg.norm(position) - np.linalg.norm(origin))
    return Lines((_line(error, HEIGHT_M),), (1.0, 1.0, 1.0), _LINE_WIDTH)


def _line(place: float, height: float) -> np.ndarray:
    return np.array([[place, 0.0], [place, -height]])


# Messages that the view needs.
RECEIVES = (*cycle_log.RECEIVES, m.RhsConfiguration, m.Beam, m.NoFix)
# Paths of the entities.
WORLD = 'world'
MODES = 'modes'
POSITIONING = 'surface/positioning'
TRANSMISSION = 'surface/transmission'
LOG = 'log'
# Further users are in the charts only, because the ids come from messages.
_MAX_USERS = 64
# Names of more users hide the scene.
_MAX_NAMES = 8
# Number of latest cycles whose messages may still arrive.
_MAX_CYCLES = 64
_MAX_PATH_LENGTH = 200


@dataclasses.dataclass(frozen=True, eq=False)
class TrackPoint:
    """Position [m], its covariance [m^2] and the velocity [m/s] of a user that is tracked."""

    user: int
    position: np.ndarray
    covariance_m2: np.ndarray
    velocity: np.ndarray


class NetworkView:
    """Converts the messages of a network to entries, in the order in which they arrive.

    Attributes
    ----------
    n_ended
        Number of cycles that were received completely or were given up.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._scene = SceneState()
        self._log = CycleLog()
        self._charts = Charts()
        self._cycles: NewestDict[int, int] = NewestDict(_MAX_CYCLES)
        self._n_cycles = self.n_ended = 0
        self._users: set[int] = set()
        self._named: set[int] = set()
        self._tracks: dict[int, collections.deque[np.ndarray]] = {}
        self._configurations: dict[int, np.ndarray] = {}
        # True position of the user in each cycle, the origin of the chart of the modes.
        self._origins: NewestDict[int, np.ndarray] = NewestDict(_MAX_CYCLES)

    @property
    def n_cycles(self) -> int:
        """Number of cycles that were observed."""
        return self._n_cycles

    def begin(self) -> list[Entry]:
        """Return the entries that are shown at all times."""
        grid, labels = mode_axes()
        return [Entry(0, f'{WORLD}/region', scene.region(self._scenario)),
                Entry(0, f'{MODES}/grid', grid), Entry(0, f'{MODES}/labels', labels)]

    def add(self, message: m.Message, now_s: float) -> list[Entry]:
        """Add a message of one of the types `RECEIVES` that arrived at `now_s` [s]."""
        cycle = self._count(message.cycle_id)
        if isinstance(message, cycle_log.RECEIVES):
            self._log.add(message, now_s)
        user = getattr(message, 'user', 0)
        if user and not self._shows(user):
            return self._ended()
        self._scene.add(message, now_s)
        entries = [Entry(cycle, path, entity) for path, entity in self._entities(message)]
        return entries + self._ended()

    def add_report(self, node: str, report: Report) -> list[Entry]:
        """Add the report of a node."""
        counts = NodeStatus(report, 0.0).counts('dropped')
        return self._charts.add(self._count(0), self._charts.dropped(
            node, sum(counts.values())))

    def add_modes(self, received: m.ReceivedSignals, found: WeightedModes | None) -> list[Entry]:
        """Add the modes of the posterior for received signals; None if they give no position."""
        if not self._shows(received.user):
            return []
        cycle, path = self._count(received.cycle_id), f'{self._path(received.user)}/modes'
        if found is None:
            return [Entry(cycle, name, Clear()) for name in (path, f'{MODES}/found')]
        points, ellipsoids = scene.modes(received.user, found)
        origin = self._origins.get(received.cycle_id, found.probabilities @ found.positions)
        return [Entry(cycle, path, points), Entry(cycle, f'{path}/ellipsoids', ellipsoids),
                Entry(cycle, f'{MODES}/found', mode_bars(received.user, found, origin))]

    def add_track(self, cycle_id: int, point: TrackPoint) -> list[Entry]:
        """Add a position of a track; the id of its cycle is 0 if it is unknown."""
        if not self._shows(point.user):
            return []
        positions = self._tracks.setdefault(
            point.user, collections.deque(maxlen=_MAX_PATH_LENGTH))
        positions.append(point.position)
        lines, ellipsoid = scene.track(
            point.user, positions, point.velocity, point.covariance_m2)
        cycle, path = self._count(cycle_id), f'{self._path(point.user)}/track'
        return [Entry(cycle, path, lines), Entry(cycle, f'{path}/ellipsoid', ellipsoid)]

    def set_bound(self, codebook_id: str, mean_square_m2: float) -> None:
        """Set the global bound on the mean squared error with a codebook [m^2]."""
        self._charts.bounds_m[codebook_id] = math.sqrt(mean_square_m2)

    def _entities(self, message: m.Message) -> Iterator[tuple[str, Entity]]:
        match message:
            case m.RhsConfiguration():
                yield f'{WORLD}/board', scene.board(
                    self._scenario, message.analog, enlarged=True)
                if message.mode is m.Mode.TRANSMISSION:
                    yield TRANSMISSION, scene.configurations(
                        self._scenario, [message.analog])
                else:
                    self._configurations[message.band] = message.analog
                    bands = sorted(self._configurations)
                    yield POSITIONING, scene.configurations(
                        self._scenario, [self._configurations[band] for band in bands])
            case m.Beam():
                yield f'{WORLD}/beam', scene.lobe(
                    scene.pattern(self._scenario, message), message.user)
            case m.GroundTruth():
                path = self._path(message.user)
                ball, name = scene.truth(message)
                yield f'{path}/truth', ball
                if message.user in self._named:
                    yield f'{path}/name', name
                if message.cycle_id:
                    self._origins.put(message.cycle_id, message.position)
                yield f'{path}/true_path', scene.path(
                    message.user, self._scene.users[message.user].true_path)
            case m.PositionEstimate():
                path = f'{self._path(message.user)}/estimate'
                point, ellipsoid = scene.estimate(message)
                yield path, point
                yield f'{path}/ellipsoid', ellipsoid
                yield f'{MODES}/estimate', mode_estimate(
                    message.position, self._origins.get(message.cycle_id, message.position))
            case m.NoFix():
                path = self._path(message.user)
                for part in (path, MODES):
                    yield f'{part}/estimate', Clear()
                for part in (f'{path}/modes', f'{MODES}/found'):
                    yield part, Clear()

    def _ended(self) -> list[Entry]:
        """Return the results of the cycles that have ended."""
        entries: list[Entry] = []
        for record in self._log.given_up:
            cycle = self._count(record.cycle_id)
            user = f'user {record.user}: ' if record.user else ''
            entries.append(Entry(cycle, LOG, Text(
                f'{user}{record.outcome} (cycle {record.cycle_id})', warning=True)))
            entries += self._charts.add(cycle, self._charts.given_up())
        for complete in self._log.complete:
            cycle = self._count(complete.cycle_id)
            doubts = describe_doubts(complete.estimate)
            entries.append(Entry(cycle, LOG, Text(
                f'user {complete.user}: error {complete.error_m:.2f} m, '
                f'loss {complete.capacity.loss_percent:.1f} %'
                f'{doubts and f", {doubts}"} (cycle {complete.cycle_id})')))
            entries += self._charts.add(cycle, self._charts.of_cycle(complete))
        self.n_ended += len(self._log.given_up) + len(self._log.complete)
        self._log.clear()
        return entries

    def _path(self, user: int) -> str:
        return f'{WORLD}/user_{user}'

    def _shows(self, user: int) -> bool:
        if len(self._users) < _MAX_USERS:
            self._users.add(user)
        if len(self._named) < _MAX_NAMES:
            self._named.add(user)
        return user in self._users

    def _count(self, cycle_id: int) -> int:
        """Return the number of a cycle; messages outside of cycles belong to the latest."""
        if not cycle_id:
            return max(self._n_cycles, 1)
        if cycle_id not in self._cycles:
            self._n_cycles += 1
            self._cycles.put(cycle_id, self._n_cycles)
        return self._cycles[cycle_id]
