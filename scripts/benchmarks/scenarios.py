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
from parts import frame

from rhs_isac_ros.codebook import Codebook, optimize
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import make_estimator, simulate_pairs

FOLDER = frame.CONFIG / 'scenarios'
# Scenarios whose codebook is directional.
DIRECTIONAL = {'mmwave_64x64', 'weak_signal'}
# Excess of a residual over the true position's from which a mode counts as missed.
MISSED = 2.0


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
        measure_all(options)


def measure_all(options: argparse.Namespace) -> None:
    """Measure every scenario in a process of its own."""
    table = frame.Table('scenario', 'fix [%]', 'in the 95 % region [%]', 'NEES', 'missed [%]',
                  'error [m]', 'claimed [m]', 'time of a fix [ms]', 'build [s]', 'memory [MB]')
    results: dict[str, Any] = {}
    for name in ['table1', *sorted(path.stem for path in FOLDER.glob('*.yaml'))]:
        if options.only and name not in options.only:
            continue
        command = [sys.executable, __file__, *sys.argv[1:], '--one', name,
                   '--codebooks', str(options.codebooks)]
        # The memory of the optimisation is not that of the estimator.
        if not (options.codebooks / f'{name}.yaml').exists():
            subprocess.run(command, check=True)
        row = json.loads(subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True).stdout)
        table.row(name, *(
            frame.shown([row[key], *row[f'{key}_interval']], digits) for key, digits in (
                ('fix', 1), ('in_region', 1), ('nees', 2), ('missed', 2), ('rms_m', 3),
                ('claimed_m', 3))),
            *(frame.shown(row[key], digits) for key, digits in (
                ('fix_ms', 1), ('build_s', 1), ('rss_mb', 0))))
        results |= {f'{name}.{key}': value for key, value in row.items()}
        frame.write_results(options.json, results)


def parse_options() -> argparse.Namespace:
    """Parse the command line."""
    parser = frame.benchmark_parser('scenarios', __doc__, 1000)
    add = parser.add_argument
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
    estimate, times_s = frame.estimate_singly(estimator, received)
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    model = MeasurementModel(scenario, codebook)
    at_truth = np.sum(
        np.abs(model.whiten(received) - model.whiten(model.mean(positions)))**2, axis=(1, 2))
    fixes = frame.Fixes.of(estimate, positions)
    fix, traces = fixes.fix, np.trace(estimate.covariance, axis1=1, axis2=2)
    missed = int(np.sum(estimate.residual[fix] > at_truth[fix] + MISSED))
    intervals = {
        'fix': share_percent(int(fix.sum()), len(fix)), 'in_region': fixes.covered,
        'missed': share_percent(missed, int(fix.sum())),
        'nees': frame.mean_interval(fixes.normalised),
        'rms_m': [value**0.5 for value in frame.mean_interval(fixes.squared)],
        'claimed_m': [value**0.5 for value in frame.mean_interval(traces[fix])]}
    row: dict[str, Any] = {'positions': len(fix)}
    for key, (value, *ends) in intervals.items():
        row |= {key: value, f'{key}_interval': ends}
    return row | {
        'build_s': build_s, 'rss_mb': memory_mb, 'fix_ms': 1e3 * float(np.median(times_s[:, 1])),
        'slowest_ms': 1e3 * float(np.max(times_s[:, 1]))}


if __name__ == '__main__':
    frame.run(main)
