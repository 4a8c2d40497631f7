"""Positioning error with different codebooks.

Problem: the average Cramer-Rao bound is a local measure. The phases of two bands repeat
periodically in range, and a codebook with a low bound may leave such ranges indistinguishable.
With which codebook are users located most accurately? All codebooks are evaluated with the same
positions, multipath and noise. The estimator is the posterior mean.
"""

import numpy as np
from parts.frame import CONFIG, Table, benchmark_parser, run, shown, write_results

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, directional_codebook, random_codebook
from rhs_isac_ros.experiments.resampling import replicate
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import input_file


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('codebook', __doc__, 1000)
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
    positions = scenario.sample_positions(
        options.positions, np.random.default_rng(options.seed))
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    table = Table('codebook', 'mean squared error [m²]', 'standard error', 'part in range',
                  'median', 'average CRLB [m²]')
    errors, figures = {}, {}
    for name, codebook in codebooks.items():
        # The draws of multipath and noise do not depend on the codebook.
        received = simulate_received(
            scenario, codebook, positions, np.random.default_rng(options.seed + 1))
        means = make_estimator('bayes', scenario, codebook).estimate(received).mean
        ranges = np.linalg.norm(means, axis=1) - np.linalg.norm(positions, axis=1)
        errors[name] = squares = np.sum((means - positions)**2, axis=1)
        figures[name] = row = {
            'id': codebook.id, 'mse_m2': squares.mean(),
            'standard_error_m2': squares.std() / np.sqrt(len(squares)),
            'in_range_m2': np.mean(ranges**2), 'median_m2': np.median(squares),
            'average_crlb_m2': crlb(scenario, codebook, positions).mean()}
        table.row(name, *(shown(row[key], 3) for key in (
            'mse_m2', 'standard_error_m2', 'in_range_m2', 'median_m2')),
            shown(row['average_crlb_m2'], 4))
    print()
    for rival in ('crlb', 'directional', 'random'):
        ambiguity, other = (
            replicate(errors[name][None], 0)[0] for name in ('ambiguity', rival))
        percent, low, high = ambiguity.reduction_from(other)
        figures[f'reduction_{rival}_percent'] = percent
        print(f'ambiguity is {percent:.1f} % below {rival} '
              f'(95 % interval {low:.1f} to {high:.1f})')
    write_results(options.json, figures)


if __name__ == '__main__':
    run(main)
