"""Positioning when the signals deviate from the model: errors, coverage, fixes and warnings.

Problem: real signals deviate from the model. How large are the errors then, do the 95 % regions
contain the user, how many phases have no fix, and would the residuals cause a warning? Each
deviation is measured twice: with a scenario that omits it, and with a scenario that declares it,
as an uncertainty or with its true value. Users outside the region should have no fix.

The 95 % region of an estimate is the ellipsoid of its covariance that contains 95 % of a Gaussian.
Brackets contain 95 % intervals: Wilson's for shares, and for mean squared errors those of a
percentile bootstrap over surfaces, each of which serves five positions. The last column is the
share of windows, random draws of phases, in which the monitor of the residuals warns. The
predicted error excludes fixes whose user may be outside the region.

The time is the median of the CPU time of an estimate, on one core.

With --pairs, the rows are all pairs of declarations instead, and some triples. Its JSON file
contains a list `pairs` with the declarations, the shares in the region and without a fix [%], the
mean squared error, and its ratio to that of the posterior; each figure is [value, low, high].

With --reference N, the first N positions of each declared row are compared in pairs with the
exhaustive posterior of the declared model, in which element errors have their covariance at every
point. Failed elements permit no such sum: their reference is the mixture of the estimator with the
true set and position among its hypotheses, so the ratio covers only what the search misses.
"""

import os

# One thread, as in the positioner node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import copy
import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any

import numpy as np
from parts.command import benchmark_parser, write_results
from parts.posterior_ratio import ratio_to_reference, reference_means
from parts.warning_windows import warnings
from scipy.special import chdtri

from rhs_isac_ros.codebook import Codebook, random_codebook
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import ElementErrors, MeasurementModel, Scenario
from rhs_isac_ros.model.impairments import draw_impairments
from rhs_isac_ros.positioning import Estimate, Estimator, make_estimator
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import positive_int

DEFAULT_CODEBOOK = Path(__file__).parents[2] / 'config' / 'codebook.yaml'
# Squared Mahalanobis radius of the 95 % region.
REGION_RADIUS = float(chdtri(3, 0.05))
# Positions that share a surface with its errors and failures.
PER_SURFACE = 5
RESAMPLES = 2000
SHELL_M = (0.5, 20.0)
FOUR_BANDS_HZ = (2.5e9, 2.7e9, 3.1e9, 3.6e9)
UNIFORM_RAD = 2 * np.pi

# The deviations: changes of the scenario that declare each of them.
DEVIATIONS: dict[str, dict[str, Any]] = {
    'none': {},
    '1 % of elements stuck': {'failed_element_share': 0.01},
    'element coefficients off by 1 % rms': {'element_error_rms': 0.01},
    'element coefficients off by 3 % rms': {'element_error_rms': 0.03},
    'user power off by 1 dB rms': {'user_gain_std_db': 1.0},
    'user power off by 3 dB rms': {'user_gain_std_db': 3.0},
    'refractive index 2.11 for 2.10': {'refractive_index': 2.11},
    'delay spread 0.1 us for 0.5': {'delay_spread_s': 0.1e-6},
    'angular spread 15 deg for 10': {'angular_spread_deg': 15.0},
    'multipath power twice the assumed': {'multipath_to_los_db': 10 * np.log10(2)},
    'carrier offset 1 kHz rms': {'carrier_offset_std_hz': 1e3},
    'carrier offset 3 kHz rms': {'carrier_offset_std_hz': 3e3},
    'random phase per band': {'band_phase_std_rad': UNIFORM_RAD},
}
# Declarations that --pairs combines, and the triples that it adds. Uniform phases include others.
DECLARATIONS: dict[str, dict[str, Any]] = {
    'gain': {'user_gain_std_db': 1.0}, 'phase': {'phase_std_rad': 0.3},
    'band phase': {'band_phase_std_rad': 0.2}, 'timing': {'timing_std_s': 1e-7},
    'carrier': {'carrier_offset_std_hz': 300.0}, 'elements': {'element_error_rms': 0.03},
    'failed': {'failed_element_share': 0.01},
    'uniform band phase': {'band_phase_std_rad': UNIFORM_RAD},
}
TRIPLES = (('gain', 'timing', 'failed'), ('phase', 'carrier', 'elements'),
           ('band phase', 'elements', 'failed'))
FOUR_BANDS = 'four unequally spaced bands, random phase per band'
OUTSIDE = {'x = 18 m': (18.0, 0.0, 0.0), 'x = 30 m': (30.0, 0.0, 0.0),
           'y = 6 m': (10.0, 6.0, 0.0), 'z = 3 m': (10.0, 0.0, 3.0)}


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('robustness', __doc__)
    add = parser.add_argument
    add('--positions', type=positive_int, default=600, help='number of positions of each row')
    add('--estimator', choices=['bayes', 'ml'], default='bayes', help='estimator')
    add('--inside', action='store_true',
        help='estimate without reject_outside, as if no user were outside of the region')
    add('--config', type=Path, help='scenario file; Table I if omitted')
    add('--codebook', type=Path, default=DEFAULT_CODEBOOK, help='codebook file')
    add('--only', action='append', default=[], metavar='TEXT',
        help='only rows whose name contains the text; may be repeated')
    add('--reference', type=int, default=0, metavar='N',
        help='compare the first N positions with the exhaustive posterior; 0 to omit')
    add('--log2-points', type=positive_int, default=18,
        help='binary logarithm of the number of points of that posterior, of which there are two')
    add('--windows', type=positive_int, default=200,
        help='number of windows to which the monitor of the residuals is applied')
    add('--pairs', action='store_true', help='all pairs of declarations, and some triples')
    options = parser.parse_args()
    print(f'{options.positions} positions, seed {options.seed}, estimator {options.estimator}\n')
    print('| signals from | scenario | no fix [%] | MSE [m^2] | predicted | in the 95 % region '
          '[%] | median residual | warning | warned [%] | time [ms] |\n'
          '|---|---|---|---|---|---|---|---|---|---|')
    base = Scenario.from_yaml(options.config) if options.config else Scenario()
    codebook = Codebook.load(options.codebook)
    four = Scenario(center_frequencies_hz=FOUR_BANDS_HZ)
    cases = [(name, base, codebook, changes) for name, changes in DEVIATIONS.items()]
    cases.append((FOUR_BANDS, four, random_codebook(
        four, streams.generator(options.seed, streams.START)),
        {'band_phase_std_rad': UNIFORM_RAD}))
    rows = []
    if options.pairs:
        for names in (*itertools.combinations(DECLARATIONS, 2), *TRIPLES):
            changes = {key: value for name in names for key, value in DECLARATIONS[name].items()}
            if len(changes) == len(names) and wanted(' + '.join(names), options):
                rows += inside_rows(' + '.join(names), base, codebook, changes, options)
                write_results(options.json, {'pairs': [pair(row) for row in rows]})
        return
    for name, silent, its_codebook, changes in cases:
        if wanted(name, options):
            rows += inside_rows(name, silent, its_codebook, changes, options)
            # All rows take long.
            write_results(options.json, rows)
    rows += outside_rows(base, codebook, options)
    write_results(options.json, rows)


def pair(row: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a combination of declarations."""
    return {'declared': row['signals'].split(' + '), 'in_region': row['covered_share'],
            'no_fix': row['no_fix_share'], 'mse_m2': row['mse_m2'],
            'mse_ratio': row.get('mse_to_reference'), 'time_ms': row['time_ms']}


def wanted(name: str, options: argparse.Namespace) -> bool:
    """Return whether a row was requested."""
    return not options.only or any(text in name for text in options.only)


def inside_rows(name: str, silent: Scenario, codebook: Codebook, changes: dict[str, Any],
                options: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure users inside the region, with a silent and a declaring scenario."""
    declared = dataclasses.replace(silent, **changes)
    positions, received, surfaces = draw(declared, codebook, options)
    rows = []
    for kind, scenario in (('silent', silent), ('declared', declared)):
        if kind == 'silent' and (not changes or options.pairs):
            continue
        estimator = estimator_for(scenario, codebook, options)
        estimate, time_ms = estimate_timed(estimator, received)
        row = {'signals': name, 'scenario': kind, **figures(estimate, positions, options.windows),
               'time_ms': time_ms}
        if options.reference and kind == 'declared':
            n = options.reference
            reference = reference_means(
                scenario, codebook, positions[:n], received[:n], surfaces[:n],
                options.log2_points)
            row |= ratio_to_reference(
                reference, estimate, positions[:n], np.arange(n) // PER_SURFACE)
        rows.append(report(row))
    return rows


def outside_rows(scenario: Scenario, codebook: Codebook,
                 options: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure users outside of the region."""
    estimator = estimator_for(scenario, codebook, options)
    rng = streams.generator(options.seed, streams.HELD_OUT)
    model, rows = MeasurementModel(scenario, codebook), []
    places = {f'a user at {name}': np.tile(place, (options.positions, 1))
              for name, place in OUTSIDE.items()}
    places[f'a shell {SHELL_M[0]:g} m to {SHELL_M[1]:g} m outside'] = shell(
        scenario, options.positions, rng)
    for name, positions in places.items():
        if wanted(name, options):
            received = model.sample(positions, rng)
            estimate, time_ms = estimate_timed(estimator, received)
            rows.append(report({
                'signals': name, 'scenario': 'silent',
                **figures(estimate, positions, options.windows), 'time_ms': time_ms}))
    return rows


def estimator_for(
        scenario: Scenario, codebook: Codebook, options: argparse.Namespace) -> Estimator:
    """Make the estimator of a row."""
    return make_estimator(
        options.estimator, scenario, codebook, reject_outside=not options.inside)


def estimate_timed(estimator: Estimator, received: np.ndarray) -> tuple[Estimate, float]:
    """Estimate positions one by one; also return the median CPU time of an estimate [ms]."""
    estimates, times_s = [], []
    for signals in received:
        start_s = time.process_time()
        estimates.append(estimator.estimate(signals))
        times_s.append(time.process_time() - start_s)
    fields = [np.stack([getattr(one, name) for one in estimates])
              for name in ('mean', 'covariance', 'residual', 'expected_residual')]
    reasons = tuple(str(one.reason) for one in estimates)
    return Estimate(fields[0], fields[1], reasons, *fields[2:]), 1e3 * float(np.median(times_s))


def draw(scenario: Scenario, codebook: Codebook, options: argparse.Namespace
         ) -> tuple[np.ndarray, np.ndarray, list[ElementErrors | None]]:
    """Draw positions, signals and surfaces; every few positions have another surface."""
    model = MeasurementModel(scenario, codebook)
    positions, received = [], []
    surfaces: list[ElementErrors | None] = []
    for group in range(-(-options.positions // PER_SURFACE)):
        rng = streams.generator(options.seed, streams.PHASES, group)
        positions.append(scenario.sample_positions(PER_SURFACE, rng))
        # The model draws the same surface from a generator in the same state.
        surface, _ = draw_impairments(scenario, PER_SURFACE, copy.deepcopy(rng))
        surfaces += PER_SURFACE * [surface]
        received.append(model.sample(positions[-1], rng))
    n = options.positions
    return np.concatenate(positions)[:n], np.concatenate(received)[:n], surfaces[:n]


def shell(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw positions uniformly around the region, in front of the surface, [n, 3] [m]."""
    low, high = scenario.roi_bounds_m
    begin = np.maximum(low - SHELL_M[1], [0.0, -np.inf, -np.inf])
    found = np.empty((0, 3))
    while len(found) < n:
        positions = rng.uniform(begin, high + SHELL_M[1], (4 * n, 3))
        distance = np.linalg.norm(positions - np.clip(positions, low, high), axis=1)
        found = np.vstack(
            [found, positions[(distance >= SHELL_M[0]) & (distance <= SHELL_M[1])]])
    return found[:n]


def figures(estimate: Estimate, positions: np.ndarray, n_windows: int) -> dict[str, Any]:
    """Compute the figures of a row."""
    fix, n = estimate.fix, len(positions)
    errors, covariance = (estimate.mean - positions)[fix], estimate.covariance[fix]
    squares = np.sum(errors**2, axis=1)
    normalised = np.sum(
        errors * np.linalg.solve(covariance, errors[..., None])[..., 0], axis=1)
    covered = int(np.sum(normalised <= REGION_RADIUS))
    n_fixes = len(errors)
    residual = np.asarray(estimate.residual)[fix]
    # The covariance of users who may be outside includes the positions there.
    certain = np.isfinite(np.asarray(estimate.expected_residual)[fix])
    return {
        'positions': n, 'no_fix': n - n_fixes, 'no_fix_share': share_percent(n - n_fixes, n),
        'reasons': {text: sum(reason.startswith(text) for reason in estimate.reason)
                    for text in ('position', 'residual', 'energy')},
        'mse_m2': mean_interval(squares, np.flatnonzero(fix) // PER_SURFACE),
        'covered_share': share_percent(covered, n_fixes) if n_fixes else None,
        'missed_share': share_percent(n_fixes - covered, n),
        'predicted_mse_m2': float(np.trace(covariance, axis1=1, axis2=2)[certain].mean())
        if certain.any() else None,
        'possibly_outside_share': share_percent(n_fixes - int(certain.sum()), n),
        'median_residual': float(np.median(residual)) if n_fixes else None,
        **warnings(estimate, n_windows),
    }


def mean_interval(samples: np.ndarray, surface: np.ndarray) -> tuple[float, float, float] | None:
    """Return a mean with its 95 % interval by the percentile bootstrap over surfaces [N]."""
    if not len(samples):
        return None
    _, index = np.unique(surface, return_inverse=True)
    sums, counts = np.bincount(index, samples), np.bincount(index)
    picks = np.random.default_rng(0).integers(len(sums), size=(RESAMPLES, len(sums)))
    means = sums[picks].sum(axis=1) / counts[picks].sum(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(samples.mean()), float(low), float(high)


def report(row: dict[str, Any]) -> dict[str, Any]:
    """Print a row as a line of the table."""
    def interval(value: tuple[float, float, float] | None, digits: int) -> str:
        if value is None:
            return '-'
        return f'{value[0]:.{digits}f} [{value[1]:.{digits}f}, {value[2]:.{digits}f}]'

    def number(value: float | None, digits: int) -> str:
        return '-' if value is None else f'{value:.{digits}f}'

    warning = f'after {row["warns_after"]} phases' if row['warns_after'] else 'none'
    print(f'| {row["signals"]} | {row["scenario"]} | {interval(row["no_fix_share"], 1)} | '
          f'{interval(row["mse_m2"], 2)} | {number(row["predicted_mse_m2"], 2)} | '
          f'{interval(row["covered_share"], 1)} | {number(row["median_residual"], 0)} | '
          f'{warning} | {interval(row["warned_share"], 0)} | {row["time_ms"]:.1f} |', flush=True)
    if 'mse_to_reference' in row:
        print(f'|  | ratio to the posterior | | {interval(row["mse_to_reference"], 3)} '
              '| | | | | | |', flush=True)
    return row


if __name__ == '__main__':
    main()
