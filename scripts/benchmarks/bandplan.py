"""Positioning error with different band plans at equal spectrum, power and number of pilots.

Problem: the phases of two bands 0.5 GHz apart repeat every 0.6 m of range. How much smaller is the
error with four bands chosen for the region, each with half as many frames? How close does the
coordinate search come to the best of all plans on a small raster? The estimator is the posterior
mean. The 95 % region is the ellipsoid of its covariance that contains 95 % of a Gaussian. Brackets
contain 95 % intervals of a percentile bootstrap over the positions.

--plan adds a plan, for example one with two bands, as chosen by python3 -m rhs_isac_ros.codebook
--spectrum 2.5e9:3.0e9 --bands 2 --plan two.yaml --output codebook_two.yaml.
"""

import argparse

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.bounds.range_ambiguity import range_confusion_error
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.band_plan import raster, screen
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator

PLANS = {'Table I': ('table1.yaml', 'codebook_ambiguity.yaml'),
         'bandplan': ('bandplan.yaml', 'codebook_bandplan.yaml')}
# The small raster on which all plans are compared.
SPECTRUM_HZ, RASTER_HZ, BANDS = [(2.5e9, 3.0e9)], 20e6, 4
ENERGIES, MAX_LAG_M = np.array([40.0, 80.0, 160.0]), 14.3
SEARCHES = 20


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('bandplan', __doc__, 10_000)
    frame.add_plans(parser)
    options = parser.parse_args()
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    table = frame.Table('plan', 'mean squared error [m²]', 'median error [m]', 'average CRLB [m²]',
                  'in the 95 % region [%]')
    plans = {} if options.only_plans else {
        name: (frame.CONFIG / scenario, frame.CONFIG / codebook)
        for name, (scenario, codebook) in PLANS.items()}
    plans |= {scenario.stem: (scenario, codebook) for scenario, codebook in options.plan}
    figures = {}
    for name, (scenario, codebook) in plans.items():
        figures[name] = row = evaluate(
            Scenario.from_yaml(scenario), Codebook.load(codebook), options)
        table.row(name, frame.shown([row['mse_m2'], row['low_m2'], row['high_m2']], 4),
                  frame.shown(row['median_m'], 3), frame.shown(row['average_crlb_m2'], 4),
                  frame.shown(100 * row['coverage'], 1))
    if not options.only_plans:
        figures['search'] = compare_searches()
    frame.write_results(options.json, figures)


def evaluate(scenario: Scenario, codebook: Codebook, options: argparse.Namespace) -> dict:
    """Measure error and coverage of one plan."""
    rng = np.random.default_rng(options.seed)
    positions = scenario.sample_positions(options.positions, rng)
    received = simulate_received(scenario, codebook, positions, rng)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)
    fixes = frame.Fixes.of(estimate, positions)
    mse_m2, low_m2, high_m2 = frame.mean_interval(fixes.squared)
    return {
        'id': codebook.id, 'frequencies_hz': scenario.center_frequencies_hz, 'mse_m2': mse_m2,
        'low_m2': low_m2, 'high_m2': high_m2, 'median_m': np.median(fixes.squared)**0.5,
        'average_crlb_m2': crlb(scenario, codebook, positions).mean(),
        'coverage': fixes.inside.mean()}


def compare_searches() -> dict:
    """Compare coordinate searches with the evaluation of all plans."""
    def screened(seed: int, **settings: int) -> tuple[np.ndarray, np.ndarray]:
        return screen(raster(SPECTRUM_HZ, RASTER_HZ), BANDS, 1e6,
                      lambda plans: range_confusion_error(plans, ENERGIES, MAX_LAG_M),
                      np.random.default_rng(seed), **settings)

    plans, values = screened(0)
    found = [screened(number, max_exhaustive=0)[1].min() for number in range(SEARCHES)]
    ranks = [int(np.sum(values < value * (1 - 1e-6))) + 1 for value in found]
    print(f'\nscreening of {len(plans)} plans on a raster of {RASTER_HZ / 1e6:g} MHz: best '
          f'{values.min():.3f} m^2, median {np.median(values):.3f} m^2; {SEARCHES} coordinate '
          f'searches: {np.median(found):.3f} m^2, worst {max(found):.3f} m^2, rank '
          f'{max(ranks)} at worst')
    return {'plans': len(plans), 'best_m2': values.min(), 'found_m2': found, 'ranks': ranks}


if __name__ == '__main__':
    frame.run(main)
