"""Errors of positions and velocities of users who walk while the board steps its patterns.

Problem: a cycle of the lab lasts half a second. How accurate are position and velocity from one
cycle, do their regions contain the truth, and how far is this from the exact posterior? Users walk
in random directions at given speeds. The deviation of velocities that the scenario declares is the
same for all speeds. The exact posterior is that of many samples with the weights of the
likelihood, around all modes of a search that also starts at the truth. The squared distance of the
estimate from it, relative to its squared error, is what the approximations of the estimator cost.

With `--otherwise`, users are faster than declared, or walk although users at rest are declared,
with a multipath as still as config/lab.yaml declares, or one of users who walk. The largest turn
is that of the direct path from the first frame of a band to the last one.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from parts import frame
from scipy.special import chdtri

from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.gaussian import likelihood_loss, marginalise
from rhs_isac_ros.model.geometry import frame_lags_s, to_polar
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.positioning.grid import Starts
from rhs_isac_ros.positioning.lattice import subband_wavenumbers
from rhs_isac_ros.positioning.posterior import log_share
from rhs_isac_ros.positioning.search import ascend, marginal_at
from rhs_isac_ros.positioning.segments import concatenate
from rhs_isac_ros.positioning.sheets import Inside
from rhs_isac_ros.positioning.templates import standard_normal
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import integer
from rhs_isac_ros.system import System

# Systems and speeds [m/s]: users as declared, and those who move otherwise.
SPEEDS_MPS = {'lab_walk_system': (0.0, 0.1, 0.3, 1.0, 2.0)}
OTHERWISE_MPS = {'lab_walk_system': (5.0, 10.0), 'lab_system': (0.0, 0.03, 0.1, 0.3, 1.0),
                 'lab_system, max_user_speed_mps 1.5': (0.0, 0.03, 0.1, 0.3, 1.0)}
# Users that are located at a time; samples of a mode of the exact posterior, and the factor of
# their covariances.
BLOCK, SAMPLES, WIDENING = 50, 1024, 1.3**2


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('walking', __doc__, positions=1000, has_jobs=True)
    parser.add_argument('--exact', type=integer(0, 10**6), default=0, metavar='N',
                        help='users of each speed to compare with the exact posterior')
    parser.add_argument('--otherwise', action='store_true',
                        help='users who move otherwise than declared')
    options = parser.parse_args()
    speeds_mps = OTHERWISE_MPS if options.otherwise else SPEEDS_MPS
    parts = {f'{name}, {speed:g} m/s, {first}': {
        'name': name, 'speed_mps': speed, 'first': first,
        'n': min(BLOCK, options.positions - first),
        'n_exact': min(max(options.exact - first, 0), BLOCK), 'seed': options.seed}
        for name, speeds in speeds_mps.items() for speed in speeds
        for first in range(0, options.positions, BLOCK)}
    found = frame.measured(options, 'walking', errors, parts)
    table = frame.Table(['system', 'speed [m/s]'], {
        'fix [%]': ('fix', 1), 'MSE [m²]': ('mse_m2', 3), 'in the region [%]': ('in_region', 1),
        'NEES / 3': ('nees', 2), 'velocity, rms [m/s]': ('velocity_rms_mps', 2),
        'velocity in its region [%]': ('velocity_in_region', 1),
        'both in theirs [%]': ('both_in_region', 1),
        **({'largest turn with a fix [rad]': ('turn_rad', 2)} if options.otherwise else {
            'MSE / exact': ('mse_ratio', 2), 'distance² / exact': ('distance', 3)})})
    rows: dict[str, dict[str, Any]] = {name: {} for name in speeds_mps}
    for name, speed in ((name, speed) for name, speeds in speeds_mps.items() for speed in speeds):
        blocks = [found[one] for one, part in parts.items()
                  if (part['name'], part['speed_mps']) == (name, speed)]
        rows[name][f'{speed:g}'] = table.row(name, f'{speed:g}', **figures({
            key: np.concatenate([np.asarray(block[key]) for block in blocks])
            for key in blocks[0]}))
    frame.write_results(options.json, rows)


@functools.cache
def lab(name: str) -> tuple[System, BayesEstimator]:
    """Return the system in a file, with a field of its scenario if the name has one."""
    file, _, field = name.partition(', ')
    system = System.from_yaml(frame.CONFIG / f'{file}.yaml')
    if field:
        key, value = field.split()
        system = System(dataclasses.replace(system.scenario, **{key: float(value)}),
                        system.codebook, system.surface)
    return system, BayesEstimator(system)


def errors(name: str, speed_mps: float, first: int, n: int, n_exact: int, seed: int
           ) -> Mapping[str, Any]:
    """Locate users; return turns and squared errors, plain and normalised, of those with a fix.

    Without a declared velocity, those of velocities are empty.
    """
    system, estimator = lab(name)
    rng = streams.generator(seed, streams.PHASES, first, round(1e3 * speed_mps))
    positions = system.scenario.sample_positions(n, rng)
    way = rng.standard_normal((n, 3))
    states = np.hstack([positions, speed_mps * way / np.linalg.norm(way, axis=1, keepdims=True)])
    received = system.sample(states, rng)
    estimate = estimator.estimate(received)
    fix = np.asarray(estimate.fix)
    whole = (np.hstack([estimate.mean, estimate.velocity]) - states)[fix]
    joint = estimate.joint_covariance[fix]
    exact = np.array([exact_mean(estimator, received[k], states[k]) for k in range(n_exact)])
    exact_squared = np.sum((exact.reshape(-1, 3) - positions[:n_exact])**2, axis=1)
    compared = fix[:n_exact]
    moving = slice(None if system.scenario.user_speed_std_mps else 0)
    radial_mps = np.sum(states[:, 3:] * positions, axis=1) / np.linalg.norm(positions, axis=1)
    turns = np.abs(radial_mps) * subband_wavenumbers(system.scenario).max() * frame_lags_s(
        system.scenario)[-1]
    return {
        'fix': fix, 'squared': np.sum(whole[:, :3]**2, axis=1),
        'velocity_squared': np.sum(whole[moving, 3:]**2, axis=1),
        'normalised': normalised(whole[:, :3], joint[:, :3, :3]),
        'velocity_normalised': normalised(whole[moving, 3:], joint[moving, 3:, 3:]),
        'both_normalised': normalised(whole[moving], joint[moving]),
        'exact_squared': exact_squared[compared], 'turns': turns[fix],
        'distance_squared': np.sum(
            (exact.reshape(-1, 3) - estimate.mean[:n_exact])[compared]**2, axis=1),
        'compared': np.sum(whole[:np.count_nonzero(compared), :3]**2, axis=1)}


def normalised(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return squared errors [N, D] relative to covariances [N, D, D]."""
    return np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1)


def exact_mean(estimator: BayesEstimator, received: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Compute the mean position of the posterior, [3] [m], from many weighted samples."""
    likelihood, scope = estimator._likelihood, estimator._region
    prior, n_moving = likelihood.nuisance, likelihood.nuisance.velocity.shape[1]
    signals, to_units = likelihood.signals(received[None]), np.linalg.pinv(prior.velocity).T
    aligned = scope.alignment.values_of_each(signals.received)
    starts, _ = scope.table.search(likelihood.whitened(aligned, signals), prior, 20.0)
    at_truth = aligned.copy()
    at_truth[:, :n_moving] = state[3:] @ to_units
    modes = ascend(likelihood, likelihood, concatenate(
        starts._replace(values=starts.values + aligned),
        Starts(np.zeros(1, int), to_polar(state[None, :3]), at_truth)), signals, 8, 12.0)
    normal = standard_normal(SAMPLES, 6)
    positions, log_weights = Inside.of(
        modes.points, modes.gradient / WIDENING, modes.curvature / WIDENING,
        likelihood.resolution.bounds_m).sample(normal)
    points = to_polar(positions).reshape(-1, 3)
    log_weights += log_share(
        points.reshape(positions.shape), modes, likelihood.rates(modes.values, modes.points))
    centres, values = (np.repeat(one, SAMPLES, axis=0) for one in (modes.points, modes.values))
    values = prior.carried(values, centres, points)
    for _ in range(2):
        _, values, information = marginal_at(likelihood, likelihood, points, values, signals)
    among = marginalise(information, np.zeros(values.shape), n_moving).information / WIDENING
    offset = np.matmul(np.linalg.cholesky(np.linalg.inv(among)),
                       np.tile(normal[:, 3:3 + n_moving], (len(modes.shots), 1))[..., None])
    values[:, :n_moving] += offset[..., 0]
    located = likelihood.at(points, values, moves=False, turns=False)
    values = located.settled(values, signals)
    for _ in range(3):
        local = located.local(values, signals)
        rest = marginalise(local.information[:, n_moving:, n_moving:],
                           local.gradient[:, n_moving:], 0)
        values[:, n_moving:] += rest.offset
    rise = np.sum(local.gradient[:, n_moving:] * rest.offset, axis=1) / 2
    # Minus the logarithm of the density of the velocities that were drawn.
    log_weights += (local.value + rise + rest.log_volume - np.linalg.slogdet(among)[1] / 2
                    + likelihood_loss(offset[..., 0], among)).reshape(log_weights.shape)
    weights, _ = mixture_weights(log_weights.ravel())
    return weights @ positions.reshape(-1, 3)


def figures(values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the figures of one speed from the results of `errors`; shares are in percent."""
    n, limits = len(values['squared']), {3: chdtri(3, 0.05), 6: chdtri(6, 0.05)}
    root = frame.mean_interval(values['velocity_squared'])
    return {
        'fix': share_percent(n, len(values['fix'])),
        'mse_m2': frame.mean_interval(values['squared']),
        'nees': frame.mean_interval(values['normalised'] / 3),
        'velocity_rms_mps': root and tuple(one**0.5 for one in root),
        **{f'{name}in_region': share_percent(int(np.sum(inside)), len(inside))
           if len(inside) else None for name, inside in (
               (name, values[f'{name}normalised'] <= limits[size])
               for name, size in (('', 3), ('velocity_', 3), ('both_', 6)))},
        'mse_ratio': frame.mean_interval(
            values['compared'], relative_to=values['exact_squared']),
        'distance': frame.mean_interval(
            values['distance_squared'], relative_to=values['exact_squared']),
        'turn_rad': max(values['turns'], default=None)}


if __name__ == '__main__':
    frame.run(main)
