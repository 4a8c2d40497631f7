"""Codebooks that follow what is known about the position of a user.

Problem: before a cycle, the position of a user is known to a standard deviation of 0.2 m in each
coordinate. By how much does a codebook for this cell of the region, from a library, reduce the
error, compared with the codebook for the whole region and the same prior? What happens if the
prediction is wrong? How large are the errors of tracks whose codebook follows the prediction?

True positions are drawn from the prior, whose centres are uniform in the region. Each position has
a new estimator, which has not seen the codebook. A wrong prediction is 1, 2 or 3 m away from the
position, in a random horizontal direction. The codebook is that of the wrong cell, and the
position is estimated with the region as prior, or with the wrong prediction as prior.

Tracks are those of walks between random positions, with a cycle each 0.1 s; multipath and noise
are independent in each cycle. The role `Positioner` proposes the codebook of each cycle, as in the
network. Cycles within the first two seconds are not counted. Other users jump by 3 m after two
seconds at rest, and are found again once the error is at most 0.5 m.

The intervals of ratios are from resampling positions or walks. The 95 % region is the ellipsoid of
the covariance that contains 95 % of a Gaussian.
"""

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from parts import frame

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.cell import Cell
from rhs_isac_ros.codebook.library import EMPTY, Library
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.mobility import RandomWalk
from rhs_isac_ros.positioning import BayesEstimator, Estimate, Mixture
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.protocol.settings import TRACK, PositionerSettings
from rhs_isac_ros.support.arguments import input_file, integer
from rhs_isac_ros.system import System

STD_M = 0.2
WRONG_M = (1.0, 2.0, 3.0)
PERIOD_S, N_CYCLES, WARM_UP_S = 0.1, 40, 2.0
TIMES_S = PERIOD_S * np.arange(N_CYCLES)
COUNTED = TIMES_S >= WARM_UP_S
JUMP_M, FOUND_M, N_BEFORE, N_AFTER = 3.0, 0.5, 20, 5
# Numbers of positions and of walks of a job.
POSITIONS, WALKS = 200, 20


class World(NamedTuple):
    """One plan with its library."""

    scenario: Scenario
    fixed: Codebook
    library: Library

    def codebook_at(self, place: np.ndarray, std_m: float = STD_M) -> Codebook:
        """Return the codebook for a predicted position, or the one for the whole region."""
        return self.library.codebook_at(place, std_m) or self.fixed


# Measures a block.
Measurement: TypeAlias = Callable[['Block'], Mapping[str, Any]]


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('adaptive', __doc__, positions=2000, has_jobs=True)
    parser.add_argument('--library', nargs=2, action='append', required=True,
                        metavar=('PLAN', 'FILE'), help=f'one of {", ".join(frame.SYSTEMS)}, and '
                        'a file of python3 -m rhs_isac_ros.codebook library')
    parser.add_argument('--walks', type=integer(0, 10**5), default=200,
                        help='number of walks, and of jumps')
    options = parser.parse_args()
    for name, file in options.library:
        if name not in frame.SYSTEMS:
            parser.error(f'argument --library: {name}, expected one of {sorted(frame.SYSTEMS)}')
        world_of(name, str(input_file(file)))
    counts = {located: options.positions, misled: len(WRONG_M) * (options.positions // 6),
              tracked: options.walks, jumped: options.walks}
    cases = {(name, function.__name__, case, first): {
        'function': function.__name__, 'plan': name, 'library': file, 'case': case,
        'first': first, 'n_positions': options.positions, 'n_walks': options.walks,
        'seed': options.seed}
        for name, file in options.library for function, n_cases in CASES.items()
        for case in range(n_cases) for first in range(0, counts[function], BLOCKS[function])}
    jobs = frame.measured(options, 'adaptive', block, {
        ' '.join(map(str, key)): arguments for key, arguments in cases.items()})
    found = dict(zip(cases, jobs.values(), strict=True))
    results = {}
    for name, file in options.library:
        print(f'\n{name}: {len(world_of(name, file).library.codebooks)} codebooks, '
              f'{options.positions} positions, {options.walks} walks, seed {options.seed}\n')
        results[name] = report({
            (function, case): [one for key, one in found.items() if key[:3] == (
                name, function.__name__, case)]
            for function, n_cases in CASES.items() for case in range(n_cases)}, options.walks)
    frame.write_results(options.json, results)


def block(function: str, **arguments: Any) -> Mapping[str, Any]:
    """Run a job: a block of positions or walks of a measurement.

    The random numbers are those of all positions and walks, one after the other.
    """
    (measurement,) = (one for one in CASES if one.__name__ == function)
    return measurement(Block(**arguments))


class Block(NamedTuple):
    """A block of positions or walks from `first` on, with one of the cases of a measurement."""

    plan: str
    library: str
    case: int
    first: int
    n_positions: int
    n_walks: int
    seed: int

    @property
    def world(self) -> World:
        """The plan with its library."""
        return world_of(self.plan, self.library)

    def generators(self) -> list[np.random.Generator]:
        """Return generators for positions, their noise, wrong predictions, and walks."""
        return [*map(np.random.default_rng, np.random.SeedSequence(self.seed).spawn(4))]

    def skip(self, n: int, rng: np.random.Generator) -> None:
        """Draw as many random numbers as n signals of any codebook contain."""
        model = model_of(self.world.scenario, self.world.fixed)
        for _ in range(n):
            model.sample(self.world.scenario.roi_bounds_m[:1], rng)


def report(found: Mapping[tuple[Measurement, int], list[Any]], n_walks: int) -> dict:
    """Print and return the figures of one plan."""
    table = frame.Table(['codebook'], {
        'mean squared error [m^2]': ('mse_m2', 4), 'median [m]': ('median_m', 3),
        'in the 95 % region [%]': ('covered', 1), 'CPU time of an estimate [ms]': ('time_ms', 1)})

    def fixes_of(function: Measurement, case: int) -> tuple[frame.Fixes, np.ndarray]:
        *fixes, times_s = (np.concatenate(parts) for parts in zip(
            *(one['fixes'] for one in found[function, case]), strict=True))
        return frame.Fixes(*fixes), times_s

    def row(text: str, function: Measurement, case: int) -> tuple[frame.Fixes, dict]:
        fixes, times_s = fixes_of(function, case)
        return fixes, table.row(text, **fixes.figures(), time_ms=1e3 * np.median(times_s))
    (whole, of_whole), (cell, of_cell) = (
        row(name, located, case) for case, name in enumerate(('whole region', 'cell')))
    results: dict[str, Any] = {
        'whole region': of_whole, 'cell': of_cell,
        'ratio': frame.mean_interval(cell.squared, relative_to=whole.squared)}
    if found[misled, 0]:
        results['wrong'] = {key: row(f'wrong cell, prior: {key}', misled, case)[1]
                            for case, key in enumerate(('region', 'prediction'))}
    print(f'\nratio {frame.shown(results["ratio"], 3)}\n')
    if not n_walks:
        return results
    table = frame.Table(['tracks'], {
        'rms error [m]': ('rms_m', 3), 'in the 95 % region [%]': ('covered', 1),
        'normalised error': ('nees', 2), 'without a fix [%]': ('without_fix', 2)})
    walk_of = np.repeat(np.arange(n_walks), np.count_nonzero(COUNTED))
    tracks, squared = {}, {}
    for case, name in enumerate(('fixed', 'following')):
        fixes, _ = fixes_of(tracked, case)
        walk = walk_of[fixes.fix]
        squared[name] = np.bincount(walk, fixes.squared) / np.bincount(walk)
        tracks[name] = table.row(name, **fixes.figures(walk) | {
            'covered': frame.mean_interval(100.0 * fixes.inside, walk)})
    tracks['ratio'] = np.sqrt(frame.mean_interval(
        squared['following'], relative_to=squared['fixed'])).tolist()
    print(f'\nratio of the rms errors {frame.shown(tracks["ratio"], 3)}')
    places = [place for one in found[jumped, 0] for place in one['found']]
    counts = np.bincount(places, minlength=N_AFTER + 1).tolist()
    print(f'\nfound within {FOUND_M:g} m after a jump of {JUMP_M:g} m: {counts[:-1]} users in '
          f'the first cycles, {counts[-1]} later')
    return results | {'tracked': tracks, 'found_after_jump': counts}


def located(block: Block) -> Mapping[str, Any]:
    """Locate users with a prior, and the codebook of the whole region or of their cell."""
    draw, noise, _, _ = block.generators()
    scenario = block.world.scenario
    centres = scenario.sample_positions(block.n_positions, draw)
    positions = np.concatenate([
        Cell(tuple(centre), STD_M).positions(scenario, scenario.sample_positions(1, draw))
        for centre in centres])
    block.skip(block.case * block.n_positions, noise)
    return estimates(
        block, positions, centres, block.world.codebook_at if block.case else
        lambda _: block.world.fixed, noise, new_estimator)


def misled(block: Block) -> Mapping[str, Any]:
    """Locate users with the codebook of a wrong cell, and the region or this cell as prior."""
    _, _, rng, _ = block.generators()
    positions, centres = map(np.concatenate, zip(*(
        displaced(block.world.scenario, block.n_positions // 6, distance_m, rng)
        for distance_m in WRONG_M), strict=True))
    block.skip(block.case * len(positions), rng)
    return estimates(block, positions, centres, block.world.codebook_at, rng, known_estimator,
                     knows=block.case == 1)


def estimates(block: Block, positions: np.ndarray, centres: np.ndarray,
              codebook_at: Callable[[np.ndarray], Codebook], rng: np.random.Generator,
              estimator_of: Callable[[Scenario, Codebook], BayesEstimator], knows: bool = True
              ) -> Mapping[str, Any]:
    """Locate the users of a block; return the fixes, and the CPU times [s].

    The codebook is that for the predicted position, a row of `centres`. The prior is this
    prediction or, unless `knows`, the region.
    """
    block.skip(block.first, rng)
    rows = slice(block.first, block.first + POSITIONS)
    found, times_s = [], []
    for position, centre in zip(positions[rows], centres[rows], strict=True):
        codebook = codebook_at(centre)
        received = model_of(block.world.scenario, codebook).sample(position[None], rng)[0]
        begin = time.process_time()
        estimator = estimator_of(block.world.scenario, codebook)
        found.append(estimator.posterior(received, around(centre) if knows else None))
        times_s.append(time.process_time() - begin)
    return {'fixes': [*frame.Fixes.of(Estimate.of_each(found), positions[rows]), times_s]}


def displaced(scenario: Scenario, n: int, distance_m: float, rng: np.random.Generator
              ) -> tuple[np.ndarray, np.ndarray]:
    """Draw n positions and predictions at a horizontal distance, all in the region."""
    low, high = scenario.roi_bounds_m
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    while len(pairs) < n:
        position, angle = scenario.sample_positions(1, rng)[0], rng.uniform(0, 2 * np.pi)
        centre = position + distance_m * np.array([np.cos(angle), np.sin(angle), 0.0])
        if (centre >= low).all() and (centre <= high).all():
            pairs.append((position, centre))
    positions, centres = map(np.stack, zip(*pairs, strict=True))
    return positions, centres


def paths_of(block: Block, rng: np.random.Generator) -> list[np.ndarray]:
    """Draw the positions of all walks."""
    paths = []
    for _ in range(block.n_walks):
        walk = RandomWalk(block.world.scenario, 1.0, rng)
        paths.append(np.array([walk.state(time_s)[0] for time_s in TIMES_S]))
    return paths


def tracked(block: Block) -> Mapping[str, Any]:
    """Track walks with the fixed codebook, or with those of the library."""
    *_, rng = block.generators()
    paths = paths_of(block, rng)
    block.skip((block.case * block.n_walks + block.first) * N_CYCLES, rng)
    paths = paths[block.first:block.first + WALKS]
    found = [one for path in paths for one in np.array(
        list(track(block.world, path, TIMES_S, block.case == 1, rng)), object)[COUNTED]]
    return {'fixes': [*frame.Fixes.of(
        Estimate.of_each(found), np.concatenate([path[COUNTED] for path in paths])), []]}


def track(world: World, path: np.ndarray, times_s: np.ndarray, follows: bool,
          rng: np.random.Generator) -> Iterator[Estimate]:
    """Yield the estimates of the positioner for a walk, with the codebooks that it proposes."""
    codebook = world.fixed
    positioner = Positioner(
        world.scenario, time.perf_counter, PositionerSettings(prior=TRACK),
        library=world.library if follows else EMPTY)
    positioner.handle(events.CodebookOffered(codebook), 0.0)
    positioner.handle(events.EstimatorBuilt(
        codebook, known_estimator(world.scenario, codebook)), 0.0)
    for cycle_id, (time_s, position) in enumerate(zip(times_s.tolist(), path, strict=True), 1):
        signals = model_of(world.scenario, codebook).sample(position[None], rng)[0]
        actions = positioner.handle(m.ReceivedSignals(
            cycle_id=cycle_id, user=1, codebook_id=codebook.id,
            signals=signals.reshape(codebook.digital.shape[:3])), time_s)
        yield next((one.estimate for one in actions if isinstance(one, events.PublishTrack)),
                   Estimate(np.full(3, np.nan), np.full((3, 3), np.nan)))
        proposed = [one.message.next_codebook_id for one in actions if isinstance(
            one, events.Send) and isinstance(one.message, m.PositionEstimate)]
        codebook = world.library.by_id.get(*proposed, world.fixed) if proposed else world.fixed


def jumped(block: Block) -> Mapping[str, Any]:
    """Return in which cycle after a jump of 3 m users are found again."""
    *_, rng = block.generators()
    paths_of(block, rng)
    block.skip(2 * block.n_walks * N_CYCLES, rng)
    before, after = displaced(block.world.scenario, block.n_walks, JUMP_M, rng)
    times_s = PERIOD_S * np.arange(N_BEFORE + N_AFTER)
    block.skip(block.first * len(times_s), rng)
    rows, found = slice(block.first, block.first + WALKS), []
    for one, other in zip(before[rows], after[rows], strict=True):
        path = np.array([one] * N_BEFORE + [other] * N_AFTER)
        errors_m = [float(np.linalg.norm(estimate.mean - other)) for estimate in track(
            block.world, path, times_s, True, rng)][N_BEFORE:]
        found.append(next((k for k, error_m in enumerate(errors_m) if error_m < FOUND_M),
                          N_AFTER))
    return {'found': found}


# The measurements with their numbers of cases, and the positions or walks of a job.
CASES: dict[Measurement, int] = {located: 2, misled: 2, tracked: 2, jumped: 1}
BLOCKS = {located: POSITIONS, misled: POSITIONS, tracked: WALKS, jumped: WALKS}


def new_estimator(scenario: Scenario, codebook: Codebook) -> BayesEstimator:
    """Return an estimator that has not seen the codebook."""
    return BayesEstimator(System(scenario, codebook), lazy=True)


@functools.lru_cache(maxsize=512)
def known_estimator(scenario: Scenario, codebook: Codebook) -> BayesEstimator:
    """Return an estimator with the table of the region, which it keeps."""
    return BayesEstimator(System(scenario, codebook))


@functools.lru_cache(maxsize=1024)
def model_of(scenario: Scenario, codebook: Codebook) -> MeasurementModel:
    """Return the model of the signals."""
    return MeasurementModel(scenario, codebook).prepare()


@functools.lru_cache(maxsize=4)
def world_of(plan: str, library: str) -> World:
    """Load a plan and its library."""
    world = World(*frame.system(plan), Library.load(Path(library)))
    world.library.check(world.scenario)
    return world


def around(centre: np.ndarray) -> Mixture:
    """Return the prior of a prediction; the pose of the surface is that of the site."""
    return Mixture(np.zeros(1), centre[None], STD_M**2 * np.eye(3)[None])


if __name__ == '__main__':
    frame.run(main)
