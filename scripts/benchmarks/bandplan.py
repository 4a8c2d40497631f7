"""Positioning error with different band plans at equal spectrum, power and number of pilots.

Problem: the phases of two bands 0.5 GHz apart repeat every 0.6 m of range. How much smaller is the
error with four bands chosen for the region, each with half as many frames? How close does the
coordinate search come to the best of all plans on a small raster? The estimator is the posterior
mean. The 95 % region is the ellipsoid of its covariance that contains 95 % of a Gaussian.

--plan adds a plan, for example one with two bands, as chosen by python3 -m rhs_isac_ros.codebook
--spectrum 2.5e9:3.0e9 --bands 2 --plan two.yaml --output codebook_two.yaml.
"""

import os

# One thread, as in the positioner node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import sys
from pathlib import Path

import numpy as np
from parts.command import benchmark_parser, write_results
from scipy.stats import chi2

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.bounds.range_ambiguity import range_confusion_error
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.band_plan import raster, screen
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.model import Scenario, ScenarioError, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support.arguments import (
    input_file,
    positive_int,
)

CONFIG = Path(__file__).parents[2] / 'config'
PLANS = {'Table I': ('table1.yaml', 'codebook_ambiguity.yaml'),
         'bandplan': ('bandplan.yaml', 'codebook_bandplan.yaml')}
BATCH = 50
# The small raster on which all plans are compared.
SPECTRUM_HZ, RASTER_HZ, BANDS = [(2.5e9, 3.0e9)], 20e6, 4
ENERGIES, MAX_LAG_M = np.array([40.0, 80.0, 160.0]), 14.3
SEARCHES = 20


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('bandplan', __doc__)
    parser.add_argument('--positions', type=positive_int, default=10_000,
                        help='number of positions (default: %(default)s)')
    parser.add_argument('--plan', type=input_file, nargs=2, action='append', default=[],
                        metavar=('SCENARIO', 'CODEBOOK'), help='another plan and its codebook')
    parser.add_argument('--only-plans', action='store_true',
                        help='leave out the built-in plans and the comparison of searches')
    options = parser.parse_args()
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    print('| plan | mean squared error [m^2], 95 % interval | median error [m] | '
          'average CRLB [m^2] | coverage of the 95 % region |\n|---|---|---|---|---|')
    plans = {} if options.only_plans else {
        name: (CONFIG / scenario, CONFIG / codebook)
        for name, (scenario, codebook) in PLANS.items()}
    plans |= {scenario.stem: (scenario, codebook) for scenario, codebook in options.plan}
    figures = {}
    for name, (scenario, codebook) in plans.items():
        figures[name] = row = evaluate(
            Scenario.from_yaml(scenario), Codebook.load(codebook), options)
        print('| {} | {mse_m2:.4f} [{low_m2:.4f}, {high_m2:.4f}] | {median_m:.3f} | '
              '{average_crlb_m2:.4f} | {coverage:.3f} |'.format(name, **row), flush=True)
    if not options.only_plans:
        figures['search'] = compare_searches()
    write_results(options.json, figures)


def evaluate(scenario: Scenario, codebook: Codebook, options: argparse.Namespace) -> dict:
    """Measure error and coverage of one plan."""
    rng = np.random.default_rng(options.seed)
    positions = scenario.sample_positions(options.positions, rng)
    received = simulate_received(scenario, codebook, positions, rng)
    estimator = make_estimator('bayes', scenario, codebook)
    estimates = [estimator.estimate(received[start:start + BATCH])
                 for start in range(0, len(positions), BATCH)]
    offsets = np.concatenate([estimate.mean for estimate in estimates]) - positions
    covariance = np.concatenate([estimate.covariance for estimate in estimates])
    squares = np.sum(offsets**2, axis=1)
    distances = np.einsum('nu,nu->n', offsets, np.linalg.solve(
        covariance, offsets[..., None])[..., 0])
    margin = 1.96 * squares.std() / np.sqrt(len(squares))
    return {
        'id': codebook.id, 'frequencies_hz': scenario.center_frequencies_hz,
        'mse_m2': squares.mean(), 'low_m2': squares.mean() - margin,
        'high_m2': squares.mean() + margin, 'median_m': np.median(squares)**0.5,
        'average_crlb_m2': crlb(scenario, codebook, positions).mean(),
        'coverage': np.mean(distances <= chi2.ppf(0.95, 3))}


def compare_searches() -> dict:
    """Compare coordinate searches with the evaluation of all plans."""
    def errors(plans: np.ndarray) -> np.ndarray:
        return range_confusion_error(plans, ENERGIES, MAX_LAG_M)

    frequencies = raster(SPECTRUM_HZ, RASTER_HZ)
    plans, values = screen(frequencies, BANDS, 1e6, errors, np.random.default_rng(0))
    found = [screen(frequencies, BANDS, 1e6, errors, np.random.default_rng(number),
                    max_exhaustive=0)[1].min() for number in range(SEARCHES)]
    ranks = [int(np.sum(values < value * (1 - 1e-6))) + 1 for value in found]
    print(f'\nscreening of {len(plans)} plans on a raster of {RASTER_HZ / 1e6:g} MHz: best '
          f'{values.min():.3f} m^2, median {np.median(values):.3f} m^2; {SEARCHES} coordinate '
          f'searches: {np.median(found):.3f} m^2, worst {max(found):.3f} m^2, rank '
          f'{max(ranks)} at worst')
    return {'plans': len(plans), 'best_m2': values.min(), 'found_m2': found, 'ranks': ranks}


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (CodebookError, ScenarioError)))
