"""Accuracy and time of an estimator.

Problem: a user stands somewhere in the region of interest, uniformly at random; the base station
takes the signals of a positioning phase with a codebook, by Eq. (8). How far off is the estimate,
does its covariance tell so, and how long does it take?
"""

import os

# One thread, as in the positioner node. This must come before NumPy is loaded.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import time
from pathlib import Path

import numpy as np

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import ESTIMATORS, make_estimator

DEFAULT_CODEBOOK = Path(__file__).parents[2] / 'config' / 'codebook.yaml'


def main() -> None:
    """Simulate, estimate, and print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--estimator', choices=sorted(ESTIMATORS), default='bayes')
    parser.add_argument('--codebook', type=Path, default=DEFAULT_CODEBOOK)
    parser.add_argument('--scenario', type=Path)
    parser.add_argument('--positions', type=int, default=500)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    codebook = Codebook.load(options.codebook)
    rng = np.random.default_rng(options.seed)
    positions = scenario.sample_positions(options.positions, rng)
    received = simulate_received(scenario, codebook, positions, rng)

    begin = time.perf_counter()
    estimator = make_estimator(options.estimator, scenario, codebook)
    table_s = time.perf_counter() - begin
    times_s, errors, normalised = [], [], []
    for signals, position in zip(received, positions, strict=True):
        begin = time.perf_counter()
        estimate = estimator.estimate(signals)
        times_s.append(time.perf_counter() - begin)
        error = estimate.mean - position
        errors.append(error @ error)
        normalised.append(error @ np.linalg.solve(estimate.covariance, error))
    spread = np.std(errors) / np.sqrt(len(errors))
    print(f'codebook {codebook.id}, {options.positions} positions, seed {options.seed}')
    print(f'mean squared error   {np.mean(errors):.3f} m^2 (standard error {spread:.3f})')
    print(f'median squared error {np.median(errors):.3f} m^2')
    print(f'average CRLB         {crlb(scenario, codebook, positions).mean():.4f} m^2')
    print(f'normalised error     {np.mean(normalised):.2f} (3 if the covariances are right)')
    print(f'time of a fix        {1e3 * np.median(times_s):.1f} ms median, '
          f'{1e3 * np.quantile(times_s, 0.99):.1f} ms 99th percentile')
    print(f'time of the tables   {table_s:.1f} s')


if __name__ == '__main__':
    main()
