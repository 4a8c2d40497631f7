"""Part (d) of the benchmark of the optimizer: the ambiguity objective on samples of the pairs.

The reference evaluates all pairs in double precision in each step of L-BFGS-B, with 30
corrections. The processor times of the reference and of the search on samples are measured in the
same run. With the two bands of Table I, the final value of the reference is that of the shipped
codebook, the result of 3000 steps; with four bands, it is assumed to need as many evaluations.
"""

import time
from typing import Any

import numpy as np
from parts.frame import CONFIG, Table, shown

from rhs_isac_ros.bounds import PairwiseErrorCost
from rhs_isac_ros.bounds.rows import Evaluation
from rhs_isac_ros.codebook import Codebook, optimize, random_codebook
from rhs_isac_ros.codebook.codebook import Provenance
from rhs_isac_ros.codebook.objective import ROW_TOLERANCE, ambiguity, draw_confusable, sobol
from rhs_isac_ros.codebook.optimize import DEFAULT_POSITIONS
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.support import streams

SHIPPED = CONFIG / 'codebook_ambiguity.yaml'
HELD_OUT_PAIRS = 32_768
# Evaluations of all pairs that are timed.
N_STEPS = 8


def all_pairs(objective: PairwiseErrorCost, codebook: Codebook) -> float:
    """Evaluate value and matrix products of the gradient as a plain loop over blocks."""
    rows, total = objective.rows, 0.0
    evaluation = Evaluation(rows, MeasurementModel(objective.scenario, codebook))
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
    shipped = Codebook.load(SHIPPED)
    evaluations = Provenance.parse(shipped.provenance).evaluations
    print('(d) objective ambiguity: time of the default run and value on held-out pairs\n')
    table = Table('bands', 'search', 's', 'held-out value [m²]')
    figures = {}
    for name, scenario in {
            '2': Scenario(), '4': Scenario.from_yaml(SHIPPED.with_name('bandplan.yaml'))}.items():
        figures[name] = row = compare(
            scenario, shipped if scenario == Scenario() else None, evaluations)
        table.row(name, f'all pairs, {evaluations} evaluations of {1e3 * row["step_s"]:.0f} ms',
                  shown(row['reference_s'], 0), shown(row['values'].get('all'), 6))
        table.row(name, 'samples of the pairs', shown(row['ours_s'], 1),
                  shown(row['values']['samples'], 6))
    speedups = {name: row['reference_s'] / row['ours_s'] for name, row in figures.items()}
    print('\nspeed-up: ' + ', '.join(
        f'{speedup:.1f} with {name} bands' for name, speedup in speedups.items()) + '\n')
    two = figures['2']
    return {'ambiguity_reference_s': two['reference_s'], 'ambiguity_s': two['ours_s'],
            'ambiguity_speedup': speedups['2'], 'ambiguity_speedup_four_bands': speedups['4'],
            'ambiguity_held_out_m2': two['values']}


def compare(scenario: Scenario, shipped: Codebook | None, evaluations: int) -> dict[str, Any]:
    """Measure a step with all pairs and the default run, and evaluate the results."""
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
    all_pairs(objective, start)
    begin = time.process_time()
    for _ in range(N_STEPS):
        all_pairs(objective, start)
    step_s = (time.process_time() - begin) / N_STEPS
    begin = time.process_time()
    result = optimize(scenario, objective='ambiguity')
    ours_s = time.process_time() - begin
    codebooks = {'samples': result.codebook} | ({'all': shipped} if shipped else {})
    return {'step_s': step_s, 'reference_s': setup_s + evaluations * step_s, 'ours_s': ours_s,
            'values': {name: held_out.value(codebook) for name, codebook in codebooks.items()}}
