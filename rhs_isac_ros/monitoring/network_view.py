"""The view of a network in three dimensions and in charts, over its cycles."""

import collections
import math
from collections.abc import Iterable, Iterator
from typing import TypeAlias

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.monitoring import cycle_log, shapes
from rhs_isac_ros.monitoring.cycle_log import CompleteCycle, CycleLog
from rhs_isac_ros.monitoring.network_state import NodeStatus, SceneState, new_path
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
from rhs_isac_ros.positioning.alternatives import describe_doubts
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import NewestDict

# Types of the messages that the view uses.
RECEIVES = (*cycle_log.RECEIVES, m.Posterior, m.RhsConfiguration, m.Beam, m.NoFix)
# Paths of the entities.
WORLD = 'world'
SURFACE = 'world/surface'
MODES = 'modes'
POSITIONING = 'surface/positioning'
TRANSMISSION = 'surface/transmission'
LOG, LEGEND = 'log', 'legend'
# Title of each chart, by the prefix of the paths of its series.
TITLES = {
    'error': 'Position error [m]',
    'capacity': 'Capacity [Mbit/s]',
    'loss': 'Loss of capacity [%]',
    'latency': 'Latency [ms]',
    'drops': 'Drops and given-up cycles',
}
# Maximum number of users, and of nodes, with their own series, which the legend names.
_MAX_SERIES = 4
# First line of the legend of each chart with several series, and the number of all lines.
_LEGEND = {'error': 0, 'capacity': 8, 'latency': 12, 'drops': 18}
LEGEND_LINES = 24
# Space above and below the numbers of a chart, as a share of their range.
_MARGIN = 0.05
# Maximum number of nodes in the counts, because the names come from messages.
_MAX_NODES = 4096
# Maximum number of users in the scene, because the ids come from messages.
_MAX_USERS = 64
# Maximum number of users with a name in the scene: more names would hide the scene.
_MAX_NAMES = 8
# Number of latest cycles whose messages may still arrive.
_MAX_CYCLES = 64
_MEGA, _MILLI = 1e6, 1e-3
_RED, _WHITE, _GREEN, _BLUE, _ORANGE, _GREY = (
    (0.95, 0.3, 0.3), (0.95, 0.95, 0.95), (0.35, 0.8, 0.4), (0.4, 0.6, 1.0), (1.0, 0.65, 0.2),
    (0.6, 0.6, 0.6))
_PHASE_COLOURS = dict(zip(m.Phase, (_BLUE, _GREEN, _ORANGE, _RED), strict=True))
# In the chart of the modes: half the width, the distance between lines, and the height of
# probability 1 [m].
REACH_M, _STEP_M, HEIGHT_M = 3.0, 0.6, 3.0
_LABEL_OFFSET_M = 0.2
_GRID_LEVELS = (0.25, 0.5, 0.75, 1.0)
_GRID_COLOUR = (0.3, 0.3, 0.3)
_GRID_WIDTH, _LINE_WIDTH, _BAR_WIDTH = 0.6, 2.0, 9.0

# Path and value of a point in a chart, and the style of its series.
Sample: TypeAlias = tuple[str, float, Series]


class Charts:
    """Computes the samples of the charts from the cycles and reports of a network.

    Only the first users, and the first nodes that dropped a message, have series of their own.
    """

    def __init__(self) -> None:
        self._drawn: set[str] = set()
        self._n_named: collections.Counter[str] = collections.Counter()
        self._ranges: dict[str, tuple[float, float]] = {}
        self._square_m2 = 0.0
        self._n_fixes = self._n_given_up = 0
        self._n_dropped: NewestDict[str, int] = NewestDict(_MAX_NODES)
        # Users and nodes with separate series.
        self._users: set[int] = set()
        self._nodes: set[str] = set()

    def entries(self, cycle: int, samples: Iterable[Sample]) -> Iterator[Entry]:
        """Yield the finite samples of a cycle, and the style and the name of each new series."""
        for path, value, style in samples:
            if not math.isfinite(value):
                continue
            chart = path.partition('/')[0]
            if path not in self._drawn:
                self._drawn.add(path)
                yield Entry(0, path, style)
                if chart in _LEGEND:
                    yield Entry(0, f'{LEGEND}/{path}', _name(
                        style, _LEGEND[chart] + self._n_named[chart]))
                    self._n_named[chart] += 1
            yield Entry(cycle, path, Number(float(value)))
            yield from self._margins(cycle, chart, float(value))

    def _margins(self, cycle: int, chart: str, value: float) -> Iterator[Entry]:
        """Yield invisible numbers around all numbers of a chart, which would cut dots in half."""
        low, high = self._ranges.get(chart, (math.inf, -math.inf))
        if low <= value <= high:
            return
        self._ranges[chart] = low, high = min(low, value), max(high, value)
        margin = _MARGIN * (high - low)
        for path, limit in (f'{chart}/low', low - margin), (f'{chart}/high', high + margin):
            if path not in self._drawn:
                self._drawn.add(path)
                yield Entry(0, path, Series('', _GREY, dots=True))
            yield Entry(cycle, path, Number(limit))

    def dropped(self, node: str, count: int) -> Iterator[Sample]:
        """Yield the number of messages dropped by all nodes, and the `count` dropped by a node."""
        self._n_dropped.put(node, count)
        yield 'drops/all', sum(self._n_dropped.values()), Series('all nodes', _WHITE)
        name = node.rpartition('/')[2]
        if count and len(self._nodes) < _MAX_SERIES:
            self._nodes.add(name)
        if name in self._nodes:
            # Python's hash of a string differs between processes.
            yield f'drops/{name}', count, Series(name, user_colour(sum(name.encode())))

    def given_up(self) -> Iterator[Sample]:
        """Count a cycle that was given up, and yield the number of such cycles."""
        self._n_given_up += 1
        yield 'drops/given_up', self._n_given_up, Series('cycles given up', _RED)

    def of_cycle(self, cycle: CompleteCycle) -> Iterator[Sample]:
        """Yield the samples of a complete cycle."""
        if len(self._users) < _MAX_SERIES:
            self._users.add(cycle.user)
        if cycle.user in self._users:
            yield (f'error/user_{cycle.user}', cycle.error_m,
                   Series(f'user {cycle.user}', user_colour(cycle.user), dots=True))
        else:
            yield 'error/others', cycle.error_m, Series('other users', _GREY, dots=True)
        estimate, capacity = cycle.estimate, cycle.capacity
        self._square_m2 += cycle.error_m**2
        self._n_fixes += 1
        yield ('error/root_mean_square', math.sqrt(self._square_m2 / self._n_fixes),
               Series('RMS so far', _RED))
        yield 'error/crlb', math.sqrt(max(estimate.crlb_m2, 0.0)), Series('sqrt(CRLB)', _GREEN)
        # If the loss is small, the lines would coincide, so the actual values are dots.
        for name, value, colour in (
                ('perfect', capacity.perfect_bps, _WHITE),
                ('actual', capacity.actual_bps, _GREEN),
                ('expected', capacity.expected_bps, _BLUE)):
            yield f'capacity/{name}', value / _MEGA, Series(name, colour, dots=name == 'actual')
        yield 'loss/percent', capacity.loss_percent, Series('loss', _ORANGE, dots=True)
        for phase, duration_s in cycle.durations_s().items():
            name = phase.name.lower()
            yield f'latency/{name}', duration_s / _MILLI, Series(name, _PHASE_COLOURS[phase])
        yield 'latency/estimator', estimate.latency_s / _MILLI, Series('estimator', _WHITE)


def mode_axes() -> tuple[Lines, Points]:
    """Return the grid of the chart of the modes, and its labels."""
    marks = np.arange(-REACH_M, REACH_M + _STEP_M / 2, _STEP_M)
    grid = [_line(mark, HEIGHT_M) for mark in marks]
    grid += [np.array([[-REACH_M, -level * HEIGHT_M], [REACH_M, -level * HEIGHT_M]])
             for level in (0.0, *_GRID_LEVELS)]
    labels = [*((mark, _LABEL_OFFSET_M, f'{mark:+.1f}') for mark in marks[1:-1:2]),
              *((-REACH_M, -level * HEIGHT_M, f'{level:.0%}') for level in _GRID_LEVELS)]
    return (Lines(tuple(grid), _GRID_COLOUR, _GRID_WIDTH),
            Points(np.array([label[:2] for label in labels]), np.full((len(labels), 3), 0.7),
                   np.full(len(labels), shapes.INVISIBLE_M), tuple(label[2] for label in labels)))


def mode_bars(message: m.Posterior, origin: np.ndarray, surface: np.ndarray) -> Lines:
    """Return modes as bars at their range minus the range of `origin`, in the colour of the user.

    Ranges are distances from the centre of the surface, float64 [3] [m].
    """
    ranges = np.linalg.norm(message.means[:, :3] - surface, axis=1)
    errors = ranges - np.linalg.norm(origin - surface)
    probabilities, _ = mixture_weights(message.log_weights)
    return Lines(tuple(_line(error, HEIGHT_M * probability) for error, probability in zip(
        errors.tolist(), probabilities.tolist(), strict=True)),
        user_colour(message.user), _BAR_WIDTH)


def mode_estimate(position: np.ndarray, origin: np.ndarray, surface: np.ndarray) -> Lines:
    """Return an estimate, float64 [3] [m], as a white line; see `mode_bars`."""
    error = float(np.linalg.norm(position - surface) - np.linalg.norm(origin - surface))
    return Lines((_line(error, HEIGHT_M),), (1.0, 1.0, 1.0), _LINE_WIDTH)


def _name(style: Series, line: int) -> Points:
    """Return the name of a series in a line of the legend."""
    return Points(np.array([[0.0, line]]), np.array([style.colour]),
                  np.array([shapes.INVISIBLE_M]), (style.name,))


def _line(mark: float, height: float) -> np.ndarray:
    return np.array([[mark, 0.0], [mark, -height]])


class NetworkView:
    """Converts the messages of a network to entries, in the order of arrival.

    `n_cycles` counts the observed cycles; `n_ended` counts the complete cycles and the cycles that
    were given up. The view contains only the first users.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._scene, self._log, self._charts = SceneState(), CycleLog(), Charts()
        self._cycles: NewestDict[int, int] = NewestDict(_MAX_CYCLES)
        self.n_cycles = self.n_ended = 0
        self._users: list[int] = []
        self._tracks: dict[int, collections.deque[np.ndarray]] = {}
        self._configurations: dict[int, np.ndarray] = {}
        # The true position in each cycle, which is the origin of the chart of the modes.
        self._origins: NewestDict[int, np.ndarray] = NewestDict(_MAX_CYCLES)

    def begin(self) -> list[Entry]:
        """Return the entries that are always shown."""
        grid, labels = mode_axes()
        pose = self._scenario.pose
        return [Entry(0, SURFACE, shapes.Placement(pose.origin, pose.rotation)),
                Entry(0, f'{SURFACE}/region', shapes.region(self._scenario)),
                Entry(0, f'{MODES}/grid', grid), Entry(0, f'{MODES}/labels', labels)]

    def add(self, message: m.Message, now_s: float) -> list[Entry]:
        """Add a message of a type in `RECEIVES` that arrived at `now_s` [s]; return entries."""
        cycle = self._count(message.cycle_id)
        if isinstance(message, cycle_log.RECEIVES):
            self._log.add(message, now_s)
        entries: list[Entry] = []
        user = getattr(message, 'user', 0)
        if not user or self._shows(user):
            self._scene.add(message, now_s)
            entries += (Entry(cycle, path, entity) for path, entity in self._entities(message))
        return [*entries, *self._ended()]

    def add_report(self, node: str, report: Report) -> list[Entry]:
        """Add the report of a node, and return entries for its count of dropped messages."""
        count = sum(NodeStatus(report, 0.0).counts('dropped').values())
        return [*self._charts.entries(self._count(0), self._charts.dropped(node, count))]

    def add_track(self, user: int, position: np.ndarray, covariance_m2: np.ndarray,
                  velocity: np.ndarray) -> list[Entry]:
        """Add a position [m] and a velocity [m/s] of a track."""
        if not self._shows(user):
            return []
        positions = self._tracks.setdefault(user, new_path())
        positions.append(position)
        lines, ellipsoid = shapes.track(user, positions, velocity, covariance_m2)
        cycle, path = self._count(0), f'{_path(user)}/track'
        return [Entry(cycle, path, lines), Entry(cycle, f'{path}/ellipsoid', ellipsoid)]

    def _entities(self, message: m.Message) -> Iterator[tuple[str, Entity]]:
        match message:
            case m.RhsConfiguration():
                yield f'{SURFACE}/board', shapes.board(
                    self._scenario, message.analog, message.band, enlarged=True)
                if message.mode is m.Mode.TRANSMISSION:
                    yield TRANSMISSION, shapes.configurations(self._scenario, [message.analog])
                else:
                    self._configurations[message.band] = message.analog
                    yield POSITIONING, shapes.configurations(self._scenario, (
                        analog for _, analog in sorted(self._configurations.items())))
            case m.Beam():
                yield f'{SURFACE}/beam', shapes.lobe(
                    shapes.pattern(self._scenario, message), message.user)
            case m.GroundTruth():
                path = _path(message.user)
                ball, name = shapes.truth(message)
                yield f'{path}/truth', ball
                if message.user in self._users[:_MAX_NAMES]:
                    yield f'{path}/name', name
                if message.cycle_id:
                    self._origins.put(message.cycle_id, message.position)
                yield f'{path}/true_path', shapes.path(
                    message.user, self._scene.users[message.user].true_path)
                if self._scenario.channel:
                    yield (f'{SURFACE}/user_{message.user}',
                           shapes.traced(self._scenario, message))
            case m.PositionEstimate():
                path = f'{_path(message.user)}/estimate'
                point, ellipsoid = shapes.estimate(message)
                yield path, point
                yield f'{path}/ellipsoid', ellipsoid
                yield f'{MODES}/estimate', mode_estimate(
                    message.position, self._origins.get(message.cycle_id, message.position),
                    self._scenario.pose.origin)
            case m.Posterior():
                path = f'{_path(message.user)}/modes'
                points, ellipsoids = shapes.modes(message)
                yield path, points
                yield f'{path}/ellipsoids', ellipsoids
                yield f'{MODES}/found', mode_bars(
                    message, self._origins.get(message.cycle_id, message.means[0, :3]),
                    self._scenario.pose.origin)
            case m.NoFix():
                path = _path(message.user)
                for part in (f'{path}/estimate', f'{MODES}/estimate', f'{path}/modes',
                             f'{MODES}/found'):
                    yield part, Clear()

    def _ended(self) -> Iterator[Entry]:
        for record in self._log.given_up:
            cycle = self._count(record.cycle_id)
            user = f'user {record.user}: ' if record.user else ''
            yield Entry(cycle, LOG, Text(
                f'{user}{record.outcome} (cycle {record.cycle_id})', warning=True))
            yield from self._charts.entries(cycle, self._charts.given_up())
        for complete in self._log.complete:
            cycle, doubts = self._count(complete.cycle_id), describe_doubts(complete.estimate)
            yield Entry(cycle, LOG, Text(
                f'user {complete.user}: error {complete.error_m:.2f} m, '
                f'loss {complete.capacity.loss_percent:.1f} %'
                f'{doubts and f", {doubts}"}, codebook {complete.signals.codebook_id} '
                f'(cycle {complete.cycle_id})'))
            yield from self._charts.entries(cycle, self._charts.of_cycle(complete))
        self.n_ended += len(self._log.given_up) + len(self._log.complete)
        self._log.clear()

    def _shows(self, user: int) -> bool:
        if user not in self._users and len(self._users) < _MAX_USERS:
            self._users.append(user)
        return user in self._users

    def _count(self, cycle_id: int) -> int:
        """Return the number of a cycle; for id 0, the number of the latest cycle, or 1."""
        if not cycle_id:
            return max(self.n_cycles, 1)
        if cycle_id not in self._cycles:
            self.n_cycles += 1
            self._cycles.put(cycle_id, self.n_cycles)
        return self._cycles[cycle_id]


def _path(user: int) -> str:
    return f'{WORLD}/user_{user}'
