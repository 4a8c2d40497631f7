"""Accuracy and time of tracks of users that walk.

Problem: users walk in straight lines between random positions of the region of interest, or stand
still with --speed 0, and are located at a constant rate. Their multipath is correlated between
cycles by Eq. (4), as in the channel node. How large are the errors of the track and of estimates
from single cycles? Are the covariances consistent with these errors? How much time does the track
take in addition to the estimate of a cycle?

Cycles within the first two seconds are not counted. The 95 % intervals are from resampling the
walks, because the cycles of a walk are not independent. The 95 % region of an estimate is the
ellipsoid of its covariance that contains 95 % of a Gaussian.
"""

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from parts import frame
from parts.walks import Walks, simulate_walks

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.positioning import BayesEstimator, Estimate, Motion, Tracker
from rhs_isac_ros.support.arguments import input_file, positive_float, positive_int

# Time after which the cycles of a walk count [s].
WARM_UP_S = 2.0


class Method(Protocol):
    """A method that locates one user."""

    def update(self, time_s: float, signals: np.ndarray) -> Estimate:
        """Estimate the position after the signals of a cycle."""
        ...


class Single(NamedTuple):
    """Estimates of single cycles."""

    estimator: BayesEstimator

    def update(self, time_s: float, signals: np.ndarray) -> Estimate:
        """Estimate the position from the signals of this cycle alone."""
        return self.estimator.estimate(signals)


def main() -> None:
    """Run the benchmark."""
    options = parse_options()
    scenario, codebook = frame.scenario_of(options.config), Codebook.load(options.codebook)
    codebook.check(scenario)
    walks = simulate_walks(
        scenario, codebook, options.walks, round(options.duration * options.rate),
        1 / options.rate, options.speed, options.seed)
    estimator = BayesEstimator(scenario, codebook)
    motion = Motion(options.assumed_speed)
    methods: dict[str, Callable[[], Method]] = {
        'single cycles': lambda: Single(estimator),
        'track': lambda: Tracker(estimator, motion)}
    print(f'{options.walks} walks of {options.duration:g} s at {options.speed:g} m/s, '
          f'{options.rate:g} cycles a second, codebook {codebook.id}, seed {options.seed}\n')
    estimates, times_s = measure(methods, walks)
    table = frame.Table('method', 'rms error [m]', 'median [m]', 'in the 95 % region [%]',
                        'normalised error', 'CPU time of a cycle [ms]')
    counted = np.nonzero(walks.times_s >= WARM_UP_S)[0]
    positions = walks.positions[:, counted].reshape(-1, 3)
    # The intervals resample the walks.
    walk = np.repeat(np.arange(options.walks), len(counted))
    figures = {}
    for name, rows in estimates.items():
        estimate = frame.stacked([row[cycle] for row in rows for cycle in counted])
        fixes = frame.Fixes.of(estimate, positions)
        figures[name] = row = {
            'rms_m': [value**0.5 for value in frame.mean_interval(fixes.squared, walk)],
            'median_m': np.median(fixes.squared)**0.5,
            'covered_share': frame.mean_interval(100.0 * fixes.inside, walk),
            'nees': fixes.normalised.mean(), 'time_ms': 1e3 * np.median(times_s[name])}
        table.row(name, *(frame.shown(value, digits) for value, digits in zip(
            row.values(), (3, 3, 1, 2, 1), strict=True)))
    extra_s = np.median(times_s['track'] - times_s['single cycles'])
    print(f'\nCPU time of the track beyond that of single cycles: {1e3 * extra_s:.2f} ms')
    frame.write_results(options.json, figures)


def parse_options() -> argparse.Namespace:
    """Parse the command line."""
    parser = frame.benchmark_parser('tracking', __doc__)
    add = parser.add_argument
    add('--config', type=input_file, help='YAML file of the scenario (default: frame.Table I)')
    add('--codebook', type=input_file, default=frame.CONFIG / 'codebook.yaml',
        help='codebook file')
    add('--walks', type=positive_int, default=200, help='number of walks')
    add('--duration', type=positive_float, default=6.0, metavar='S',
        help='duration of a walk [s]')
    add('--rate', type=positive_float, default=10.0, metavar='HZ',
        help='cycles a second of each user')
    add('--speed', type=float, default=1.0, metavar='MPS',
        help='speed of the users [m/s]')
    add('--assumed-speed', type=positive_float, default=1.0, metavar='MPS',
        help='speed that the track assumes [m/s]')
    options = parser.parse_args()
    if options.speed < 0:
        parser.error(f'argument --speed: {options.speed}, expected 0 or more')
    if options.duration <= WARM_UP_S:
        parser.error(f'argument --duration: {options.duration}, expected more than {WARM_UP_S}')
    return options


def measure(methods: dict[str, Callable[[], Method]], walks: Walks
            ) -> tuple[dict[str, list[list[Estimate]]], dict[str, np.ndarray]]:
    """Run every method over all walks, one after the other on each, so that times compare.

    Returns the estimates of each walk and cycle, and the CPU times, float64 [W, C] [s].
    """
    estimates: dict[str, list[list[Estimate]]] = {name: [] for name in methods}
    times_s = {name: np.empty(walks.positions.shape[:2]) for name in methods}
    for walk, signals in enumerate(walks.signals):
        for name, make in methods.items():
            method, row = make(), []
            for cycle, time_s in enumerate(walks.times_s):
                begin = time.process_time()
                row.append(method.update(time_s, signals[cycle]))
                times_s[name][walk, cycle] = time.process_time() - begin
            estimates[name].append(row)
    return estimates, times_s


if __name__ == '__main__':
    frame.run(main)
