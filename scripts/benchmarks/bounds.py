"""Mean squared error of the posterior mean beside the local and the global bound.

Problem: the average Cramer-Rao bound ignores ambiguities of the range, so the error is up to
fifteen times as large. How close to the error is the global bound, which includes ambiguities, for
several band plans and codebooks? The plans have the same spectrum, 2.5 to 3 GHz, and the same
number of pilots. Codebooks of the plans with four bands are optimised with few steps. Errors are
those of `bayes`, and intervals are twice the standard error. The bound and the errors use
independent random numbers.
"""

import itertools
import time
from typing import Any

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
    parser = frame.benchmark_parser('bounds', __doc__, 2000, has_jobs=True)
    parser.add_argument('--phases', type=integer(2), default=2048,
                        help='positioning phases of the bound')
    options = parser.parse_args()
    print(f'{options.positions} positions, {options.phases} phases for the bound, seed '
          f'{options.seed}\n')
    pairs = [*(('Table I', name) for name in codebooks(options.seed)),
             *itertools.product(PLANS, STEPS)]
    figures = frame.measured(options, 'bounds', compare, {
        f'{plan}, {name}': {'plan': plan, 'codebook': name, 'n': options.positions,
                            'n_phases': options.phases, 'seed': options.seed}
        for plan, name in pairs}).values()
    table = frame.Table(['plan', 'codebook'], {
        'MSE [m²]': ('mse_m2', 3), '± of it': ('mse_interval_m2', 3),
        'CRLB [m²]': ('average_crlb_m2', 4), 'bound [m²]': ('bound_m2', 3),
        '± of the bound': ('bound_interval_m2', 3), 'MSE / CRLB': ('mse_to_crlb', 1),
        'MSE / bound': ('mse_to_bound', 3), 'time of the bound [s]': ('bound_seconds', 1)})
    for row in figures:
        table.row(row['plan'], row['codebook'], **row)
    ratios = [entry['mse_to_bound'] for entry in figures]
    print(f'\nMSE / bound from {min(ratios):.3f} to {max(ratios):.3f} over {len(ratios)} pairs')
    frame.write_results(options.json, [*figures])


def codebooks(seed: int) -> dict[str, Codebook]:
    """Return the codebooks for Table I."""
    scenario = Scenario()
    return {
        'ambiguity': Codebook.load(frame.CONFIG / 'codebook_ambiguity.yaml'),
        'crlb': Codebook.load(frame.CONFIG / 'codebook_crlb.yaml'),
        'directional, width': directional_codebook(scenario),
        'directional, grid': directional_codebook(scenario, scan='grid'),
        'random': random_codebook(scenario, streams.generator(seed, streams.START))}


def pair(plan: str, name: str, seed: int) -> System:
    """Return a plan with a codebook, which is optimised for plans other than Table I."""
    if plan not in PLANS:
        return System(Scenario(), codebooks(seed)[name])
    scenario = Scenario(center_frequencies_hz=PLANS[plan], n_frames=2)
    return System(scenario, optimize(
        scenario, objective=name, max_steps=STEPS[name], n_positions=POSITIONS[name],
        seed=seed).codebook)


def compare(plan: str, codebook: str, n: int, n_phases: int, seed: int) -> dict[str, Any]:
    """Run a job: measure the error and compute the bounds."""
    system = pair(plan, codebook, seed)
    positions, received = system.pairs(n, seed)
    means = make_estimator('bayes', system.scenario, system.codebook).estimate(received).mean
    means[~np.isfinite(means).all(axis=1)] = system.scenario.roi_center_m
    errors = np.sum((means - positions)**2, axis=1)
    local = float(system.crlb(positions).mean())
    begin = time.process_time()
    bound = global_bound(system, np.random.default_rng([seed, 1]), n_phases)
    seconds = time.process_time() - begin
    return {
        'plan': plan, 'codebook': codebook, 'id': system.codebook.id, 'mse_m2': errors.mean(),
        'mse_interval_m2': 2 * errors.std() / np.sqrt(len(errors)),
        'average_crlb_m2': local, 'bound_m2': bound.value,
        'bound_interval_m2': 2 * bound.standard_error, 'mse_to_crlb': errors.mean() / local,
        'mse_to_bound': errors.mean() / bound.value, 'bound_seconds': seconds}


if __name__ == '__main__':
    frame.run(main)
