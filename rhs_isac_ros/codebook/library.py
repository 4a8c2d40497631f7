"""A library of codebooks: one for each cell of the region and each uncertainty of the position.

The codebook of a cell is optimised for a user whose position is known to a standard deviation, the
spread. Cells form a lattice in the region, with a pitch for each spread. The pitch follows from a
loss: by how much the objective of a codebook exceeds that of one optimised for the very position,
on average over the positions in its cell.

A network always has a library, in addition to the codebook for the whole region: `EMPTY`, unless
it is given another one.
"""

import dataclasses
import functools
import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.codebook.cell import Cell
from rhs_isac_ros.codebook.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.objective import OBJECTIVES, sobol
from rhs_isac_ros.codebook.optimize import optimisation, optimised, result_of
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import numbers
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.files import ArchiveError, read_archive, write_archive
from rhs_isac_ros.support.jobs import HERE, Job, Strand, Workers

# Default spreads [m], and the loss from which the pitch of their cells follows.
SPREADS_M = (0.2, 0.5)
LOSS = 0.05
# Pitches that are tried [spreads], and number of positions at which their loss is measured.
_PITCHES = (8.0, 6.25, 5.0, 4.0, 3.0, 2.0)
_N_TRIALS = 12
# Positions and steps of an optimisation; few suffice, because it starts from a good codebook.
_N_POSITIONS = 32
_STEPS = 60
_FORMAT = 1
# Errors of rounding in the cells of a file [m].
_TOLERANCE_M = 1e-6
_ARRAYS = ('centres_m', 'spreads_m', 'analog', 'digital')


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that determines the codebooks of a library."""

    scenario: str  #: Id of the scenario.
    start: str  #: Id of the codebook from which the optimisations start.
    objective: str  #: Name of the objective.
    spreads_m: tuple[float, ...]  #: Standard deviations of each coordinate [m].
    pitches_m: tuple[float, ...]  #: Distance of the cells' centres for each spread [m].

    def cells(self, scenario: Scenario) -> list[Cell]:
        """Return all cells, in the frame of the surface."""
        cells = []
        for spread_m, pitch_m in zip(self.spreads_m, self.pitches_m, strict=True):
            numbers = [max(int(np.ceil(size / pitch_m - 1e-9)), 1) for size in scenario.roi_size_m]
            lines = [low + (np.arange(n) + 0.5) * (high - low) / n for low, high, n in zip(
                *scenario.roi_bounds_m, numbers, strict=True)]
            cells += [Cell(centre, spread_m) for centre in itertools.product(*lines)]
        return cells


@dataclasses.dataclass(frozen=True, eq=False)
class Library:
    """Codebooks of the L cells of a plan.

    Raises CodebookError if a codebook is malformed.
    """

    plan: Plan
    centres_m: np.ndarray  #: Centres of the cells in the frame of the surface, float64 [L, 3] [m].
    spreads_m: np.ndarray  #: Float64 [L] [m].
    analog: np.ndarray  #: Of `Codebook`, float64 [L, N_B, F, N_E].
    digital: np.ndarray  #: Of `Codebook`, complex128 [L, N_B, N_SB, F, K].

    @classmethod
    def of(cls, plan: Plan, cells: Sequence[Cell], codebooks: Sequence[Codebook]) -> 'Library':
        """Return the library of some cells and their codebooks, at least one."""
        return cls(plan, np.array([cell.centre_m for cell in cells]),
                   np.array([cell.std_m for cell in cells]),
                   np.stack([one.analog for one in codebooks]),
                   np.stack([one.digital for one in codebooks]))

    @functools.cached_property
    def codebooks(self) -> tuple[Codebook, ...]:
        """The codebooks of the cells."""
        return tuple(map(Codebook, self.analog, self.digital))

    @functools.cached_property
    def by_id(self) -> Mapping[str, Codebook]:
        """The codebooks by their ids."""
        return {one.id: one for one in self.codebooks}

    @functools.cached_property
    def id(self) -> str:
        """Hash of cells and codebooks: ``lib`` and 16 hex digits; ``none`` if it is empty."""
        content = ([one.id for one in self.codebooks], self.centres_m.tolist(),
                   self.spreads_m.tolist())
        digest = hashlib.sha256(repr(content).encode()).hexdigest()
        return f'lib{digest[:16]}' if self.codebooks else 'none'

    def codebook_at(self, position_m: np.ndarray, std_m: float) -> Codebook | None:
        """Return the codebook for a predicted position, float64 [3] [m], in the surface's frame.

        `std_m` is the root of the mean variance of its coordinates. The spread of the cell is the
        smallest one that is not smaller. If there is none, the result is None: the position is not
        known well enough.
        """
        wider = self.spreads_m[self.spreads_m >= std_m]
        if not wider.size:
            return None
        (rows,) = np.nonzero(self.spreads_m == wider.min())
        distances = np.sum((self.centres_m[rows] - position_m)**2, axis=1)
        return self.codebooks[rows[np.argmin(distances)]]

    def check(self, scenario: Scenario) -> None:
        """Raise CodebookError if the library is incomplete, or for another scenario or plan."""
        expected = scenario.unplaced.id
        if self.plan.scenario != expected:
            raise CodebookError(f'scenario: {self.plan.scenario}, expected {expected}')
        cells = self.plan.cells(scenario)
        if len(self.codebooks) != len(cells):
            raise CodebookError(f'codebooks: {len(self.codebooks)}, expected {len(cells)}')
        both: dict[str, list[Any]] = {'centres_m': [cell.centre_m for cell in cells],
                                      'spreads_m': [cell.std_m for cell in cells]}
        for name, planned in both.items():
            found = getattr(self, name)
            wrong = np.argwhere(np.abs(found - np.array(planned)) > _TOLERANCE_M)
            if wrong.size:
                raise CodebookError(f'{name}[{(row := wrong[0, 0])}]: {found[row].tolist()}, '
                                    f'expected {planned[row]} of the plan')
        for one in self.codebooks:
            one.check(scenario)

    def save(self, path: str | Path) -> None:
        """Write one file atomically; raise OSError if it cannot be written."""
        write_archive(path, {name: getattr(self, name) for name in _ARRAYS},
                      {'format': _FORMAT, **dataclasses.asdict(self.plan)})

    @classmethod
    def load(cls, path: str | Path) -> 'Library':
        """Read a file; raise CodebookError if it is no library, or damaged."""
        with translated(ArchiveError, CodebookError):
            arrays, about = read_archive(path, 'library of codebooks', _FORMAT, {*_ARRAYS})
        with translated((ValueError, TypeError), CodebookError, path):
            for name in ('centres_m', 'spreads_m'):
                arrays[name] = numbers(name, arrays[name])
            if not (arrays['spreads_m'] > 0).all():
                raise CodebookError(
                    f'spreads_m: {arrays["spreads_m"].min():g}, expected lengths above 0')
            lengths = {len(np.atleast_1d(array)) for array in arrays.values()}
            if len(lengths) != 1 or arrays['centres_m'].shape[1:] != (3,):
                raise CodebookError(f'lengths {sorted(lengths)}, expected one for all arrays')
            fields: dict[str, Any] = {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in about.items()}
            library = cls(Plan(**fields), **arrays)
            _ = library.codebooks
        return library


#: The library without cells, which has no codebook for any prediction.
EMPTY = Library(Plan('', '', '', (), ()), np.empty((0, 3)), np.empty(0),
                np.empty((0, 1, 1, 1)), np.empty((0, 1, 1, 1, 1), complex))


def make_library(
        scenario: Scenario, start: Codebook, objective: str,
        spreads_m: Sequence[float] = SPREADS_M, loss: float = LOSS,
        report: Callable[[float, float, float], None] | None = None,
        workers: Workers = HERE) -> Library:
    """Choose the cells, and optimise their codebooks from one for the whole region.

    The pitch for each spread is the largest one tried with a small enough loss. `report` is called
    with each spread [m], pitch [m] and loss. Raises ValueError if the objective is unknown, and
    the errors of `Workers.run`.
    """
    if objective not in OBJECTIVES:
        raise ValueError(f'objective: {objective!r}, expected one of {sorted(OBJECTIVES)}')

    def of_spread(spread_m: float) -> Strand[tuple[float, list[Codebook]]]:
        pitch_m = yield from pitch(scenario, start, objective, spread_m, loss, report)
        part = Plan(scenario.unplaced.id, start.id, objective, (spread_m,), (pitch_m,))
        return pitch_m, (yield from codebooks_of(scenario, part.cells(scenario), start, objective))

    found = workers.run([of_spread(spread_m) for spread_m in spreads_m])
    plan = Plan(scenario.unplaced.id, start.id, objective, tuple(spreads_m),
                tuple(pitch_m for pitch_m, _ in found))
    return Library.of(plan, plan.cells(scenario), [one for _, part in found for one in part])


def pitch(scenario: Scenario, start: Codebook, objective: str, spread_m: float, loss: float,
          report: Callable[[float, float, float], None] | None = None) -> Strand[float]:
    """Find the pitch of the cells for a spread [m]; see `make_library`."""
    rng = streams.generator(0, streams.SAMPLES)
    places = scenario.sample_positions(_N_TRIALS, rng)
    own = yield from codebooks_of(
        scenario, [Cell(place, spread_m) for place in places], start, objective)
    pitch_m = spread_m
    for pitch_m in spread_m * np.array(_PITCHES):
        # A codebook is used at most half a pitch from the centre of its cell.
        offsets = pitch_m * (rng.random(places.shape) - 0.5)
        centres = np.clip(places - offsets, *scenario.roi_bounds_m)
        others = yield from codebooks_of(
            scenario, [Cell(centre, spread_m) for centre in centres], start, objective)
        values = yield compared, [Job.of('compared', {
            'scenario': scenario.changes(), 'objective': objective, 'cell': (place, spread_m),
            'codebooks': [one.to_parameters() for one in pair]})
            for place, *pair in zip(places, others, own, strict=True)]
        totals = np.sum([one['values'] for one in values], axis=0)
        found = float(totals[0] / totals[1] - 1)
        if report:
            report(spread_m, float(pitch_m), found)
        if found <= loss:
            break
    return float(pitch_m)


def compared(scenario: Mapping[str, Any], objective: str, cell: Sequence[Any],
             codebooks: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Run a job: evaluate the objective of codebooks for a user in a cell."""
    world, own = Scenario(**scenario), Cell(*cell)
    rng = streams.generator(0, streams.HELD_OUT)
    average = OBJECTIVES[objective](
        world, own.positions(world, sobol(world, 2 * _N_POSITIONS, rng)), rng, prior=own)
    return {'values': [average.value(Codebook.from_parameters(dict(one))) for one in codebooks]}


def codebooks_of(scenario: Scenario, cells: Sequence[Cell], start: Codebook, objective: str
                 ) -> Strand[list[Codebook]]:
    """Optimise a codebook for each cell, from one for the whole region."""
    jobs = [optimisation(scenario, objective=objective, n_positions=_N_POSITIONS, start=start,
                         max_steps=_STEPS, cell=cell) for cell in cells]
    return [result_of(found).codebook for found in (yield optimised, jobs)]
