"""The price of a wrong declaration: fields of the scenario that are wrong by a factor of two.

Problem: the estimator assumes the band plan, but the true value of one field is twice or half that
of the plan (a level: 3 dB higher or lower; the refractive index: 0.2 %). How large do the errors
become, and does `bounds.misspecified` predict them? The table compares the predicted root mean
squared error with that of the estimator `ml` on simulated signals, at the positions where the
prediction is `valid`. The 95 % interval of the ratio of the mean squared errors is from a
bootstrap over the positions. Signals without a fix are left out.
"""

import os

# One thread, as in the positioner node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
from parts.command import benchmark_parser, write_results

from rhs_isac_ros.bounds import misspecified
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.model import MeasurementModel, Scenario, ScenarioError
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support.arguments import positive_int

CONFIG = Path(__file__).parents[2] / 'config'
LEVELS_DB = -25.0, -15.0, 0.0
FACTORS = {'delay_spread_s': 2.0, 'angular_spread_deg': 2.0, 'max_user_speed_mps': 2.0,
           'user_gain': 2.0, 'element_gain': 2.0, 'refractive_index': 1.002}
N_BOOTSTRAP = 1000


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('misspecified', __doc__)
    add = parser.add_argument
    add('--positions', type=positive_int, default=60, help='number of positions')
    add('--phases', type=positive_int, default=100, help='phases at each position')
    options = parser.parse_args()
    codebook = Codebook.load(CONFIG / 'codebook_bandplan.yaml')
    print('| multipath [dB] | field | true value | valid [%] | predicted [m] | simulated [m] | '
          'ratio of the MSE | fixes [%] |\n|---|---|---|---|---|---|---|---|')
    rows = []
    for level in LEVELS_DB:
        assumed = dataclasses.replace(
            Scenario.from_yaml(CONFIG / 'bandplan.yaml'), multipath_to_los_db=level)
        changes = [('none', {})] + [
            (name, {name: getattr(assumed, name) * change}) for name, factor in FACTORS.items()
            for change in (factor, 1 / factor)]
        changes += [('multipath_to_los_db', {'multipath_to_los_db': level + change})
                    for change in (3.0, -3.0)]
        rows += [evaluate(assumed, name, change, codebook, options) for name, change in changes]
    write_results(options.json, rows)


def evaluate(assumed: Scenario, name: str, change: dict[str, float], codebook: Codebook,
             options: argparse.Namespace) -> dict:
    """Predict and simulate the errors for one wrong field, and print a row."""
    rng = np.random.default_rng(options.seed)
    positions = assumed.sample_positions(options.positions, rng)
    true = dataclasses.replace(assumed, **change)
    result = misspecified(
        MeasurementModel(assumed, codebook), MeasurementModel(true, codebook), positions)
    row = {'level_db': assumed.multipath_to_los_db, 'field': name, 'change': change,
           'valid': float(result.valid.mean())}
    text = '- | - | -'
    fixes = '-'
    if result.valid.any():
        places = np.repeat(positions[result.valid], options.phases, axis=0)
        received = MeasurementModel(true, codebook).sample(places, rng)
        estimate = make_estimator('ml', assumed, codebook).estimate(received)
        squares = np.sum((estimate.mean - places)**2, axis=1).reshape(-1, options.phases)
        simulated, predicted = np.nanmean(squares, axis=1), result.mse_m2[result.valid]
        drawn = rng.integers(len(simulated), size=(N_BOOTSTRAP, len(simulated)))
        ratios = simulated[drawn].mean(axis=1) / predicted[drawn].mean(axis=1)
        low, high = np.quantile(ratios, [0.025, 0.975])
        row |= {'predicted_m': float(predicted.mean()**0.5),
                'simulated_m': float(simulated.mean()**0.5),
                'ratio': float(simulated.mean() / predicted.mean()),
                'ratio_interval': [float(low), float(high)], 'fix': float(estimate.fix.mean())}
        text = (f'{row["predicted_m"]:.4f} | {row["simulated_m"]:.4f} | {row["ratio"]:.3f} '
                f'[{low:.3f}, {high:.3f}]')
        fixes = f'{100 * row["fix"]:.1f}'
    shown = ', '.join(f'{value:.4g}' for value in change.values()) or '-'
    print(f'| {assumed.multipath_to_los_db:g} | {name} | {shown} | {100 * row["valid"]:.0f} | '
          f'{text} | {fixes} |', flush=True)
    return row


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (CodebookError, ScenarioError)))
