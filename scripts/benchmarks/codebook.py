"""Positioning error with different codebooks.

Problem: the average Cramer-Rao bound is a local measure. The phases of two bands repeat
periodically in range, and a codebook with a low bound may leave such ranges indistinguishable.
With which codebook are users located most accurately? All codebooks are evaluated with the same
positions, multipath and noise. The estimator is the posterior mean.
"""

import os

# One thread, as in the positioner node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import sys
from pathlib import Path

import numpy as np
from parts.command import benchmark_parser, write_results

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, CodebookError, directional_codebook, random_codebook
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.experiments.resampling import replicate
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import (
    input_file,
    positive_int,
)

CONFIG = Path(__file__).parents[2] / 'config'
BATCH = 50


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('codebook', __doc__)
    parser.add_argument('--positions', type=positive_int, default=1000,
                        help='number of positions')
    parser.add_argument('--codebook', type=input_file, action='append', default=[],
                        help='another codebook to compare; may be repeated')
    options = parser.parse_args()
    scenario = Scenario()
    codebooks = {
        'ambiguity': Codebook.load(CONFIG / 'codebook_ambiguity.yaml'),
        'crlb': Codebook.load(CONFIG / 'codebook_crlb.yaml'),
        'directional': directional_codebook(scenario),
        'random': random_codebook(scenario, streams.generator(options.seed, streams.START)),
        **{path.stem: Codebook.load(path) for path in options.codebook}}
    errors, in_range = {}, {}
    for name, codebook in codebooks.items():
        errors[name], in_range[name] = squared_errors(
            scenario, codebook, options.positions, options.seed)
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    print('| codebook | mean squared error [m^2] | standard error | part in range | median | '
          'average CRLB [m^2] |\n|---|---|---|---|---|---|')
    figures = {}
    for name, codebook in codebooks.items():
        positions = draw_positions(scenario, options.positions, options.seed)
        bound = crlb(scenario, codebook, positions).mean()
        figures[name] = {
            'id': codebook.id, 'mse_m2': errors[name].mean(),
            'standard_error_m2': errors[name].std() / np.sqrt(options.positions),
            'in_range_m2': in_range[name].mean(),
            'median_m2': np.median(errors[name]), 'average_crlb_m2': bound}
        print('| {} | {mse_m2:.3f} | {standard_error_m2:.3f} | {in_range_m2:.3f} | '
              '{median_m2:.3f} | {average_crlb_m2:.4f} |'.format(name, **figures[name]))
    print()
    for rival in ('crlb', 'directional', 'random'):
        ambiguity, other = (
            replicate(errors[name][None], 0)[0] for name in ('ambiguity', rival))
        percent, low, high = ambiguity.reduction_from(other)
        figures[f'reduction_{rival}_percent'] = percent
        print(f'ambiguity is {percent:.1f} % below {rival} '
              f'(95 % interval {low:.1f} to {high:.1f})')
    write_results(options.json, figures)


def draw_positions(scenario: Scenario, n: int, seed: int) -> np.ndarray:
    """Draw the positions; they are the same for all codebooks."""
    return scenario.sample_positions(n, np.random.default_rng(seed))


def squared_errors(
        scenario: Scenario, codebook: Codebook, n: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared error of the posterior mean at each position, and its part in range."""
    positions = draw_positions(scenario, n, seed)
    # The draws of multipath and noise do not depend on the codebook.
    received = simulate_received(scenario, codebook, positions, np.random.default_rng(seed + 1))
    estimator = make_estimator('bayes', scenario, codebook)
    means = np.concatenate([estimator.estimate(received[start:start + BATCH]).mean
                            for start in range(0, n, BATCH)])
    ranges = np.linalg.norm(means, axis=1) - np.linalg.norm(positions, axis=1)
    return np.sum((means - positions)**2, axis=1), ranges**2


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (CodebookError,)))
