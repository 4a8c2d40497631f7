"""The price of a wrong declaration: fields of the scenario that are wrong by a factor of two.

Problem: the estimator assumes the band plan, but the true value of one field is twice or half that
of the plan (a level: 3 dB higher or lower; the refractive index: 0.2 %). How large do the errors
become, and does `bounds.misspecified` predict them? The table compares the predicted root mean
squared error with that of the estimator `ml` on simulated signals, at the positions where the
prediction is `valid`. The 95 % interval of the ratio of the mean squared errors is from a
bootstrap over the positions. Signals without a fix are left out.
"""

import argparse
import dataclasses

import numpy as np
from parts.frame import CONFIG, Table, benchmark_parser, run, shown, write_results

from rhs_isac_ros.bounds import misspecified
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support.arguments import positive_int

LEVELS_DB = -25.0, -15.0, 0.0
FACTORS = {'delay_spread_s': 2.0, 'angular_spread_deg': 2.0, 'max_user_speed_mps': 2.0,
           'user_gain': 2.0, 'element_gain': 2.0, 'refractive_index': 1.002}
N_BOOTSTRAP = 1000


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('misspecified', __doc__, 60)
    parser.add_argument('--phases', type=positive_int, default=100,
                        help='phases at each position')
    options = parser.parse_args()
    codebook = Codebook.load(CONFIG / 'codebook_bandplan.yaml')
    table = Table('multipath [dB]', 'field', 'true value', 'valid [%]', 'predicted [m]',
                  'simulated [m]', 'ratio of the MSE', 'fixes [%]')
    rows = []
    for level in LEVELS_DB:
        assumed = dataclasses.replace(
            Scenario.from_yaml(CONFIG / 'bandplan.yaml'), multipath_to_los_db=level)
        changes = [('none', {})] + [
            (name, {name: getattr(assumed, name) * change}) for name, factor in FACTORS.items()
            for change in (factor, 1 / factor)]
        changes += [('multipath_to_los_db', {'multipath_to_los_db': level + change})
                    for change in (3.0, -3.0)]
        for name, change in changes:
            row = evaluate(assumed, name, change, codebook, options)
            rows.append(row)
            ratio = row.get('ratio') and [row['ratio'], *row['ratio_interval']]
            table.row(f'{level:g}', name, next((f'{value:.4g}' for value in change.values()), '-'),
                      shown(100 * row['valid'], 0), shown(row.get('predicted_m'), 4),
                      shown(row.get('simulated_m'), 4), shown(ratio, 3),
                      shown(row.get('fix') and 100 * row['fix'], 1))
    write_results(options.json, rows)


def evaluate(assumed: Scenario, name: str, change: dict[str, float], codebook: Codebook,
             options: argparse.Namespace) -> dict:
    """Predict and simulate the errors for one wrong field."""
    rng = np.random.default_rng(options.seed)
    positions = assumed.sample_positions(options.positions, rng)
    true = MeasurementModel(dataclasses.replace(assumed, **change), codebook)
    result = misspecified(MeasurementModel(assumed, codebook), true, positions)
    row = {'level_db': assumed.multipath_to_los_db, 'field': name, 'change': change,
           'valid': result.valid.mean()}
    if not result.valid.any():
        return row
    places = np.repeat(positions[result.valid], options.phases, axis=0)
    estimate = make_estimator('ml', assumed, codebook).estimate(true.sample(places, rng))
    squares = np.sum((estimate.mean - places)**2, axis=1).reshape(-1, options.phases)
    simulated, predicted = np.nanmean(squares, axis=1), result.mse_m2[result.valid]
    drawn = rng.integers(len(simulated), size=(N_BOOTSTRAP, len(simulated)))
    ratios = simulated[drawn].mean(axis=1) / predicted[drawn].mean(axis=1)
    return row | {
        'predicted_m': predicted.mean()**0.5, 'simulated_m': simulated.mean()**0.5,
        'ratio': simulated.mean() / predicted.mean(),
        'ratio_interval': np.quantile(ratios, [0.025, 0.975]).tolist(),
        'fix': estimate.fix.mean()}


if __name__ == '__main__':
    run(main)
