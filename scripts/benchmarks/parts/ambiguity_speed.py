"""Part (d) of the benchmark of the optimizer: the ambiguity objective on samples of the pairs.

The reference evaluates all pairs in double precision in each step of L-BFGS-B, with 30
corrections. Its speed is measured side by side with that of the search on samples, and its final
value is that of the shipped codebook, which 3000 of its steps have made.
"""

import time
from pathlib import Path

import numpy as np
from parts.optimizer_growth import side_by_side

from rhs_isac_ros.bounds import PairwiseErrorCost
from rhs_isac_ros.codebook import Codebook, optimize, random_codebook
from rhs_isac_ros.codebook.objective import ROW_TOLERANCE, ambiguity
from rhs_isac_ros.codebook.optimize import DEFAULT_POSITIONS
from rhs_isac_ros.codebook.provenance import Provenance
from rhs_isac_ros.codebook.sampling import draw_confusable, sobol
from rhs_isac_ros.model import MeasurementModel, Scenario, streams

SHIPPED = Path(__file__).parents[3] / 'config' / 'codebook_ambiguity.yaml'
HELD_OUT_PAIRS = 32_768


def all_pairs(objective: PairwiseErrorCost, codebook: Codebook) -> float:
    """Evaluate value and matrix products of the gradient as a plain loop over blocks."""
    rows, total = objective.rows, 0.0
    evaluation = rows.begin(MeasurementModel(objective.scenario, codebook))
    for start in range(0, rows.n_items, 128):
        block = slice(start, min(start + 128, rows.n_items))
        whitened = [evaluation.whitened(block, band)
                    for band in range(objective.scenario.n_bands)]
        parts = [part.view(float) for part in whitened]
        forms = sum(2 * np.matmul(part, np.swapaxes(part, 1, 2)) for part in parts)
        losses, slopes = objective._loss(block, forms)
        total += losses.sum()
        for band, part in enumerate(parts):
            evaluation.accumulate(block, band, np.matmul(slopes, part).view(complex))
    return total / rows.n_items


def ambiguity_speed() -> dict:
    """Run part (d)."""
    scenario, shipped = Scenario(), Codebook.load(SHIPPED)
    rng = np.random.default_rng(1)
    first = scenario.sample_positions(HELD_OUT_PAIRS, rng)
    held_out = PairwiseErrorCost(
        scenario, first, draw_confusable(scenario, first, rng), tolerance=ROW_TOLERANCE)
    begin = time.process_time()
    objective = ambiguity(
        scenario, sobol(scenario, DEFAULT_POSITIONS, streams.generator(0, streams.SAMPLES)),
        streams.generator(0, streams.PAIRS))
    setup_s = time.process_time() - begin
    start = random_codebook(scenario, streams.generator(0, streams.START))
    step_s = side_by_side({'all': lambda: all_pairs(objective, start)}, 10)['all']
    evaluations = Provenance.parse(shipped.provenance).evaluations
    reference_s = setup_s + evaluations * step_s
    begin = time.process_time()
    result = optimize(scenario, objective='ambiguity')
    ours_s = time.process_time() - begin
    values = [held_out.value(codebook) for codebook in (shipped, result.codebook)]
    print('(d) objective ambiguity: time of the default run and value on held-out pairs\n')
    print('| search | s | held-out value [m^2] |\n|---|---|---|')
    print(f'| all pairs, {evaluations} evaluations of {1e3 * step_s:.0f} ms | {reference_s:.0f} | '
          f'{values[0]:.6f} |')
    print(f'| samples of the pairs | {ours_s:.1f} | {values[1]:.6f} |')
    print(f'\nspeed-up: {reference_s / ours_s:.1f}\n')
    return {'ambiguity_reference_s': reference_s, 'ambiguity_s': ours_s,
            'ambiguity_speedup': reference_s / ours_s,
            'ambiguity_held_out_m2': dict(zip(('all', 'samples'), values, strict=True))}
