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

import argparse
import functools
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

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
JUMP_M, FOUND_M, N_BEFORE, N_AFTER = 3.0, 0.5, 20, 5


class World(NamedTuple):
    """One plan with its library."""

    scenario: Scenario
    fixed: Codebook
    library: Library

    def codebook_at(self, place: np.ndarray, std_m: float = STD_M) -> Codebook:
        """Return the codebook for a predicted position, or the one for the whole region."""
        return self.library.codebook_at(place, std_m) or self.fixed


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('adaptive', __doc__, positions=2000)
    parser.add_argument('--library', nargs=2, action='append', required=True,
                        metavar=('PLAN', 'FILE'), help=f'one of {", ".join(frame.SYSTEMS)}, and '
                        'a file of python3 -m rhs_isac_ros.codebook library')
    parser.add_argument('--walks', type=integer(0, 10**5), default=200,
                        help='number of walks, and of jumps')
    options = parser.parse_args()
    results = {}
    for name, file in options.library:
        if name not in frame.SYSTEMS:
            parser.error(f'argument --library: {name}, expected one of {sorted(frame.SYSTEMS)}')
        world = World(*frame.system(name), Library.load(input_file(file)))
        world.library.check(world.scenario)
        print(f'\n{name}: {len(world.library.codebooks)} codebooks, {options.positions} '
              f'positions, {options.walks} walks, seed {options.seed}\n')
        results[name] = measure(world, options)
    frame.write_results(options.json, results)


def measure(world: World, options: argparse.Namespace) -> dict:
    """Measure one plan."""
    table = frame.Table(['codebook'], {
        'mean squared error [m^2]': ('mse_m2', 4), 'median [m]': ('median_m', 3),
        'in the 95 % region [%]': ('covered', 1), 'CPU time of an estimate [ms]': ('time_ms', 1)})
    draw, noise, wrong, walks = map(
        np.random.default_rng, np.random.SeedSequence(options.seed).spawn(4))
    scenario, n = world.scenario, options.positions
    centres = scenario.sample_positions(n, draw)
    positions = np.concatenate([
        Cell(tuple(centre), STD_M).positions(scenario, scenario.sample_positions(1, draw))
        for centre in centres])
    fixes, results = {}, {}
    for name, codebook_at in (('whole region', lambda _: world.fixed),
                              ('cell', world.codebook_at)):
        fixes[name], time_s = locate(
            world, positions, centres, codebook_at, noise, new_estimator)
        results[name] = table.row(name, **fixes[name].figures(), time_ms=1e3 * time_s)
    results['ratio'] = frame.mean_interval(
        fixes['cell'].squared, relative_to=fixes['whole region'].squared)
    results['wrong'] = wrong_predictions(world, table, n // 6, wrong)
    print(f'\nratio {frame.shown(results["ratio"], 3)}\n')
    if options.walks:
        results['tracked'] = tracked(world, options.walks, walks)
        results |= jumps(world, options.walks, walks)
    return results


def locate(world: World, positions: np.ndarray, centres: np.ndarray,
           codebook_at: Callable[[np.ndarray], Codebook], rng: np.random.Generator,
           estimator_of: Callable[[Scenario, Codebook], BayesEstimator], knows: bool = True
           ) -> tuple[frame.Fixes, float]:
    """Locate users at positions; return the fixes, and the median CPU time [s].

    The codebook is that for the predicted position, a row of `centres`. The prior is this
    prediction or, unless `knows`, the region.
    """
    estimates, times_s = [], []
    for position, centre in zip(positions, centres, strict=True):
        codebook = codebook_at(centre)
        received = model_of(world.scenario, codebook).sample(position[None], rng)[0]
        begin = time.process_time()
        estimator = estimator_of(world.scenario, codebook)
        estimates.append(estimator.posterior(received, around(centre) if knows else None))
        times_s.append(time.process_time() - begin)
    return frame.Fixes.of(Estimate.of_each(estimates), positions), float(np.median(times_s))


def wrong_predictions(world: World, table: frame.Table, n: int, rng: np.random.Generator
                      ) -> dict:
    """Measure wrong predictions, n for each distance."""
    positions, centres = map(np.concatenate, zip(*(
        displaced(world.scenario, n, distance_m, rng) for distance_m in WRONG_M), strict=True))
    results = {}
    for key, name, knows in (('region', 'wrong cell, prior: region', False),
                             ('prediction', 'wrong cell, prior: prediction', True)):
        fixes, time_s = locate(
            world, positions, centres, world.codebook_at, rng, known_estimator, knows)
        results[key] = table.row(name, **fixes.figures(), time_ms=1e3 * time_s)
    return results


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


def tracked(world: World, n: int, rng: np.random.Generator) -> dict:
    """Measure the tracks of n walks with the fixed codebook, and with those of the library."""
    times_s = PERIOD_S * np.arange(N_CYCLES)
    paths = []
    for _ in range(n):
        walk = RandomWalk(world.scenario, 1.0, rng)
        paths.append(np.array([walk.state(time_s)[0] for time_s in times_s]))
    table = frame.Table(['tracks'], {
        'rms error [m]': ('rms_m', 3), 'in the 95 % region [%]': ('covered', 1),
        'normalised error': ('nees', 2), 'without a fix [%]': ('without_fix', 2)})
    counted = times_s >= WARM_UP_S
    walk_of = np.repeat(np.arange(n), counted.sum())
    results, squared = {}, {}
    for name, follows in (('fixed', False), ('following', True)):
        estimates = [one for path in paths for one in np.array(
            list(track(world, path, times_s, follows, rng)), object)[counted]]
        fixes = frame.Fixes.of(
            Estimate.of_each(estimates), np.concatenate([path[counted] for path in paths]))
        walk = walk_of[fixes.fix]
        squared[name] = np.bincount(walk, fixes.squared) / np.bincount(walk)
        results[name] = table.row(name, **fixes.figures(walk) | {
            'covered': frame.mean_interval(100.0 * fixes.inside, walk)})
    results['ratio'] = np.sqrt(frame.mean_interval(
        squared['following'], relative_to=squared['fixed'])).tolist()
    print(f'\nratio of the rms errors {frame.shown(results["ratio"], 3)}')
    return results


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


def jumps(world: World, n: int, rng: np.random.Generator) -> dict:
    """Measure in which cycle after a jump of 3 m n users are found again."""
    before, after = displaced(world.scenario, n, JUMP_M, rng)
    times_s = PERIOD_S * np.arange(N_BEFORE + N_AFTER)
    found = [0] * (N_AFTER + 1)
    for one, other in zip(before, after, strict=True):
        path = np.array([one] * N_BEFORE + [other] * N_AFTER)
        errors_m = [float(np.linalg.norm(estimate.mean - other)) for estimate in track(
            world, path, times_s, True, rng)][N_BEFORE:]
        found[next((k for k, error_m in enumerate(errors_m) if error_m < FOUND_M), -1)] += 1
    print(f'\nfound within {FOUND_M:g} m after a jump of {JUMP_M:g} m: {found[:-1]} users in the '
          f'first cycles, {found[-1]} later')
    return {'found_after_jump': found}


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


def around(centre: np.ndarray) -> Mixture:
    """Return the prior of a prediction; the pose of the surface is that of the site."""
    return Mixture(np.zeros(1), centre[None], STD_M**2 * np.eye(3)[None])


if __name__ == '__main__':
    frame.run(main)
