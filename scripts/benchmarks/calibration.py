"""Positioning with a surface whose errors a calibration has estimated.

Problem: coefficients of the elements deviate and some elements have failed. A reference user sends
pilots at known positions, and the calibration estimates the surface from the received signals. How
large are the errors for other users after the calibration, compared with the errors before it, and
with exact knowledge of the surface? The benchmark `robustness` reports the errors with a scenario
that declares the deviations.

Each surface has its own pilots; the positions of the other users are the same for all surfaces.
Brackets contain 95 % intervals: for mean squared errors of fixes and their ratios, of a bootstrap
over surfaces and positions together; for shares, Wilson's. The calibration assumes the declared
distribution of surfaces, or with --silent the default distribution.
"""

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from parts import frame

from rhs_isac_ros.calibration import Calibration, Pilots, calibrate
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments.resampling import replicate, share_percent
from rhs_isac_ros.model import ElementErrors, MeasurementModel, Scenario, draw_surface
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import positive_int

DEVIATIONS: dict[str, dict[str, float]] = {
    '3 % rms, 2 % failed': {'element_error_rms': 0.03, 'failed_element_share': 0.02},
    '1 % stuck': {'failed_element_share': 0.01},
}
# Pilots of each surface.
PILOTS = 200


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('calibration', __doc__, 600, has_jobs=True)
    parser.add_argument('--surfaces', type=positive_int, default=6, help='number of surfaces')
    parser.add_argument('--silent', action='store_true', help='calibrate with the default prior')
    options = parser.parse_args()
    found = frame.measured(options, 'calibration', measure, {
        f'{name}, {index}': {
            'changes': changes, 'index': index, 'n': options.positions, 'seed': options.seed,
            'silent': options.silent}
        for name, changes in DEVIATIONS.items() for index in range(options.surfaces)})
    print(f'{options.surfaces} surfaces, {PILOTS} pilots each, {options.positions} fresh '
          f'positions, seed {options.seed}\n')
    table = frame.Table(['surface', 'knowledge'], {
        'no fix [%]': ('no_fix_share', 1), 'MSE [m²]': ('mse_m2', 3), 'to exact': ('to_exact', 3),
        'to undamaged': ('to_undamaged', 3), 'in the 95 % region [%]': ('covered_share', 1)})
    rows = []
    for name in DEVIATIONS:
        surfaces = [found[f'{name}, {index}'] for index in range(options.surfaces)]
        results = {knowledge: [frame.Fixes(*map(np.array, one['fixes'][knowledge]))
                               for one in surfaces] for knowledge in surfaces[0]['fixes']}
        references = {f'to_{kind}': squares_of(results[kind]) for kind in ('exact', 'undamaged')}
        for knowledge, fixes in results.items():
            rows.append({'surface': name, 'knowledge': knowledge,
                         **table.row(name, knowledge, **figures(fixes, references))})
        n_found, n_failed, n_false = np.sum([one['failures'] for one in surfaces], axis=0)
        took_s = np.mean([one['took_s'] for one in surfaces])
        print(f'{name}: {n_found} of {n_failed} failed elements found, {n_false} false; '
              f'a calibration takes {took_s:.1f} s', flush=True)
    frame.write_results(options.json, rows)


def measure(changes: Mapping[str, float], index: int, n: int, seed: int, silent: bool
            ) -> Mapping[str, Any]:
    """Measure a surface with each kind of knowledge.

    Returns the fixes by knowledge, the counts of failed elements, and the duration of the
    calibration [s].
    """
    scenario, codebook = Scenario(), Codebook.default()
    declared = dataclasses.replace(scenario, **changes)
    positions = scenario.sample_positions(n, streams.generator(seed, streams.HELD_OUT))
    rng = streams.generator(seed, streams.SURFACE, index)
    surface = draw_surface(declared, rng)
    model = MeasurementModel(scenario, codebook, surface)
    places = scenario.sample_positions(PILOTS, rng)
    pilots = Pilots(codebook, places, model.sample(places, rng))
    begin_s = time.perf_counter()
    calibration = calibrate(scenario if silent else declared, [pilots])
    took_s = time.perf_counter() - begin_s
    received = model.sample(positions, rng)
    undamaged = MeasurementModel(scenario, codebook).sample(positions, rng)
    cases: dict[str, tuple[Any, np.ndarray]] = {
        'silent': (None, received), 'after': (calibration.surface, received),
        'exact': (surface, received), 'undamaged': (None, undamaged)}
    return {'took_s': took_s, 'failures': failures(surface, calibration), 'fixes': {
        name: list(frame.Fixes.of(make_estimator(
            'bayes', scenario, codebook, surface=known).estimate(signals), positions))
        for name, (known, signals) in cases.items()}}


def failures(surface: ElementErrors, calibration: Calibration) -> np.ndarray:
    """Count failed elements that were found, all of them, and false ones [3]."""
    true, found = ~np.isnan(surface.stuck), calibration.surface.failed
    return np.array([np.sum(true & found), np.sum(true), np.sum(found & ~true)])


def squares_of(surfaces: list[frame.Fixes]) -> np.ndarray:
    """Return squared errors [surfaces, positions], NaN without a fix."""
    squares = np.full((len(surfaces), len(surfaces[0].fix)), np.nan)
    for row, fixes in zip(squares, surfaces, strict=True):
        row[fixes.fix] = fixes.squared
    return squares


def figures(surfaces: list[frame.Fixes], references: dict[str, np.ndarray]) -> dict[str, Any]:
    """Compute the figures of a row, with ratios to the squared errors of references."""
    squares = squares_of(surfaces)
    n_fixes = int(np.sum(np.isfinite(squares)))
    row: dict[str, Any] = {'no_fix_share': share_percent(squares.size - n_fixes, squares.size)}
    # Few fixes are not a sample of all positions.
    if n_fixes > 0.5 * squares.size:
        covered = sum(int(one.inside.sum()) for one in surfaces)
        row |= {'mse_m2': replicate(squares, 0)[0].interval(),
                **{name: frame.ratio(squares, other) for name, other in references.items()},
                'covered_share': share_percent(covered, n_fixes)}
    return row


if __name__ == '__main__':
    frame.run(main)
