"""Errors with wrong declarations: fields of the scenario that are wrong by a factor of two.

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
from parts import frame

from rhs_isac_ros.bounds import misspecified
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import make_estimator

LEVELS_DB = -25.0, -15.0, 0.0
FACTORS = {'delay_spread_s': 2.0, 'angular_spread_deg': 2.0, 'max_user_speed_mps': 2.0,
           'user_gain': 2.0, 'element_gain': 2.0, 'refractive_index': 1.002}
# Shots at each position.
SHOTS = 100
N_BOOTSTRAP = 1000


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser('misspecified', __doc__, 60).parse_args()
    bandplan, codebook = frame.system('bandplan')
    table = frame.Table(['multipath [dB]', 'field', 'true value'], {
        'valid [%]': ('valid', 0), 'predicted [m]': ('predicted_m', 4),
        'simulated [m]': ('simulated_m', 4), 'ratio of the MSE': ('ratio', 3),
        'fixes [%]': ('fix', 1)})
    rows = []
    for level in LEVELS_DB:
        assumed = dataclasses.replace(bandplan, multipath_to_los_db=level)
        changes = [('none', {})] + [
            (name, {name: getattr(assumed, name) * change}) for name, factor in FACTORS.items()
            for change in (factor, 1 / factor)]
        changes += [('multipath_to_los_db', {'multipath_to_los_db': level + change})
                    for change in (3.0, -3.0)]
        for name, change in changes:
            value = next((f'{value:.4g}' for value in change.values()), '-')
            rows.append({'level_db': level, 'field': name, 'change': change, **table.row(
                f'{level:g}', name, value, **evaluate(assumed, change, codebook, options))})
    frame.write_results(options.json, rows)


def evaluate(assumed: Scenario, change: dict[str, float], codebook: Codebook,
             options: argparse.Namespace) -> dict:
    """Predict and simulate the errors for one wrong field; shares are in per cent."""
    rng = np.random.default_rng(options.seed)
    positions = assumed.sample_positions(options.positions, rng)
    true = MeasurementModel(dataclasses.replace(assumed, **change), codebook)
    result = misspecified(MeasurementModel(assumed, codebook), true, positions)
    row = {'valid': 100 * result.valid.mean()}
    if not result.valid.any():
        return row
    places = np.repeat(positions[result.valid], SHOTS, axis=0)
    estimate = make_estimator('ml', assumed, codebook).estimate(true.sample(places, rng))
    squares = np.sum((estimate.mean - places)**2, axis=1).reshape(-1, SHOTS)
    simulated, predicted = np.nanmean(squares, axis=1), result.mse_m2[result.valid]
    drawn = rng.integers(len(simulated), size=(N_BOOTSTRAP, len(simulated)))
    ratios = simulated[drawn].mean(axis=1) / predicted[drawn].mean(axis=1)
    return row | {
        'predicted_m': predicted.mean()**0.5, 'simulated_m': simulated.mean()**0.5,
        'ratio': [simulated.mean() / predicted.mean(), *np.quantile(ratios, [0.025, 0.975])],
        'fix': 100 * estimate.fix.mean()}


if __name__ == '__main__':
    frame.run(main)
