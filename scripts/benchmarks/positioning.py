"""Accuracy and time of the estimator `bayes`.

Problem: a user is at a uniformly random position in the region of interest. The base station
receives the signals of a positioning phase with a codebook, by Eq. (8). How large is the error of
the estimate, is its covariance consistent with the error, how long does the estimate take, and how
close is it to the posterior mean, which no estimator outperforms on average?

The 95 % region of an estimate is the ellipsoid of its covariance that contains 95 % of a
Gaussian. With --reference N, the posterior is evaluated at 2^N points; N = 22 takes about five
minutes.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from parts import frame
from parts.exhaustive_posterior import exhaustive_posterior

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Estimate, make_estimator
from rhs_isac_ros.support.arguments import integer
from rhs_isac_ros.system import System


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('positioning', __doc__, 1000)
    parser.add_argument('--reference', type=integer(0, 24), default=0, metavar='N',
                        help='compare with the posterior mean over 2^N points; 0 to omit')
    options = parser.parse_args()
    scenario, codebook = Scenario(), Codebook.default()
    begin = time.perf_counter()
    estimator = make_estimator('bayes', scenario, codebook)
    ready_s = time.perf_counter() - begin
    positions, received = System(scenario, codebook).pairs(options.positions, options.seed)
    estimate, times_s = frame.estimate_singly(estimator, received)
    begin, busy = time.perf_counter(), time.process_time()
    together = estimator.estimate(received)
    batch_s = np.array([time.perf_counter() - begin, time.process_time() - busy])
    deviation = np.nanmax(np.abs(together.mean - estimate.mean), initial=0.0)
    print(f'codebook {codebook.id}, {options.positions} positions, seed {options.seed}')
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
    with tempfile.TemporaryDirectory() as folder:
        for what in ('builds its tables', 'loads its tables'):
            begin = time.perf_counter()
            peak_mib = frame.in_new_process(create, codebook, Path(folder))
            print(f'a process that {what}: {time.perf_counter() - begin:.1f} s, '
                  f'{peak_mib:.0f} MiB peak memory')
    frame.write_results(options.json, figures | {
        'fix_ms': wall_ms, 'fix_cpu_ms': busy_ms, 'rate_of_one_call': rates.tolist()})


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


def create(codebook: Codebook, folder: Path) -> float:
    """Create an estimator, with its tables in a folder; return the peak memory [MiB]."""
    make_estimator('bayes', Scenario(), codebook, table_folder=folder)
    return frame.peak_mib()


if __name__ == '__main__':
    frame.run(main)
