"""Positioning error with different codebooks.

Problem: the average Cramer-Rao bound is a local measure. The phases of two bands repeat
periodically in range, and a codebook with a low bound may leave such ranges indistinguishable.
With which codebook are users located most accurately? All codebooks are evaluated with the same
positions, multipath and noise. The estimator is the posterior mean.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, directional_codebook, random_codebook
from rhs_isac_ros.experiments.resampling import replicate
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support import streams

CODEBOOKS: dict[str, Callable[[Scenario, int], Codebook]] = {
    'ambiguity': lambda scenario, seed: Codebook.load(frame.CONFIG / 'codebook_ambiguity.yaml'),
    'crlb': lambda scenario, seed: Codebook.load(frame.CONFIG / 'codebook_crlb.yaml'),
    'directional': lambda scenario, seed: directional_codebook(scenario),
    'random': lambda scenario, seed: random_codebook(
        scenario, streams.generator(seed, streams.START))}


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser('codebook', __doc__, 1000, has_jobs=True).parse_args()
    print(f'{options.positions} positions, seed {options.seed}, posterior mean\n')
    table = frame.Table(['codebook'], {
        'mean squared error [m²]': ('mse_m2', 3), 'standard error': ('standard_error_m2', 3),
        'part in range': ('in_range_m2', 3), 'median': ('median_m2', 3),
        'average CRLB [m²]': ('average_crlb_m2', 4)})
    found = frame.measured(options, 'codebook', errors, {
        name: {'name': name, 'n': options.positions, 'seed': options.seed} for name in CODEBOOKS})
    squares = {name: np.array(one.pop('squares')) for name, one in found.items()}
    figures: dict[str, Any] = {name: table.row(name, **one) for name, one in found.items()}
    print()
    for rival in ('crlb', 'directional', 'random'):
        ambiguity, other = (
            replicate(squares[name][None], 0)[0] for name in ('ambiguity', rival))
        percent, low, high = ambiguity.reduction_from(other)
        figures[f'reduction_{rival}_percent'] = percent
        print(f'ambiguity is {percent:.1f} % below {rival} '
              f'(95 % interval {low:.1f} to {high:.1f})')
    frame.write_results(options.json, figures)


def errors(name: str, n: int, seed: int) -> Mapping[str, Any]:
    """Return the squared errors with a codebook, and figures of them."""
    scenario = Scenario()
    codebook = CODEBOOKS[name](scenario, seed)
    positions = scenario.sample_positions(n, np.random.default_rng(seed))
    # The draws of multipath and noise do not depend on the codebook.
    received = simulate_received(scenario, codebook, positions, np.random.default_rng(seed + 1))
    means = make_estimator('bayes', scenario, codebook).estimate(received).mean
    ranges = np.linalg.norm(means, axis=1) - np.linalg.norm(positions, axis=1)
    squares = np.sum((means - positions)**2, axis=1)
    return {'id': codebook.id, 'squares': squares, 'mse_m2': squares.mean(),
            'standard_error_m2': squares.std() / np.sqrt(n),
            'in_range_m2': np.mean(ranges**2), 'median_m2': np.median(squares),
            'average_crlb_m2': crlb(scenario, codebook, positions).mean()}


if __name__ == '__main__':
    frame.run(main)
