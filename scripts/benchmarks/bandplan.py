"""Positioning error with different band plans at equal spectrum, power and number of pilots.

Problem: the phases of two bands 0.5 GHz apart repeat every 0.6 m of range. How much smaller is the
error with four bands chosen for the region, each with half as many frames? The estimator is the
posterior mean. The 95 % region is the ellipsoid of its covariance that contains 95 % of a
Gaussian. Brackets contain 95 % intervals: Wilson's for shares, and those of a percentile bootstrap
over the positions for squared errors.

--plan adds a plan, for example one with two bands, as chosen by python3 -m rhs_isac_ros.codebook
--spectrum 2.5e9:3.0e9 --bands 2 --plan two.yaml --output codebook_two.yaml.
"""

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('bandplan', __doc__, 10_000)
    frame.add_plans(parser, [*frame.SYSTEMS])
    parser.add_argument('--only-plans', action='store_true', help='only the plans of --plan')
    options = parser.parse_args()
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    table = frame.Table(['plan'], {
        'mean squared error [m²]': ('mse_m2', 4), 'median error [m]': ('median_m', 3),
        'average CRLB [m²]': ('average_crlb_m2', 4), 'in the 95 % region [%]': ('covered', 1)})
    systems = {} if options.only_plans else {
        name: frame.system(name) for name in frame.SYSTEMS}
    systems |= {name: (Scenario.from_yaml(scenario), Codebook.load(codebook))
                for name, (scenario, codebook) in options.plan.items()}
    figures = {}
    for name, (scenario, codebook) in systems.items():
        rng = np.random.default_rng(options.seed)
        positions = scenario.sample_positions(options.positions, rng)
        received = simulate_received(scenario, codebook, positions, rng)
        estimate = make_estimator('bayes', scenario, codebook).estimate(received)
        figures[name] = table.row(
            name, **frame.Fixes.of(estimate, positions).figures(), id=codebook.id,
            average_crlb_m2=crlb(scenario, codebook, positions).mean())
    frame.write_results(options.json, figures)


if __name__ == '__main__':
    frame.run(main)
