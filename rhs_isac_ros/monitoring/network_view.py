"""A network in three dimensions and in charts, over its cycles."""

import collections
import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import charts, cycle_log
from rhs_isac_ros.monitoring import scene_entities as scene
from rhs_isac_ros.monitoring.charts import Charts
from rhs_isac_ros.monitoring.cycle_log import CycleLog
from rhs_isac_ros.monitoring.entities import Clear, Entity, Entry, Text
from rhs_isac_ros.monitoring.overview import NodeStatus
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.monitoring.scene_state import SceneState
from rhs_isac_ros.positioning import WeightedModes
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.newest import NewestDict

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
        grid, labels = charts.axes()
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
                Entry(cycle, f'{MODES}/found', charts.bars(received.user, found, origin))]

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
                yield f'{WORLD}/board', scene.board(self._scenario, message.analog)
                if message.mode is m.Mode.TRANSMISSION:
                    yield TRANSMISSION, scene.configurations(
                        self._scenario, [message.analog])
                else:
                    self._configurations[message.band] = message.analog
                    bands = sorted(self._configurations)
                    yield POSITIONING, scene.configurations(
                        self._scenario, [self._configurations[band] for band in bands])
            case m.Beam():
                yield f'{WORLD}/beam', scene.lobe(self._scenario, message)
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
                yield f'{MODES}/estimate', charts.estimate(
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
            entries.append(Entry(cycle, LOG, Text(
                f'user {complete.user}: error {complete.error_m:.2f} m, '
                f'loss {complete.capacity.loss_percent:.1f} % '
                f'(cycle {complete.cycle_id})')))
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
