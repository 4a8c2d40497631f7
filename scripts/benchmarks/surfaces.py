"""Positioning with several surfaces of one site.

Problem: one surface determines directions well and the range badly. How much do a second surface
at a right angle to the first one, or opposite of it, and a third one reduce the error? Do the
covariances contain the errors, also if the poses of the surfaces are slightly wrong? How soon is a
wrong pose noticed?

The surfaces are at (0, 0, 0), (10, -10, 0) and (20, 0, 0) m and face the centre of the region, so
that all of them see the same region. All surfaces receive the same pilots. The signals of each are
simulated independently: multipath and noise of different surfaces have no common part. Case
front_side_pose shifts and turns both surfaces by random errors of 2 cm in each coordinate and 0.2
degrees about each axis, new ones for each position, which the poses declare; all other poses are
exact. In case half_frames, two surfaces have half as many frames and a codebook that is optimised
for these, so the number of pilots of both together is that of one surface with all frames.

A wrong pose of the second surface, by 0.3 m or 5 degrees, is tested with poses that declare 2 cm
and 0.2 degrees. The share of detections is for random windows of 50 of the positions. From each 50
positions in turn, the pose of the second surface is estimated; the search begins at a pose with
random errors of 0.3 m in each coordinate and 5 degrees about each axis.

The intervals of the mean squared error are 1.96 standard errors wide on both sides. The 95 %
region is the ellipsoid of the covariance that contains 95 % of a Gaussian. The normalised error
(NEES) is 3 for a Gaussian with the right covariance.
"""

import argparse
import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from parts import frame
from scipy.stats import chi2

from rhs_isac_ros.bounds import site_crlb
from rhs_isac_ros.codebook import Codebook, optimize
from rhs_isac_ros.model import MeasurementModel, Pose, Scenario
from rhs_isac_ros.positioning import BayesEstimator, Estimate, Sighting, fuse
from rhs_isac_ros.positioning.agreement import WINDOW, PoseTest, pair_agreements
from rhs_isac_ros.positioning.alignment import estimate_pose
from rhs_isac_ros.positioning.fusion import Fuser
from rhs_isac_ros.system import System

EXACT, DECLARED = (0.0, 0.0), (0.02, 0.2)
POSES = {'front': Pose(uncertainty=EXACT),
         'side': Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0), EXACT),
         'opposite': Pose((20.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), EXACT)}
SITES = {'front': ['front'], 'front_side': ['front', 'side'],
         'front_opposite': ['front', 'opposite'], 'three': ['front', 'side', 'opposite']}
CASES = (*SITES, 'front_side_pose', 'half_frames', 'wrong_pose', 'estimated_pose')
PAIR = ('front', 'side')
# Errors of the pose of the side surface: shifts [m] and turns [rad] in the frame of the site.
WRONG = {'x_0.3m': (0.3, 0, 0, 0, 0, 0), 'y_0.3m': (0, 0.3, 0, 0, 0, 0),
         'z_0.3m': (0, 0, 0.3, 0, 0, 0), 'roll_5deg': (0, 0, 0, np.radians(5), 0, 0),
         'pitch_5deg': (0, 0, 0, 0, np.radians(5), 0), 'yaw_5deg': (0, 0, 0, 0, 0, np.radians(5))}
# Number of positions from which a pose is estimated; errors of the pose where the search begins.
GROUP, START = 50, np.repeat([0.3, np.radians(5)], 3)
ERRORS = {'none': (0.0,) * 6, **WRONG}
# Number of random windows, of positions for each wrong pose, and of positions of a job.
WINDOWS, WRONG_POSITIONS, BLOCK = 400, 500, 5 * GROUP


class World(NamedTuple):
    """One plan, its positions, and the estimator of a surface."""

    scenario: Scenario
    model: MeasurementModel
    estimator: BayesEstimator
    positions: np.ndarray  # Float64 [N, 3] [m], in the frame of the site.

    def posteriors(self, poses: list[Pose], rng: np.random.Generator, rows: range
                   ) -> dict[int, Estimate]:
        """Return posteriors of a surface, which has another pose for each position, by row.

        The random numbers are those of all positions.
        """
        places = np.array([pose.to_surface(place) for pose, place in zip(
            poses, self.positions, strict=True)])
        received = self.model.sample(places, rng)
        return {row: self.estimator.posterior(received[row]) for row in rows}


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('surfaces', __doc__, positions=3000, has_jobs=True)
    add = parser.add_argument
    add('--plan', choices=frame.SYSTEMS, action='append', help='leave out other plans')
    add('--case', choices=CASES, action='append', help='leave out other cases')
    options = parser.parse_args()
    cases, n = options.case or CASES, options.positions
    # The codebooks of half the frames are optimised in one job, which begins first.
    groups = [([case], size) for case, size in (('half_frames', n), ('front_side_pose', BLOCK))
              if case in cases]
    if others := [case for case in cases if [case] not in (group for group, _ in groups)]:
        groups.append((others, BLOCK))
    jobs = {(plan, ' '.join(group), first): {
        'plan': plan, 'cases': group, 'first': first, 'last': min(first + size, n), 'n': n,
        'seed': options.seed}
        for plan in options.plan or frame.SYSTEMS for group, size in groups
        for first in range(0, n, size)}
    found = frame.measured(options, 'surfaces', block, {
        ' '.join(map(str, key)): arguments for key, arguments in jobs.items()})
    results = {}
    for plan in options.plan or frame.SYSTEMS:
        print(f'\n{plan}: {options.positions} positions, seed {options.seed}\n')
        results[plan] = report(plan, cases, options, [
            one for key, one in zip(jobs, found.values(), strict=True) if key[0] == plan])
    frame.write_results(options.json, results)


def report(plan: str, cases: Sequence[str], options: argparse.Namespace,
           blocks: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Print and return the figures of one plan from its blocks."""
    table = frame.Table(['surfaces'], {
        'mean squared error [m^2]': ('mse_m2', 4), 'median error [m]': ('median_m', 3),
        'in the 95 % region [%]': ('covered', 1), 'NEES': ('nees', 2),
        'average CRLB [m^2]': ('crlb_m2', 4), 'fusion [ms]': ('time_ms', 1)})
    parts = {case: [one[case] for one in blocks if case in one] for case in cases}
    results: dict[str, Any] = {
        case: table.row(case, **compared(parts[case]))
        for case in (*SITES, 'front_side_pose', 'half_frames') if case in cases}
    if 'wrong_pose' in cases:
        *_, windows, _, _ = generators(options.seed)
        results['wrong_pose'] = wrong_poses(options.positions, parts['wrong_pose'], windows)
    if 'estimated_pose' in cases:
        results['estimated_pose'] = estimated_poses(parts['estimated_pose'])
    return results


def generators(seed: int) -> list[np.random.Generator]:
    """Return generators for positions, each surface, poses, windows, half the frames, starts.

    The random numbers of a case do not depend on the other cases.
    """
    return [*map(np.random.default_rng, np.random.SeedSequence(seed).spawn(5 + len(POSES)))]


def block(plan: str, cases: Sequence[str], first: int, last: int, n: int, seed: int
          ) -> Mapping[str, Any]:
    """Run a job: locate users at some of the n positions, and fuse what the surfaces find."""
    draw, *of_surface, pose_errors, _, half_frames, starts = generators(seed)
    scenario, codebook = frame.system(plan)
    positions = scenario.sample_positions(n, draw)
    rows, pair = range(first, last), [POSES[name] for name in PAIR]
    if 'half_frames' in cases:
        half = dataclasses.replace(scenario, n_frames=scenario.n_frames // 2)
        world = make_world(half, optimize(half, objective='error').codebook, positions)
        shared = [world.posteriors([pose] * n, half_frames, rows) for pose in pair]
        return {'half_frames': compare(world, shared, pair, rows)}
    world = make_world(scenario, codebook, positions)
    if 'front_side_pose' in cases:
        poses = [dataclasses.replace(pose, uncertainty=DECLARED) for pose in pair]
        displaced = [world.posteriors([pose.displaced(pose_errors.multivariate_normal(
            np.zeros(6), pose.covariance)) for _ in range(n)], pose_errors, rows)
            for pose in poses]
        return {'front_side_pose': compare(world, displaced, poses, rows)}
    needed = {name for one in cases for name in SITES.get(one, POSES)}
    found = {name: world.posteriors([POSES[name]] * n, rng, rows)
             for name, rng in zip(POSES, of_surface, strict=True) if name in needed}
    results: dict[str, Any] = {}
    for one in cases:
        if one in SITES:
            results[one] = compare(world, [found[name] for name in SITES[one]],
                                   [POSES[name] for name in SITES[one]], rows)
        elif one == 'wrong_pose':
            results[one] = agreements(found, scenario, n, rows)
        else:
            results[one] = poses_of_groups(found, scenario, n, rows, starts)
    return results


def make_world(scenario: Scenario, codebook: Codebook, positions: np.ndarray) -> World:
    """Return the model and the estimator of a surface."""
    return World(scenario, MeasurementModel(scenario, codebook),
                 BayesEstimator(System(scenario, codebook)), positions)


def sightings_of(found: Sequence[Mapping[int, Estimate]], poses: Sequence[Pose], row: int
                 ) -> list[Sighting]:
    """Return the sightings of the surfaces with a position."""
    return [one.at(pose) for posteriors, pose in zip(found, poses, strict=True)
            if (one := posteriors[row].sighting)]


def compare(world: World, found: Sequence[Mapping[int, Estimate]], poses: list[Pose], rows: range
            ) -> list[Any]:
    """Fuse the posteriors of a block; return the fixes, bounds [m^2], and CPU times [s]."""
    n = len(rows)
    means, covariances, times_s = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n)
    for number, row in enumerate(rows):
        sightings = sightings_of(found, poses, row)
        begin = time.process_time()
        fused = fuse(sightings, world.scenario.roi_bounds_m)
        means[number], covariances[number] = fused.mean, fused.covariance
        times_s[number] = time.process_time() - begin
    positions = world.positions[rows.start:rows.stop]
    surfaces = [MeasurementModel(dataclasses.replace(world.scenario, pose=pose), world.model.beams)
                for pose in poses]
    return [*frame.Fixes.of(Estimate(means, covariances), positions),
            site_crlb(surfaces, positions), times_s]


def compared(blocks: Sequence[list[Any]]) -> dict[str, Any]:
    """Return the figures of all blocks of `compare`."""
    *parts, bounds_m2, times_s = (
        np.concatenate(part) for part in zip(*blocks, strict=True))
    fixes = frame.Fixes(*parts)
    mse = fixes.squared.mean()
    margin = 1.96 * fixes.squared.std() / np.sqrt(len(times_s))
    return {**fixes.figures(), 'mse_m2': [mse, mse - margin, mse + margin],
            'crlb_m2': bounds_m2.mean(), 'time_ms': 1e3 * np.median(times_s)}


def n_wrong(n: int) -> int:
    """Return the number of positions for each wrong pose, of n positions."""
    return min(WRONG_POSITIONS, n // 2)


def agreements(found: Mapping[str, Mapping[int, Estimate]], scenario: Scenario, n: int,
               rows: range) -> dict[str, list[dict[str, float]]]:
    """Return how far pairs of surfaces agree at the rows, by the error of the side's pose."""
    poses = {name: dataclasses.replace(pose, uncertainty=DECLARED)
             for name, pose in POSES.items()}
    results = {}
    for name, error in ERRORS.items():
        declared = poses | {'side': poses['side'].displaced(error)}
        last = n_wrong(n) * (1 if name in WRONG else 2)
        cycles = [pair_agreements({
            surface: one.at(pose) for surface, pose in declared.items()
            if (one := found[surface][row].sighting)},
            Fuser(scenario.roi_bounds_m)) for row in rows if row < last]
        results[name] = [{' '.join(pair): value for pair, value in cycle.items()}
                         for cycle in cycles]
    return results


def wrong_poses(n: int, blocks: Sequence[Mapping[str, Any]], rng: np.random.Generator) -> dict:
    """Measure how often wrong poses of the side surface are noticed, and named, in a window."""
    cycles = {name: [{tuple(pair.split()): value for pair, value in cycle.items()}
                     for one in blocks for cycle in one[name]] for name in ERRORS}
    n = n_wrong(n)
    # The references are for other positions than those of the windows.
    references = cycles['none'][n:]
    of_pair = [{PAIR: cycle[PAIR]} for cycle in references if PAIR in cycle]
    print()
    table = frame.Table(['error of the pose'], {
        f'noticed by two surfaces in {WINDOW} cycles': ('noticed', 3),
        'named by three': ('named', 3)})
    results = {}
    for name, pool in cycles.items():
        noticed = named = 0
        for _ in range(WINDOWS):
            window = [pool[number] for number in rng.integers(n, size=WINDOW)]
            two, three = PoseTest(of_pair), PoseTest(references)
            for cycle in window:
                two.add(cycle)
                three.add(cycle)
            noticed += bool(two.suspects())
            named += three.suspects() == (('side',) if name != 'none' else ())
        results[name] = table.row(name, noticed=noticed / WINDOWS, named=named / WINDOWS)
    return results


def poses_of_groups(found: Mapping[str, Mapping[int, Estimate]], scenario: Scenario, n: int,
                    rows: range, rng: np.random.Generator) -> list[list[Any]]:
    """Estimate the pose of the side surface from groups of positions; return errors and NEES."""
    truth, results = POSES['side'], []
    for begin in range(0, n - GROUP + 1, GROUP):
        start = truth.displaced(START * rng.normal(size=6))
        if begin not in rows:
            continue
        both = [pair for row in range(begin, begin + GROUP) if len(pair := sightings_of(
            [found[name] for name in PAIR], [POSES['front'], start], row)) == len(PAIR)]
        pose = estimate_pose(*zip(*both, strict=True), scenario.roi_bounds_m)
        error = pose.error_of(truth)
        results.append([error, error @ np.linalg.solve(pose.covariance, error)])
    return results


def estimated_poses(blocks: Sequence[list[list[Any]]]) -> dict:
    """Return the figures of all blocks of `poses_of_groups`."""
    errors, squares = zip(*(group for one in blocks for group in one), strict=True)
    shifts_m, turns_deg = (np.linalg.norm(part, axis=1) for part in np.split(
        np.array(errors) * [1, 1, 1, *np.degrees([1, 1, 1])], 2, axis=1))
    result = {
        'groups': len(errors), 'median_shift_m': np.median(shifts_m),
        'p90_shift_m': np.quantile(shifts_m, 0.9), 'median_turn_deg': np.median(turns_deg),
        'p90_turn_deg': np.quantile(turns_deg, 0.9), 'nees': np.mean(squares),
        'median_nees': np.median(squares),
        'in_region': np.mean(np.array(squares) <= chi2.ppf(0.95, 6))}
    print('\npose estimated from {} positions, {groups} times: median error {median_shift_m:.3f} '
          'm and {median_turn_deg:.2f} deg, 90 % below {p90_shift_m:.3f} m and '
          '{p90_turn_deg:.2f} deg; {in_region:.3f} in the 95 % region; normalised error '
          '{nees:.1f} on average, median {median_nees:.1f}, expected 6 and 5.3'.format(
              GROUP, **result), flush=True)
    return result


if __name__ == '__main__':
    frame.run(main)
