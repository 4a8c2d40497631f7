"""Positioning in scenarios from the literature: coverage, consistency, time and memory.

Problem: does an estimator remain accurate and consistent at wavelengths, apertures, bandwidths and
regions other than those of Table I? Each scenario of config/scenarios, and Table I, is measured in
a separate process, with users uniformly distributed over the region. The codebook is the result of
`optimize` with default settings, or a directional codebook if a scenario is meant for one.

The 95 % region of an estimate is the ellipsoid of its covariance that contains 95 % of a Gaussian.
NEES is the mean squared error normalised by the covariance, 3 for a consistent estimate. A mode
is missed if the residual of the estimate exceeds that at the true position by more than 2. The
claimed error is the root of the mean trace of the covariances. The 95 % intervals of shares are
Wilson's; those of other figures are from a percentile bootstrap.
"""

import os

# One thread, as in the positioner node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from parts.command import benchmark_parser, write_results
from scipy.special import chdtri

from rhs_isac_ros.codebook import Codebook, optimize
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import Estimate, make_estimator, simulate_pairs
from rhs_isac_ros.support.arguments import positive_int

FOLDER = Path(__file__).parents[2] / 'config' / 'scenarios'
# Scenarios whose codebook is directional.
DIRECTIONAL = {'mmwave_64x64', 'weak_signal'}
# Squared Mahalanobis radius of the 95 % region.
REGION_RADIUS = float(chdtri(3, 0.05))
# Excess of a residual over the true position's from which a mode counts as missed.
MISSED = 2.0
RESAMPLES = 2000


def main() -> None:
    """Run the benchmark."""
    options = parse_options()
    if options.one:
        scenario, codebook = scenario_of(options.one), options.codebooks / f'{options.one}.yaml'
        if codebook.exists():
            print(json.dumps(measure(scenario, Codebook.load(codebook), options)))
        else:
            method = 'directional' if options.one in DIRECTIONAL else 'lbfgs'
            optimize(scenario, method=method).codebook.save(codebook)
        return
    with tempfile.TemporaryDirectory() as folder:
        options.codebooks = options.codebooks or Path(folder)
        options.codebooks.mkdir(parents=True, exist_ok=True)
        run(options)


def run(options: argparse.Namespace) -> None:
    """Measure every scenario in a process of its own."""
    names = ['table1', *sorted(path.stem for path in FOLDER.glob('*.yaml'))]
    print('| scenario | fix [%] | in the 95 % region [%] | NEES | missed [%] | error [m] | '
          'claimed [m] | time of a fix [ms] | build [s] | memory [MB] |\n' + '|---' * 10 + '|')
    results: dict[str, Any] = {}
    for name in names:
        if options.only and name not in options.only:
            continue
        command = [sys.executable, __file__, *sys.argv[1:], '--one', name,
                   '--codebooks', str(options.codebooks)]
        # The memory of the optimisation is not that of the estimator.
        if not (options.codebooks / f'{name}.yaml').exists():
            subprocess.run(command, check=True)
        row = json.loads(subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True).stdout)
        report(name, row)
        results |= {f'{name}.{key}': value for key, value in row.items()}
        write_results(options.json, results)


def parse_options() -> argparse.Namespace:
    """Parse the command line."""
    parser = benchmark_parser('scenarios', __doc__)
    add = parser.add_argument
    add('--positions', type=positive_int, default=1000, help='number of positions of each row')
    add('--only', nargs='*', metavar='NAME', help='only these scenarios')
    add('--inside', action='store_true',
        help='estimate without reject_outside, as if no user were outside of the region')
    add('--codebooks', type=Path, help='folder in which codebooks are kept between runs')
    add('--one', help=argparse.SUPPRESS)
    return parser.parse_args()


def scenario_of(name: str) -> Scenario:
    """Load a scenario by its name."""
    return Scenario() if name == 'table1' else Scenario.from_yaml(FOLDER / f'{name}.yaml')


def measure(scenario: Scenario, codebook: Codebook, options: argparse.Namespace
            ) -> dict[str, Any]:
    """Measure one scenario."""
    positions, received = simulate_pairs(scenario, codebook, options.positions, options.seed)
    begin_s = time.process_time()
    estimator = make_estimator(
        'bayes', scenario, codebook, reject_outside=not options.inside)
    build_s = time.process_time() - begin_s
    estimates, times_s = [], []
    for signals in received:
        begin_s = time.process_time()
        estimates.append(estimator.estimate(signals))
        times_s.append(time.process_time() - begin_s)
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    model = MeasurementModel(scenario, codebook)
    at_truth = np.sum(
        np.abs(model.whiten(received) - model.whiten(model.mean(positions)))**2, axis=(1, 2))
    return figures(estimates, positions, at_truth) | {
        'build_s': build_s, 'rss_mb': memory_mb, 'fix_ms': 1e3 * float(np.median(times_s)),
        'slowest_ms': 1e3 * float(np.max(times_s))}


def figures(estimates: list[Estimate], positions: np.ndarray, at_truth: np.ndarray
            ) -> dict[str, Any]:
    """Compute the figures of a row; shares are in percent, with their intervals in a list."""
    fix = np.array([bool(one.fix) for one in estimates])
    fixed = [one for one in estimates if one.fix]
    n, n_fixes = len(estimates), len(fixed)
    errors = np.stack([one.mean for one in fixed]) - positions[fix]
    covariances = np.stack([one.covariance for one in fixed])
    residuals = np.array([float(one.residual) for one in fixed])
    normalised = np.sum(
        errors * np.linalg.solve(covariances, errors[..., None])[..., 0], axis=1)
    squares, traces = np.sum(errors**2, axis=1), np.trace(covariances, axis1=1, axis2=2)
    shares = {
        'fix': (n_fixes, n), 'in_region': (int(np.sum(normalised <= REGION_RADIUS)), n_fixes),
        'missed': (int(np.sum(residuals > at_truth[fix] + MISSED)), n_fixes)}
    row: dict[str, Any] = {'positions': n}
    for key, (count, total) in shares.items():
        row[key], *row[f'{key}_interval'] = share_percent(count, total)
    for key, samples, root in (('nees', normalised, 1.0), ('rms_m', squares, 0.5),
                               ('claimed_m', traces, 0.5)):
        row[key] = float(samples.mean()**root)
        row[f'{key}_interval'] = [value**root for value in bootstrap(samples)]
    return row


def bootstrap(samples: np.ndarray) -> list[float]:
    """Return the 95 % interval of a mean."""
    picks = np.random.default_rng(0).integers(len(samples), size=(RESAMPLES, len(samples)))
    low, high = np.percentile(samples[picks].mean(axis=1), (2.5, 97.5))
    return [float(low), float(high)]


def report(name: str, row: dict[str, Any]) -> None:
    """Print a row as a line of the table."""
    def cell(key: str, digits: int) -> str:
        low, high = row[f'{key}_interval']
        return f'{row[key]:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]'

    print(f'| {name} | {cell("fix", 1)} | {cell("in_region", 1)} | {cell("nees", 2)} | '
          f'{cell("missed", 2)} | {cell("rms_m", 3)} | {cell("claimed_m", 3)} | '
          f'{row["fix_ms"]:.1f} | {row["build_s"]:.1f} | {row["rss_mb"]:.0f} |', flush=True)


if __name__ == '__main__':
    main()
