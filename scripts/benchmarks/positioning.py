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
from parts import frame
from parts.exhaustive_posterior import exhaustive_posterior

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.positioning import ESTIMATORS, Estimate, make_estimator, simulate_pairs
from rhs_isac_ros.support.arguments import input_file, integer


def main() -> None:
    """Run the benchmark."""
    options = parse_options()
    scenario, codebook = frame.scenario_of(options.scenario), Codebook.load(options.codebook)
    settings: dict[str, Any] = {
        name: value for name in ('model_file', 'table_folder')
        if (value := getattr(options, name))}
    begin = time.perf_counter()
    estimator = make_estimator(options.estimator, scenario, codebook, **settings)
    ready_s = time.perf_counter() - begin
    if options.only_load:
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        return
    positions, received = simulate_pairs(scenario, codebook, options.positions, options.seed)
    estimate, times_s = frame.estimate_singly(estimator, received)
    begin, busy = time.perf_counter(), time.process_time()
    together = estimator.estimate(received)
    batch_s = np.array([time.perf_counter() - begin, time.process_time() - busy])
    deviation = np.nanmax(np.abs(together.mean - estimate.mean), initial=0.0)
    print(f'estimator {options.estimator}, codebook {codebook.id}, {options.positions} positions, '
          f'seed {options.seed}')
    figures = accuracy(frame.Fixes.of(estimate, positions))
    figures['average_crlb_m2'] = crlb(scenario, codebook, positions).mean()
    print(f'average CRLB         {figures["average_crlb_m2"]:.4f} m^2')
    if options.reference:
        reference = exhaustive_posterior(scenario, codebook, received, options.reference)
        figures |= ratio(reference, estimate, positions)
    wall_ms, busy_ms = 1e3 * np.median(times_s, axis=0)
    print(f'time of a fix        {wall_ms:.1f} ms median, '
          f'{1e3 * np.quantile(times_s[:, 0], 0.99):.1f} ms 99th percentile, '
          f'{busy_ms:.1f} ms CPU time')
    rates, each_ms = times_s.sum(axis=0) / batch_s, 1e3 * batch_s / len(received)
    print(f'all in one call      {each_ms[0]:.2f} ms, {each_ms[1]:.2f} ms CPU time for each fix')
    print(f'rate of one call     {rates[0]:.1f} times that of single fixes, {rates[1]:.1f} times '
          f'by CPU time; positions differ by up to {deviation:.0e} m')
    print(f'time to create       {ready_s:.1f} s, including its tables')
    print_loading(settings)
    frame.write_results(options.json, figures | {
        'fix_ms': wall_ms, 'fix_cpu_ms': busy_ms, 'rate_of_one_call': rates.tolist()})


def parse_options() -> argparse.Namespace:
    """Parse the command line."""
    parser = frame.benchmark_parser('positioning', __doc__, 1000)
    add = parser.add_argument
    add('--estimator', choices=sorted(ESTIMATORS), default='bayes', help='estimator')
    add('--model', type=input_file, dest='model_file', metavar='FILE',
        help='trained model of the estimator neural')
    add('--codebook', type=input_file, default=frame.CONFIG / 'codebook.yaml',
        help='codebook file')
    add('--scenario', type=input_file, help='YAML file of the scenario')
    add('--reference', type=integer(0, 24), default=0, metavar='N',
        help='compare with the posterior mean over 2^N points; 0 to omit')
    add('--table-folder', type=Path, help=argparse.SUPPRESS)
    add('--only-load', action='store_true', help=argparse.SUPPRESS)
    return parser.parse_args()


def accuracy(fixes: frame.Fixes) -> dict[str, Any]:
    """Print and return squared errors and their consistency with the covariances."""
    squares = fixes.squared
    figures = {'mse_m2': squares.mean(), 'standard_error_m2': squares.std() / len(squares)**0.5,
               'median_m2': np.median(squares), 'nees': fixes.normalised.mean(),
               'in_region': 100 * fixes.inside.mean(), 'no_fix': int(np.sum(~fixes.fix))}
    print('mean squared error   {mse_m2:.3f} m^2 (standard error {standard_error_m2:.3f})\n'
          'median squared error {median_m2:.3f} m^2\n'
          'normalised error     {nees:.2f} (3 if the covariances are consistent)\n'
          '95 % regions         contain {in_region:.1f} %\n'
          'no fix               {no_fix}'.format(**figures))
    return figures


def ratio(reference: Estimate, estimate: Estimate, positions: np.ndarray) -> dict[str, float]:
    """Print and return the ratio of the mean squared error to that of the posterior mean."""
    own, best = (np.sum((one.mean - positions)[estimate.fix]**2, axis=1)
                 for one in (estimate, reference))
    value = own.mean() / best.mean()
    spread = np.std(own - value * best) / np.sqrt(len(own)) / best.mean()
    print(f'posterior mean       {best.mean():.3f} m^2, evaluated exhaustively')
    print(f'ratio to it          {value:.4f} (standard error {spread:.4f})')
    return {'mse_to_reference': value, 'mse_to_reference_standard_error': spread}


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
    frame.run(main)
