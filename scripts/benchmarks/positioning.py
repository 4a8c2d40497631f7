"""Accuracy and time of an estimator.

Problem: a user is at a uniformly random position in the region of interest. The base station
receives the signals of a positioning phase with a codebook, by Eq. (8). How large is the error of
the estimate, is its covariance consistent with the error, how long does the estimate take, and how
close is it to the posterior mean, which no estimator outperforms on average?

The 95 % region of an estimate is the ellipsoid of its covariance that contains 95 % of a
Gaussian. With --reference N, the posterior is evaluated at 2^N points; N = 22 takes about five
minutes.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from parts.exhaustive_posterior import exhaustive_posterior
from scipy.special import chdtri

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.positioning import (
    ESTIMATORS,
    Estimate,
    ModelError,
    make_estimator,
    simulate_pairs,
)
from rhs_isac_ros.support.arguments import ArgumentParser, input_file, integer, positive_int, seed
from rhs_isac_ros.support.optional import optional_import

DEFAULT_CODEBOOK = Path(__file__).parents[2] / 'config' / 'codebook.yaml'
# Squared Mahalanobis radius of the 95 % region.
REGION_RADIUS = float(chdtri(3, 0.05))


def main() -> None:
    """Run the benchmark."""
    options = parse_options()
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    codebook = Codebook.load(options.codebook)
    settings: dict[str, Any] = {}
    if options.model:
        settings['model_file'] = options.model
    if options.table_folder:
        settings['table_folder'] = options.table_folder
    begin = time.perf_counter()
    estimator = make_estimator(options.estimator, scenario, codebook, **settings)
    ready_s = time.perf_counter() - begin
    if options.only_load:
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        return
    positions, received = simulate_pairs(scenario, codebook, options.positions, options.seed)
    times_s, busy_s, estimates = [], [], []
    for signals in received:
        begin, busy = time.perf_counter(), time.process_time()
        estimates.append(estimator.estimate(signals))
        times_s.append(time.perf_counter() - begin)
        busy_s.append(time.process_time() - busy)
    begin, busy = time.perf_counter(), time.process_time()
    together = estimator.estimate(received)
    batch_s = np.array([time.perf_counter() - begin, time.process_time() - busy])
    deviation = np.nanmax(np.abs(together.mean - [one.mean for one in estimates]), initial=0.0)
    print(f'estimator {options.estimator}, codebook {codebook.id}, {options.positions} positions, '
          f'seed {options.seed}')
    print_accuracy(estimates, positions)
    print(f'average CRLB         {crlb(scenario, codebook, positions).mean():.4f} m^2')
    if options.reference:
        print_ratio(
            exhaustive_reference(scenario, codebook, received, options.reference), estimates,
            positions)
    print(f'time of a fix        {1e3 * np.median(times_s):.1f} ms median, '
          f'{1e3 * np.quantile(times_s, 0.99):.1f} ms 99th percentile, '
          f'{1e3 * np.median(busy_s):.1f} ms CPU time')
    ratio = np.array([np.sum(times_s), np.sum(busy_s)]) / batch_s
    wall_ms, busy_ms = 1e3 * batch_s / len(received)
    print(f'all in one call      {wall_ms:.2f} ms, {busy_ms:.2f} ms CPU time for each fix')
    print(f'rate of one call     {ratio[0]:.1f} times that of single fixes, {ratio[1]:.1f} times '
          f'by CPU time; positions differ by up to {deviation:.0e} m')
    print(f'time to create       {ready_s:.1f} s, including its tables')
    print_loading(settings)


def parse_options() -> argparse.Namespace:
    """Parse the command line."""
    parser = ArgumentParser(
        prog='scripts/benchmark positioning', description=__doc__.partition('\n')[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = parser.add_argument
    add('--estimator', choices=sorted(ESTIMATORS), default='bayes', help='estimator')
    add('--model', type=input_file, help='trained model of the estimator neural')
    add('--codebook', type=input_file, default=DEFAULT_CODEBOOK, help='codebook file')
    add('--scenario', type=input_file, help='YAML file of the scenario')
    add('--positions', type=positive_int, default=1000, help='number of positions')
    add('--seed', type=seed, default=1, help='seed of all random numbers')
    add('--reference', type=integer(0, 24), default=0, metavar='N',
        help='compare with the posterior mean over 2^N points; 0 to omit')
    add('--table-folder', type=Path, help=argparse.SUPPRESS)
    add('--only-load', action='store_true', help=argparse.SUPPRESS)
    return parser.parse_args()


def print_accuracy(estimates: list[Estimate], positions: np.ndarray) -> None:
    """Print squared errors and their consistency with the covariances."""
    fix = np.array([bool(estimate.fix) for estimate in estimates])
    errors, normalised = [], []
    for estimate, position in zip(estimates, positions, strict=True):
        if estimate.fix:
            error = estimate.mean - position
            errors.append(error @ error)
            normalised.append(error @ np.linalg.solve(estimate.covariance, error))
    spread = np.std(errors) / np.sqrt(len(errors))
    print(f'mean squared error   {np.mean(errors):.3f} m^2 (standard error {spread:.3f})')
    print(f'median squared error {np.median(errors):.3f} m^2')
    print(f'normalised error     {np.mean(normalised):.2f} (3 if the covariances are consistent)')
    contained = np.mean(np.array(normalised) <= REGION_RADIUS)
    print(f'95 % regions         contain {100 * contained:.1f} %')
    print(f'no fix               {np.sum(~fix)}')


def exhaustive_reference(
        scenario: Scenario, codebook: Codebook, received: np.ndarray, log2_points: int
) -> Estimate:
    """Evaluate the posterior over the whole region, with a progress bar."""
    with optional_import('--reference', extra='experiments'):
        from tqdm import tqdm

    with tqdm(total=1.0, bar_format='{percentage:3.0f} % |{bar}| {remaining} left',
              leave=False, disable=None) as bar:
        return exhaustive_posterior(
            scenario, codebook, received, log2_points, lambda share: bar.update(share - bar.n))


def print_ratio(reference: Estimate, estimates: list[Estimate], positions: np.ndarray) -> None:
    """Print the ratio of the mean squared error to that of the posterior mean."""
    fix = np.array([bool(estimate.fix) for estimate in estimates])
    means = np.array([estimate.mean for estimate in estimates])
    own = np.sum((means - positions)**2, axis=1)[fix]
    best = np.sum((reference.mean - positions)**2, axis=1)[fix]
    ratio = own.mean() / best.mean()
    spread = np.std(own - ratio * best) / np.sqrt(len(own)) / best.mean()
    print(f'posterior mean       {best.mean():.3f} m^2, evaluated exhaustively')
    print(f'ratio to it          {ratio:.4f} (standard error {spread:.4f})')


def print_loading(settings: dict[str, Any]) -> None:
    """Print time and peak memory of processes that only create the estimator."""
    arguments = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        extra = ['--only-load'] if settings.get('model_file') else [
            '--only-load', '--table-folder', folder]
        for what in ('builds its tables', 'loads its tables'):
            begin = time.perf_counter()
            done = subprocess.run(
                [sys.executable, __file__, *arguments, *extra], check=True,
                stdout=subprocess.PIPE, text=True)
            print(f'a process that {what}: {time.perf_counter() - begin:.1f} s, '
                  f'{float(done.stdout):.0f} MiB peak memory')


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (CodebookError, ModelError, ScenarioError)))
