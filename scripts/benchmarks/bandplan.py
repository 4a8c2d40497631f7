"""Positioning error with different band plans at equal spectrum, power and number of pilots.

Problem: the phases of two bands 0.5 GHz apart repeat every 0.6 m of range. How much smaller is the
error with four bands chosen for the region, each with half as many frames? The estimator is the
posterior mean. The 95 % region is the ellipsoid of its covariance that contains 95 % of a
Gaussian. Brackets contain 95 % intervals: Wilson's for shares, and those of a percentile bootstrap
over the positions for squared errors.

--plan adds a plan, for example one with two bands, as chosen by python3 -m rhs_isac_ros.codebook
--spectrum 2.5e9:3.0e9 --bands 2 --plan two.yaml --output codebook_two.yaml.
"""

from typing import Any

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('bandplan', __doc__, 10_000, has_jobs=True)
    frame.add_plans(parser, [*frame.SYSTEMS])
    parser.add_argument('--only-plans', action='store_true', help='only the plans of --plan')
    options = parser.parse_args()
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    plans = {} if options.only_plans else {
        name: [frame.CONFIG / file for file in files] for name, files in frame.SYSTEMS.items()}
    plans |= options.plan
    figures = frame.measured(options, 'bandplan', measure, {
        name: {'scenario': str(scenario), 'codebook': str(codebook), 'n': options.positions,
               'seed': options.seed} for name, (scenario, codebook) in plans.items()})
    table = frame.Table(['plan'], {
        'mean squared error [m²]': ('mse_m2', 4), 'median error [m]': ('median_m', 3),
        'average CRLB [m²]': ('average_crlb_m2', 4), 'in the 95 % region [%]': ('covered', 1)})
    for name, row in figures.items():
        table.row(name, **row)
    frame.write_results(options.json, figures)


def measure(scenario: str, codebook: str, n: int, seed: int) -> dict[str, Any]:
    """Run a job: locate users with a plan."""
    world, book = Scenario.from_yaml(scenario), Codebook.load(codebook)
    rng = np.random.default_rng(seed)
    positions = world.sample_positions(n, rng)
    received = simulate_received(world, book, positions, rng)
    estimate = make_estimator('bayes', world, book).estimate(received)
    return frame.Fixes.of(estimate, positions).figures() | {
        'id': book.id, 'average_crlb_m2': crlb(world, book, positions).mean()}


if __name__ == '__main__':
    frame.run(main)
