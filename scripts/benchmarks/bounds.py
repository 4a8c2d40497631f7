"""Mean squared error of the posterior mean beside the local and the global bound.

Problem: the average Cramer-Rao bound ignores ambiguities of the range, so the error is up to
fifteen times as large. How close to the error is the global bound, which includes ambiguities, for
several band plans and codebooks? The plans have the same spectrum, 2.5 to 3 GHz, and the same
number of pilots. Codebooks of the plans with four bands are optimised with few steps. Errors are
those of `bayes`, and intervals are twice the standard error. The bound and the errors use
independent random numbers.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import global_bound
from rhs_isac_ros.codebook import Codebook, directional_codebook, optimize, random_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import integer
from rhs_isac_ros.system import System

PLANS = {'equal': (2.5e9, 2.667e9, 2.833e9, 3.0e9), 'unequal': (2.5e9, 2.55e9, 2.7e9, 3.0e9)}
# Update steps and positions of the optimisations: seconds for the bound, a minute for ambiguity.
STEPS, POSITIONS = {'crlb': 300, 'ambiguity': 150}, {'crlb': 256, 'ambiguity': 64}


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('bounds', __doc__, 2000)
    parser.add_argument('--phases', type=integer(2), default=2048,
                        help='positioning phases of the bound')
    options = parser.parse_args()
    print(f'{options.positions} positions, {options.phases} phases for the bound, seed '
          f'{options.seed}\n')
    table = frame.Table(['plan', 'codebook'], {
        'MSE [m²]': ('mse_m2', 3), '± of it': ('mse_interval_m2', 3),
        'CRLB [m²]': ('average_crlb_m2', 4), 'bound [m²]': ('bound_m2', 3),
        '± of the bound': ('bound_interval_m2', 3), 'MSE / CRLB': ('mse_to_crlb', 1),
        'MSE / bound': ('mse_to_bound', 3), 'time of the bound [s]': ('bound_seconds', 1)})
    figures = [
        {'plan': plan, 'codebook': name,
         **table.row(plan, name, **compare(scenario, codebook, options))}
        for plan, name, scenario, codebook in pairs(options)]
    ratios = [entry['mse_to_bound'] for entry in figures]
    print(f'\nMSE / bound from {min(ratios):.3f} to {max(ratios):.3f} over {len(ratios)} pairs')
    frame.write_results(options.json, figures)


def pairs(options: argparse.Namespace) -> Iterator[tuple[str, str, Scenario, Codebook]]:
    """Yield the names of plan and codebook, with both."""
    scenario = Scenario()
    codebooks = {
        'ambiguity': Codebook.load(frame.CONFIG / 'codebook_ambiguity.yaml'),
        'crlb': Codebook.load(frame.CONFIG / 'codebook_crlb.yaml'),
        'directional, width': directional_codebook(scenario),
        'directional, grid': directional_codebook(scenario, scan='grid'),
        'random': random_codebook(scenario, streams.generator(options.seed, streams.START))}
    for name, codebook in codebooks.items():
        yield 'Table I', name, scenario, codebook
    for plan, centers in PLANS.items():
        scenario = Scenario(center_frequencies_hz=centers, n_frames=2)
        for objective, steps in STEPS.items():
            result = optimize(
                scenario, objective=objective, max_steps=steps,
                n_positions=POSITIONS[objective], seed=options.seed)
            yield plan, objective, scenario, result.codebook


def compare(
        scenario: Scenario, codebook: Codebook, options: argparse.Namespace
) -> dict[str, float | str]:
    """Measure the error and compute the bounds."""
    system = System(scenario, codebook)
    positions, received = system.pairs(options.positions, options.seed)
    means = make_estimator('bayes', scenario, codebook).estimate(received).mean
    means[~np.isfinite(means).all(axis=1)] = scenario.roi_center_m
    errors = np.sum((means - positions)**2, axis=1)
    local = float(system.crlb(positions).mean())
    begin = time.process_time()
    bound = global_bound(system, np.random.default_rng([options.seed, 1]), options.phases)
    seconds = time.process_time() - begin
    return {
        'id': codebook.id, 'mse_m2': float(errors.mean()),
        'mse_interval_m2': 2 * float(errors.std()) / np.sqrt(len(errors)),
        'average_crlb_m2': local, 'bound_m2': bound.value,
        'bound_interval_m2': 2 * bound.standard_error, 'mse_to_crlb': float(errors.mean()) / local,
        'mse_to_bound': float(errors.mean()) / bound.value, 'bound_seconds': seconds}


if __name__ == '__main__':
    frame.run(main)
