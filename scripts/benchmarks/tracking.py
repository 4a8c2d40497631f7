"""Accuracy and time of tracks of users that walk.

Problem: users walk at 1 m/s in straight lines between random positions of the region of interest,
and are located ten times a second, for six seconds. Their multipath is correlated between cycles
by Eq. (4), as in the channel node. How large are the errors of the track and of estimates from
single cycles? Are the covariances consistent with these errors? How much time does the track take
in addition to the estimate of a cycle?

Cycles within the first two seconds are not counted. The 95 % intervals are from resampling the
walks, because the cycles of a walk are not independent. The 95 % region of an estimate is the
ellipsoid of its covariance that contains 95 % of a Gaussian.
"""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from parts import frame

from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.mobility import RandomWalk
from rhs_isac_ros.model.multipath import complex_normal, square_root, time_correlation
from rhs_isac_ros.positioning import BayesEstimator, Estimate, Tracker
from rhs_isac_ros.support.arguments import input_file, positive_int
from rhs_isac_ros.system import System

N_CYCLES, PERIOD_S, SPEED_MPS = 60, 0.1, 1.0
# Time after which the cycles of a walk count [s].
WARM_UP_S = 2.0
TIMES_S = PERIOD_S * np.arange(N_CYCLES)
COUNTED = TIMES_S >= WARM_UP_S
# Number of walks of a job.
BLOCK = 25
# Locates one user, by the time and the signals of each cycle.
Method = Callable[[float, np.ndarray], Estimate]


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('tracking', __doc__, has_jobs=True)
    add = parser.add_argument
    add('--config', type=input_file, help='YAML file of the scenario (default: Table I)')
    add('--codebook', type=input_file, default=default_codebook_file(), help='codebook file')
    add('--walks', type=positive_int, default=200, help='number of walks')
    options = parser.parse_args()
    codebook = Codebook.load(options.codebook, frame.scenario_of(options.config))
    found = frame.measured(options, 'tracking', measure, {
        f'walks from {first}': {
            'config': options.config and str(options.config), 'codebook': str(options.codebook),
            'n_walks': options.walks, 'first': first, 'seed': options.seed}
        for first in range(0, options.walks, BLOCK)})
    print(f'{options.walks} walks, codebook {codebook.id}, seed {options.seed}\n')
    table = frame.Table(['method'], {
        'rms error [m]': ('rms_m', 3), 'median [m]': ('median_m', 3),
        'in the 95 % region [%]': ('covered', 1), 'normalised error': ('nees', 2),
        'CPU time of a cycle [ms]': ('time_ms', 1)})
    # The intervals resample the walks.
    walks = np.repeat(np.arange(options.walks), np.count_nonzero(COUNTED))
    figures, times_s = {}, {}
    for name in next(iter(found.values())):
        *errors, times_s[name] = (
            np.concatenate(parts) for parts in zip(*(one[name] for one in found.values()),
                                                   strict=True))
        fixes = frame.Fixes(*errors)
        walk = walks[fixes.fix]
        figures[name] = table.row(name, **fixes.figures(walk) | {
            'covered': frame.mean_interval(100.0 * fixes.inside, walk),
            'time_ms': 1e3 * np.median(times_s[name])})
    extra_s = np.median(times_s['track'] - times_s['single cycles'])
    print(f'\nCPU time of the track beyond that of single cycles: {1e3 * extra_s:.2f} ms')
    frame.write_results(options.json, figures)


def simulate_walks(scenario: Scenario, codebook: Codebook, n_walks: int, times_s: np.ndarray,
                   seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Simulate walks of C cycles at equidistant times between random positions of the region.

    As in the channel node, the multipath of a cycle is rho times that of the previous cycle plus
    a new draw, with rho of Eq. (4) for the period. The thermal noise is independent. Returns
    positions, float64 [W, C, 3] [m], and signals, complex128 [W, C, N_B, N_SB F].
    """
    model, rng = MeasurementModel(scenario, codebook), np.random.default_rng(seed)
    positions = np.empty((n_walks, len(times_s), 3))
    for path in positions:
        walk = RandomWalk(scenario, SPEED_MPS, rng)
        path[:] = [walk.state(time_s)[0] for time_s in times_s]
    signals = model.mean(positions.reshape(-1, 3)).reshape(*positions.shape[:2], *model.shape)
    noise_w, n_rows = scenario.noise_power_w, model.shape[1]
    correlation = time_correlation(scenario, times_s[1])
    for band, (covariance, rho) in enumerate(zip(model.covariance(), correlation, strict=True)):
        root = square_root(covariance - noise_w * np.eye(n_rows))
        drawn = complex_normal((*positions.shape[:2], root.shape[1]), rng)
        for cycle in range(1, len(times_s)):
            drawn[:, cycle] = (
                rho * drawn[:, cycle - 1] + np.sqrt(1 - rho**2) * drawn[:, cycle])
        signals[:, :, band] += drawn @ root.T
        signals[:, :, band] += np.sqrt(noise_w) * complex_normal(
            (*positions.shape[:2], n_rows), rng)
    return positions, signals


def measure(config: str | None, codebook: str, n_walks: int, first: int, seed: int
            ) -> Mapping[str, Any]:
    """Run every method over a block of walks, one after the other, so that times compare.

    Returns the fixes of the cycles that count by method, and the CPU times [s] of all cycles.
    """
    scenario = frame.scenario_of(config)
    book = Codebook.load(codebook, scenario)
    # The random numbers are those of all walks.
    positions, signals = (one[first:first + BLOCK] for one in simulate_walks(
        scenario, book, n_walks, TIMES_S, seed))
    estimator = BayesEstimator(System(scenario, book))
    methods: dict[str, Callable[[], Method]] = {
        'single cycles': lambda: lambda _, received: estimator.estimate(received),
        'track': lambda: Tracker(estimator).update}
    estimates: dict[str, list[Estimate]] = {name: [] for name in methods}
    times_s: dict[str, list[float]] = {name: [] for name in methods}
    for of_walk in signals:
        for name, make in methods.items():
            update = make()
            for time_s, received in zip(TIMES_S, of_walk, strict=True):
                begin = time.process_time()
                estimates[name].append(update(time_s, received))
                times_s[name].append(time.process_time() - begin)
    counted = np.tile(COUNTED, len(signals))
    places = positions[:, COUNTED].reshape(-1, 3)
    return {name: [*frame.Fixes.of(Estimate.of_each(
        [one for one, counts in zip(found, counted, strict=True) if counts]), places),
        times_s[name]] for name, found in estimates.items()}


if __name__ == '__main__':
    frame.run(main)
