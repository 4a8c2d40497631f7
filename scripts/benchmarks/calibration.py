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

import argparse
import dataclasses
import time
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
    parser = frame.benchmark_parser('calibration', __doc__, 600)
    parser.add_argument('--surfaces', type=positive_int, default=6, help='number of surfaces')
    parser.add_argument('--silent', action='store_true', help='calibrate with the default prior')
    options = parser.parse_args()
    scenario, codebook = Scenario(), Codebook.default()
    print(f'{options.surfaces} surfaces, {PILOTS} pilots each, {options.positions} fresh '
          f'positions, seed {options.seed}\n')
    table = frame.Table(['surface', 'knowledge'], {
        'no fix [%]': ('no_fix_share', 1), 'MSE [m²]': ('mse_m2', 3), 'to exact': ('to_exact', 3),
        'to undamaged': ('to_undamaged', 3), 'in the 95 % region [%]': ('covered_share', 1)})
    rows = []
    for name, changes in DEVIATIONS.items():
        declared = dataclasses.replace(scenario, **changes)
        results, took_s, found = measure(declared, scenario, codebook, options)
        references = {f'to_{kind}': squares_of(results[kind]) for kind in ('exact', 'undamaged')}
        for knowledge, fixes in results.items():
            rows.append({'surface': name, 'knowledge': knowledge,
                         **table.row(name, knowledge, **figures(fixes, references))})
        print(f'{name}: {found}; a calibration takes {took_s:.1f} s', flush=True)
    frame.write_results(options.json, rows)


def measure(declared: Scenario, silent: Scenario, codebook: Codebook,
            options: argparse.Namespace) -> tuple[dict[str, list[frame.Fixes]], float, str]:
    """Measure all surfaces with each kind of knowledge.

    Returns the fixes of each surface by knowledge; the duration of a calibration [s]; and how many
    failed elements were found.
    """
    positions = silent.sample_positions(
        options.positions, streams.generator(options.seed, streams.HELD_OUT))
    found: dict[str, list[frame.Fixes]] = {}
    counts, elapsed_s = np.zeros(3, int), 0.0
    for index in range(options.surfaces):
        rng = streams.generator(options.seed, streams.SURFACE, index)
        surface = draw_surface(declared, rng)
        model = MeasurementModel(silent, codebook, surface)
        places = silent.sample_positions(PILOTS, rng)
        pilots = Pilots(codebook, places, model.sample(places, rng))
        begin_s = time.perf_counter()
        calibration = calibrate(silent if options.silent else declared, [pilots])
        elapsed_s += time.perf_counter() - begin_s
        counts += failures(surface, calibration)
        received = model.sample(positions, rng)
        undamaged = MeasurementModel(silent, codebook).sample(positions, rng)
        cases: dict[str, tuple[Scenario, Any, np.ndarray]] = {
            'silent': (silent, None, received),
            'after': (silent, calibration.surface, received),
            'exact': (silent, surface, received), 'undamaged': (silent, None, undamaged)}
        for name, (scenario, known, signals) in cases.items():
            estimator = make_estimator('bayes', scenario, codebook, surface=known)
            fixes = frame.Fixes.of(estimator.estimate(signals), positions)
            found.setdefault(name, []).append(fixes)
    return found, elapsed_s / options.surfaces, (
        f'{counts[0]} of {counts[1]} failed elements found, {counts[2]} false')


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
