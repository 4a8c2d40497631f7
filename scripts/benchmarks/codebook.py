"""Positioning error with different codebooks.

Problem: the average Cramer-Rao bound is a local measure. The phases of two bands repeat
periodically in range, and a codebook with a low bound may leave such ranges indistinguishable.
With which codebook are users located most accurately? All codebooks are evaluated with the same
positions, multipath and noise. The estimator is the posterior mean.
"""

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, directional_codebook, random_codebook
from rhs_isac_ros.experiments.resampling import replicate
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support import streams


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser('codebook', __doc__, 1000).parse_args()
    scenario = Scenario()
    codebooks = {
        'ambiguity': Codebook.load(frame.CONFIG / 'codebook_ambiguity.yaml'),
        'crlb': Codebook.load(frame.CONFIG / 'codebook_crlb.yaml'),
        'directional': directional_codebook(scenario),
        'random': random_codebook(scenario, streams.generator(options.seed, streams.START))}
    positions = scenario.sample_positions(
        options.positions, np.random.default_rng(options.seed))
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    table = frame.Table(['codebook'], {
        'mean squared error [m²]': ('mse_m2', 3), 'standard error': ('standard_error_m2', 3),
        'part in range': ('in_range_m2', 3), 'median': ('median_m2', 3),
        'average CRLB [m²]': ('average_crlb_m2', 4)})
    errors, figures = {}, {}
    for name, codebook in codebooks.items():
        # The draws of multipath and noise do not depend on the codebook.
        received = simulate_received(
            scenario, codebook, positions, np.random.default_rng(options.seed + 1))
        means = make_estimator('bayes', scenario, codebook).estimate(received).mean
        ranges = np.linalg.norm(means, axis=1) - np.linalg.norm(positions, axis=1)
        errors[name] = squares = np.sum((means - positions)**2, axis=1)
        figures[name] = table.row(
            name, id=codebook.id, mse_m2=squares.mean(),
            standard_error_m2=squares.std() / np.sqrt(len(squares)),
            in_range_m2=np.mean(ranges**2), median_m2=np.median(squares),
            average_crlb_m2=crlb(scenario, codebook, positions).mean())
    print()
    for rival in ('crlb', 'directional', 'random'):
        ambiguity, other = (
            replicate(errors[name][None], 0)[0] for name in ('ambiguity', rival))
        percent, low, high = ambiguity.reduction_from(other)
        figures[f'reduction_{rival}_percent'] = percent
        print(f'ambiguity is {percent:.1f} % below {rival} '
              f'(95 % interval {low:.1f} to {high:.1f})')
    frame.write_results(options.json, figures)


if __name__ == '__main__':
    frame.run(main)
