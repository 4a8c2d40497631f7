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

import time
from typing import Any

import numpy as np
from parts import frame

from rhs_isac_ros.codebook import Codebook, optimize
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.system import System

FOLDER = frame.CONFIG / 'scenarios'
# Scenarios whose codebook is directional.
DIRECTIONAL = {'mmwave_64x64', 'weak_signal'}
# Excess of a residual over the true position's from which a mode counts as missed.
MISSED = 2.0


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser('scenarios', __doc__, 1000).parse_args()
    table = frame.Table(['scenario'], {
        'fix [%]': ('fix', 1), 'in the 95 % region [%]': ('covered', 1), 'NEES': ('nees', 2),
        'missed [%]': ('missed', 2), 'error [m]': ('rms_m', 3), 'claimed [m]': ('claimed_m', 3),
        'time of a fix [ms]': ('fix_ms', 1), 'build [s]': ('build_s', 1),
        'memory [MB]': ('peak_mib', 0)})
    results = {}
    for name in ['table1', *sorted(path.stem for path in FOLDER.glob('*.yaml'))]:
        # The memory of the optimisation is not that of the estimator.
        codebook = frame.in_new_process(design, name)
        results[name] = table.row(name, **frame.in_new_process(
            measure, name, codebook, options.positions, options.seed))
        frame.write_results(options.json, results)


def design(name: str) -> Codebook:
    """Optimise a codebook, or return a directional one."""
    return optimize(scenario_of(name),
                    method='directional' if name in DIRECTIONAL else 'lbfgs').codebook


def scenario_of(name: str) -> Scenario:
    """Load a scenario by its name."""
    return Scenario() if name == 'table1' else Scenario.from_yaml(FOLDER / f'{name}.yaml')


def measure(name: str, codebook: Codebook, n: int, seed: int) -> dict[str, Any]:
    """Measure one scenario with n positions."""
    scenario = scenario_of(name)
    positions, received = System(scenario, codebook).pairs(n, seed)
    begin_s = time.process_time()
    estimator = make_estimator('bayes', scenario, codebook, reject_outside=True)
    build_s = time.process_time() - begin_s
    estimate, times_s = frame.estimate_singly(estimator, received)
    peak_mib = frame.peak_mib()
    model = MeasurementModel(scenario, codebook)
    at_truth = np.sum(
        np.abs(model.whiten(received) - model.whiten(model.mean(positions)))**2, axis=(1, 2))
    fixes = frame.Fixes.of(estimate, positions)
    fix, traces = fixes.fix, np.trace(estimate.covariance, axis1=1, axis2=2)
    missed = int(np.sum(estimate.residual[fix] > at_truth[fix] + MISSED))
    return {
        **fixes.figures(), 'missed': share_percent(missed, int(fix.sum())),
        'claimed_m': [value**0.5 for value in frame.mean_interval(traces[fix])],
        'build_s': build_s, 'peak_mib': peak_mib, 'fix_ms': 1e3 * float(np.median(times_s[:, 1])),
        'slowest_ms': 1e3 * float(np.max(times_s[:, 1]))}


if __name__ == '__main__':
    frame.run(main)
