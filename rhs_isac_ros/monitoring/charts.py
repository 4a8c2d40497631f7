"""The charts of a network over its cycles: errors, capacity, latencies and losses."""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.monitoring.entities import Entry, Lines, Number, Points, Series, user_colour
from rhs_isac_ros.positioning import WeightedModes
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.newest import NewestDict

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
_GREY = (0.3, 0.3, 0.3)
_WHITE = (1.0, 1.0, 1.0)
_GRID_WIDTH, _LINE_WIDTH, _BAR_WIDTH = 0.6, 2.0, 9.0
# Labels have no ball that would be visible.
_INVISIBLE_M = 1e-3


def axes() -> tuple[Lines, Points]:
    """Return the grid of the chart and its labels."""
    places = np.arange(-REACH_M, REACH_M + _STEP_M / 2, _STEP_M)
    grid = [_line(place, HEIGHT_M) for place in places]
    grid += [np.array([[-REACH_M, -level * HEIGHT_M], [REACH_M, -level * HEIGHT_M]])
             for level in (0.0, *_GRID_LEVELS)]
    labels = [*((place, _LABEL_OFFSET_M, f'{place:+.1f}') for place in places[1:-1:2]),
              *((-REACH_M, -level * HEIGHT_M, f'{level:.0%}') for level in _GRID_LEVELS)]
    return (Lines(tuple(grid), _GREY, _GRID_WIDTH),
            Points(np.array([label[:2] for label in labels]), np.full((len(labels), 3), 0.7),
                   np.full(len(labels), _INVISIBLE_M), tuple(label[2] for label in labels)))


def bars(user: int, found: WeightedModes, origin: np.ndarray) -> Lines:
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


def estimate(position: np.ndarray, origin: np.ndarray) -> Lines:
    """Return an estimate, float64 [3] [m], as a white line; the origin is as in `bars`."""
    error = float(np.linalg.norm(position) - np.linalg.norm(origin))
    return Lines((_line(error, HEIGHT_M),), _WHITE, _LINE_WIDTH)


def _line(place: float, height: float) -> np.ndarray:
    return np.array([[place, 0.0], [place, -height]])
