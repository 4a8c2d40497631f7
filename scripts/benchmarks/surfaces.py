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
from typing import NamedTuple

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
# Number of random windows, and of positions for each wrong pose.
WINDOWS, WRONG_POSITIONS = 400, 500


class World(NamedTuple):
    """One plan, its positions, and the estimator of a surface."""

    scenario: Scenario
    model: MeasurementModel
    estimator: BayesEstimator
    positions: np.ndarray  # Float64 [N, 3] [m], in the frame of the site.

    def posteriors(self, poses: list[Pose], rng: np.random.Generator) -> list[Estimate]:
        """Return the posteriors of one surface, which has another pose for each position."""
        places = np.array([pose.to_surface(place) for pose, place in zip(
            poses, self.positions, strict=True)])
        return [self.estimator.posterior(signals)
                for signals in self.model.sample(places, rng)]


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('surfaces', __doc__, positions=3000)
    add = parser.add_argument
    add('--plan', choices=frame.SYSTEMS, action='append', help='leave out other plans')
    add('--case', choices=CASES, action='append', help='leave out other cases')
    options = parser.parse_args()
    results = {}
    for name in options.plan or frame.SYSTEMS:
        print(f'\n{name}: {options.positions} positions, seed {options.seed}\n')
        results[name] = measure(*frame.system(name), options)
    frame.write_results(options.json, results)


def measure(scenario: Scenario, codebook: Codebook, options: argparse.Namespace) -> dict:
    """Measure all cases with one plan."""
    table = frame.Table(['surfaces'], {
        'mean squared error [m^2]': ('mse_m2', 4), 'median error [m]': ('median_m', 3),
        'in the 95 % region [%]': ('covered', 1), 'NEES': ('nees', 2),
        'average CRLB [m^2]': ('crlb_m2', 4), 'fusion [ms]': ('time_ms', 1)})
    # The random numbers of a case do not depend on the other cases.
    draw, *of_surface, pose_errors, windows, half_frames, starts = map(
        np.random.default_rng, np.random.SeedSequence(options.seed).spawn(5 + len(POSES)))
    positions = scenario.sample_positions(options.positions, draw)
    n, pair = len(positions), [POSES[name] for name in SITES['front_side']]
    cases, results = options.case or CASES, {}
    world = make_world(scenario, codebook, positions)
    needed = {name for case in cases for name in SITES.get(case, POSES)
              if case in (*SITES, 'wrong_pose', 'estimated_pose')}
    found = {name: world.posteriors([POSES[name]] * n, rng)
             for name, rng in zip(POSES, of_surface, strict=True) if name in needed}
    for case, names in SITES.items():
        if case not in cases:
            continue
        results[case] = table.row(case, **compare(
            world, [found[name] for name in names], [POSES[name] for name in names]))
    if 'front_side_pose' in cases:
        poses = [dataclasses.replace(pose, uncertainty=DECLARED) for pose in pair]
        displaced = [world.posteriors([pose.displaced(pose_errors.multivariate_normal(
            np.zeros(6), pose.covariance)) for _ in range(n)], pose_errors) for pose in poses]
        results['front_side_pose'] = table.row(
            'front_side_pose', **compare(world, displaced, poses))
    if 'half_frames' in cases:
        half = dataclasses.replace(scenario, n_frames=scenario.n_frames // 2)
        half_world = make_world(half, optimize(half, objective='error').codebook, positions)
        shared = [half_world.posteriors([pose] * n, half_frames) for pose in pair]
        results['half_frames'] = table.row('half_frames', **compare(half_world, shared, pair))
    if 'wrong_pose' in cases:
        results['wrong_pose'] = wrong_poses(found, scenario, windows)
    if 'estimated_pose' in cases:
        results['estimated_pose'] = estimated_poses(found, scenario, starts)
    return results


def make_world(scenario: Scenario, codebook: Codebook, positions: np.ndarray) -> World:
    """Return the model and the estimator of a surface."""
    return World(scenario, MeasurementModel(scenario, codebook),
                 BayesEstimator(System(scenario, codebook)), positions)


def sightings_of(found: list[list[Estimate]], poses: list[Pose], position: int
                 ) -> list[Sighting]:
    """Return the sightings of the surfaces with a position."""
    both = (Sighting.of(posteriors[position], pose)
            for posteriors, pose in zip(found, poses, strict=True))
    return [one for one in both if one is not None]


def compare(world: World, found: list[list[Estimate]], poses: list[Pose]) -> dict:
    """Fuse the posteriors of all positions, and return the figures."""
    n = len(world.positions)
    means, covariances, times_s = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n)
    for number in range(n):
        sightings = sightings_of(found, poses, number)
        begin = time.process_time()
        fused = fuse(sightings, world.scenario.roi_bounds_m)
        means[number], covariances[number] = fused.mean, fused.covariance
        times_s[number] = time.process_time() - begin
    fixes = frame.Fixes.of(Estimate(means, covariances), world.positions)
    mse = fixes.squared.mean()
    margin = 1.96 * fixes.squared.std() / np.sqrt(n)
    surfaces = [MeasurementModel(dataclasses.replace(world.scenario, pose=pose), world.model.beams)
                for pose in poses]
    return {**fixes.figures(), 'mse_m2': [mse, mse - margin, mse + margin],
            'crlb_m2': site_crlb(surfaces, world.positions).mean(),
            'time_ms': 1e3 * np.median(times_s)}


def wrong_poses(found: dict[str, list[Estimate]], scenario: Scenario,
                rng: np.random.Generator) -> dict:
    """Measure how often wrong poses of the side surface are noticed, and named, in a window."""
    n = min(WRONG_POSITIONS, len(found['front']) // 2)
    poses = {name: dataclasses.replace(pose, uncertainty=DECLARED)
             for name, pose in POSES.items()}

    def cycles(error: tuple[float, ...], numbers: range) -> list[dict]:
        declared = poses | {'side': poses['side'].displaced(error)}
        return [pair_agreements({
            name: one for name in declared
            if (one := Sighting.of(found[name][number], declared[name]))},
            Fuser(scenario.roi_bounds_m)) for number in numbers]
    right = cycles((0.0,) * 6, range(2 * n))
    # The references are for other positions than those of the windows.
    references = right[n:]
    of_pair = [{PAIR: cycle[PAIR]} for cycle in references if PAIR in cycle]
    print()
    table = frame.Table(['error of the pose'], {
        f'noticed by two surfaces in {WINDOW} cycles': ('noticed', 3),
        'named by three': ('named', 3)})
    results = {}
    for name, error in {'none': (0.0,) * 6, **WRONG}.items():
        pool = right[:n] if name == 'none' else cycles(error, range(n))
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


def estimated_poses(found: dict[str, list[Estimate]], scenario: Scenario,
                    rng: np.random.Generator) -> dict:
    """Estimate the pose of the side surface from groups of positions; measure the errors."""
    truth, errors, squares = POSES['side'], [], []
    for begin in range(0, len(found['side']) - GROUP + 1, GROUP):
        poses = {'front': POSES['front'], 'side': truth.displaced(START * rng.normal(size=6))}
        both = [pair for number in range(begin, begin + GROUP) if len(pair := sightings_of(
            [found[name] for name in PAIR], list(poses.values()), number)) == len(PAIR)]
        pose = estimate_pose(*zip(*both, strict=True), scenario.roi_bounds_m)
        errors.append(pose.error_of(truth))
        squares.append(errors[-1] @ np.linalg.solve(pose.covariance, errors[-1]))
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
