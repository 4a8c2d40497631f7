"""Accuracy and time of an estimator.

Problem: a user stands somewhere in the region of interest, uniformly at random; the base station
takes the signals of a positioning phase with a codebook, by Eq. (8). How far off is the estimate,
does its covariance tell so, how long does it take, and how near does it come to the mean of the
posterior, which no estimator can beat on average?

The 95 % region of an estimate is the ellipsoid of its covariance that would hold 95 % of a
Gaussian. The posterior is weighed at 2^N points with --reference N; 22 takes some five minutes.
"""

import os

# One thread, as in the positioner node. This must come before NumPy is loaded.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri
from tqdm import tqdm

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import (
    ESTIMATORS,
    Estimate,
    exhaustive_posterior,
    make_estimator,
    simulate_pairs,
)

DEFAULT_CODEBOOK = Path(__file__).parents[2] / 'config' / 'codebook.yaml'
# Square radius of the 95 % region, in units of the covariance.
REGION = float(chdtri(3, 0.05))


def main() -> None:
    """Simulate, estimate, and print the figures."""
    options = parsed()
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
    print(f'estimator {options.estimator}, codebook {codebook.id}, {options.positions} positions, '
          f'seed {options.seed}')
    print_accuracy(estimates, positions)
    print(f'average CRLB         {crlb(scenario, codebook, positions).mean():.4f} m^2')
    if options.reference:
        print_ratio(exhausted(scenario, codebook, received, options.reference), estimates,
                    positions)
    print(f'time of a fix        {1e3 * np.median(times_s):.1f} ms median, '
          f'{1e3 * np.quantile(times_s, 0.99):.1f} ms 99th percentile, '
          f'{1e3 * np.median(busy_s):.1f} ms of a processor')
    print(f'time to get ready    {ready_s:.1f} s, tables built')
    print_loading(settings)


def parsed() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__.partition('\n')[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = parser.add_argument
    add('--estimator', choices=sorted(ESTIMATORS), default='bayes')
    add('--model', type=Path, help='trained model, for neural')
    add('--codebook', type=Path, default=DEFAULT_CODEBOOK)
    add('--scenario', type=Path)
    add('--positions', type=int, default=1000)
    add('--seed', type=int, default=1)
    add('--reference', type=int, default=0, metavar='N',
        help='compare with the posterior at 2^N points; 0: do not')
    add('--table-folder', type=Path, help=argparse.SUPPRESS)
    add('--only-load', action='store_true', help=argparse.SUPPRESS)
    return parser.parse_args()


def print_accuracy(estimates: list[Estimate], positions: np.ndarray) -> None:
    """Print squared errors, and what the covariances say of them."""
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
    print(f'normalised error     {np.mean(normalised):.2f} (3 if the covariances are right)')
    print(f'95 % regions         hold {100 * np.mean(np.array(normalised) <= REGION):.1f} %')
    print(f'no fix               {np.sum(~fix)}')


def exhausted(scenario: Scenario, codebook: Codebook, received: np.ndarray,
              log2_points: int) -> Estimate:
    """Weigh the posterior everywhere, with a progress bar."""
    with tqdm(total=1.0, bar_format='{percentage:3.0f} % |{bar}| {remaining} left',
              leave=False, disable=None) as bar:
        return exhaustive_posterior(
            scenario, codebook, received, log2_points, lambda share: bar.update(share - bar.n))


def print_ratio(reference: Estimate, estimates: list[Estimate], positions: np.ndarray) -> None:
    """Print the mean squared error as a multiple of the posterior mean's, with its own error."""
    fix = np.array([bool(estimate.fix) for estimate in estimates])
    means = np.array([estimate.mean for estimate in estimates])
    own = np.sum((means - positions)**2, axis=1)[fix]
    best = np.sum((reference.mean - positions)**2, axis=1)[fix]
    ratio = own.mean() / best.mean()
    spread = np.std(own - ratio * best) / np.sqrt(len(own)) / best.mean()
    print(f'posterior mean       {best.mean():.3f} m^2 exhaustively')
    print(f'ratio to it          {ratio:.4f} (standard error {spread:.4f})')


def print_loading(settings: dict[str, Any]) -> None:
    """Print time and memory of processes that only load the estimator."""
    arguments = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        extra = ['--only-load'] if settings.get('model_file') else [
            '--only-load', '--table-folder', folder]
        for what in ('builds its tables', 'finds its tables'):
            begin = time.perf_counter()
            done = subprocess.run(
                [sys.executable, __file__, *arguments, *extra], check=True,
                stdout=subprocess.PIPE, text=True)
            print(f'a process that {what}: {time.perf_counter() - begin:.1f} s, '
                  f'{float(done.stdout):.0f} MiB at most')


if __name__ == '__main__':
    main()
