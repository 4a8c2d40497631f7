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

import argparse
import copy
import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
from parts import frame
from parts.exhaustive_posterior import exhaustive_posterior, posterior_with_truth

from rhs_isac_ros.codebook import Codebook, random_codebook
from rhs_isac_ros.experiments.resampling import replicate, share_percent
from rhs_isac_ros.model import ElementErrors, MeasurementModel, Scenario
from rhs_isac_ros.model.impairments import draw_impairments
from rhs_isac_ros.positioning import Estimate, make_estimator
from rhs_isac_ros.positioning.diagnosis import WINDOW, InnovationTest
from rhs_isac_ros.positioning.failures import can_enumerate
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import integer, positive_int

# Positions that share a surface with its errors and failures.
PER_SURFACE = 5
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


class Measurement:
    """The rows of the table, which are printed and written as soon as they are known."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self.rows: list[dict[str, Any]] = []
        print(f'{options.positions} positions, seed {options.seed}, estimator '
              f'{options.estimator}\n')
        self._table = frame.Table(
            'signals from', 'scenario', 'no fix [%]', 'MSE [m²]', 'predicted',
            'in the 95 % region [%]', 'median residual', 'warning', 'warned [%]', 'time [ms]')

    def wants(self, name: str) -> bool:
        """Return whether a row was requested."""
        return not self._options.only or any(text in name for text in self._options.only)

    def add_inside(self, name: str, silent: Scenario, codebook: Codebook,
                   changes: dict[str, Any]) -> None:
        """Measure users inside the region, with a silent and a declaring scenario."""
        options, declared = self._options, dataclasses.replace(silent, **changes)
        positions, received, surfaces = draw(declared, codebook, options)
        if changes and not options.pairs:
            self._add(name, 'silent', silent, codebook, positions, received)
        estimate, row = self._add(name, 'declared', declared, codebook, positions, received)
        if n := options.reference:
            row['mse_to_reference'] = ratio = ratio_to_reference(
                reference_means(declared, codebook, positions[:n], received[:n], surfaces[:n],
                                options.log2_points), estimate, positions[:n])
            row['reference_positions'] = n
            self._table.row('', 'ratio to the posterior', '', frame.shown(ratio, 3), *6 * [''])

    def add_outside(self, scenario: Scenario, codebook: Codebook) -> None:
        """Measure users outside of the region."""
        rng = streams.generator(self._options.seed, streams.HELD_OUT)
        model, n = MeasurementModel(scenario, codebook), self._options.positions
        places = {f'a user at {name}': np.tile(place, (n, 1)) for name, place in OUTSIDE.items()}
        places[f'a shell {SHELL_M[0]:g} m to {SHELL_M[1]:g} m outside'] = shell(scenario, n, rng)
        for name, positions in places.items():
            if self.wants(name):
                self._add(name, 'silent', scenario, codebook, positions,
                          model.sample(positions, rng))

    def _add(self, name: str, kind: str, scenario: Scenario, codebook: Codebook,
             positions: np.ndarray, received: np.ndarray) -> tuple[Estimate, dict[str, Any]]:
        options = self._options
        estimate, times_s = frame.estimate_singly(make_estimator(
            options.estimator, scenario, codebook, reject_outside=not options.inside), received)
        row = {'signals': name, 'scenario': kind,
               **figures(estimate, positions, options.windows),
               'time_ms': 1e3 * float(np.median(times_s[:, 1]))}
        after = row['warns_after']
        self._table.row(
            name, kind, frame.shown(row['no_fix_share'], 1), frame.shown(row['mse_m2'], 2),
            frame.shown(row['predicted_mse_m2'], 2), frame.shown(row['covered_share'], 1),
            frame.shown(row['median_residual'], 0), f'after {after} phases' if after else 'none',
            frame.shown(row['warned_share'], 0), frame.shown(row['time_ms'], 1))
        self.rows.append(row)
        return estimate, row


def main() -> None:
    """Run the benchmark."""
    options = parse_options()
    base, codebook = frame.scenario_of(options.config), Codebook.load(options.codebook)
    measurement = Measurement(options)
    if options.pairs:
        for names in (*itertools.combinations(DECLARATIONS, 2), *TRIPLES):
            changes = {key: value for name in names for key, value in DECLARATIONS[name].items()}
            if len(changes) == len(names) and measurement.wants(' + '.join(names)):
                measurement.add_inside(' + '.join(names), base, codebook, changes)
                rows = [pair(row) for row in measurement.rows]
                frame.write_results(options.json, {'pairs': rows})
        return
    four = Scenario(center_frequencies_hz=FOUR_BANDS_HZ)
    cases = [(name, base, codebook, changes) for name, changes in DEVIATIONS.items()]
    cases.append((FOUR_BANDS, four, random_codebook(
        four, streams.generator(options.seed, streams.START)),
        {'band_phase_std_rad': UNIFORM_RAD}))
    for case in cases:
        if measurement.wants(case[0]):
            measurement.add_inside(*case)
            # All rows take long.
            frame.write_results(options.json, measurement.rows)
    measurement.add_outside(base, codebook)
    frame.write_results(options.json, measurement.rows)


def parse_options() -> argparse.Namespace:
    """Parse the command line."""
    parser = frame.benchmark_parser('robustness', __doc__, 600)
    add = parser.add_argument
    add('--estimator', choices=['bayes', 'ml'], default='bayes', help='estimator')
    add('--inside', action='store_true',
        help='estimate without reject_outside, as if no user were outside of the region')
    add('--config', type=Path, help='scenario file; frame.Table I if omitted')
    add('--codebook', type=Path, default=frame.CONFIG / 'codebook.yaml', help='codebook file')
    add('--only', action='append', default=[], metavar='TEXT',
        help='only rows whose name contains the text; may be repeated')
    add('--reference', type=integer(0), default=0, metavar='N',
        help='compare the first N positions with the exhaustive posterior; 0 to omit')
    add('--log2-points', type=positive_int, default=18,
        help='binary logarithm of the number of points of that posterior, of which there are two')
    add('--windows', type=positive_int, default=200,
        help='number of windows to which the monitor of the residuals is applied')
    add('--pairs', action='store_true', help='all pairs of declarations, and some triples')
    return parser.parse_args()


def pair(row: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a combination of declarations."""
    return {'declared': row['signals'].split(' + '), 'in_region': row['covered_share'],
            'no_fix': row['no_fix_share'], 'mse_m2': row['mse_m2'],
            'mse_ratio': row.get('mse_to_reference'), 'time_ms': row['time_ms']}


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
    fixes, n = frame.Fixes.of(estimate, positions), len(positions)
    n_fixes, predicted = len(fixes.squared), np.trace(estimate.covariance, axis1=1, axis2=2)
    # The covariance of users who may be outside includes the positions there.
    certain = fixes.fix & np.isfinite(estimate.expected_residual)
    residuals = np.stack([estimate.residual, estimate.expected_residual], axis=1)
    order = np.random.default_rng(0).integers(n, size=(n_windows, WINDOW))
    n_warned = sum(first_warning(residuals[window]) is not None for window in order)
    return {
        'positions': n, 'no_fix': n - n_fixes, 'no_fix_share': fixes.without_fix,
        'reasons': {text: sum(reason.startswith(text) for reason in estimate.reason)
                    for text in ('position', 'residual', 'energy')},
        'mse_m2': frame.mean_interval(fixes.squared, np.flatnonzero(fixes.fix) // PER_SURFACE),
        'covered_share': fixes.covered,
        'missed_share': share_percent(n_fixes - int(fixes.inside.sum()), n),
        'predicted_mse_m2': float(predicted[certain].mean()) if certain.any() else None,
        'possibly_outside_share': share_percent(n_fixes - int(certain.sum()), n),
        'median_residual': float(np.median(estimate.residual[fixes.fix])) if n_fixes else None,
        'warns_after': first_warning(residuals),
        'warned_share': share_percent(n_warned, n_windows)}


def first_warning(residuals: np.ndarray) -> int | None:
    """Return the number of phases until the monitor of the positioner warns, None without one."""
    monitor = InnovationTest()
    for count, (energy, expected) in enumerate(residuals.tolist(), 1):
        monitor.add(energy, expected)
        if monitor.drifts:
            return count
    return None


def reference_means(
        scenario: Scenario, codebook: Codebook, positions: np.ndarray, received: np.ndarray,
        surfaces: list[ElementErrors | None], log2_points: int) -> np.ndarray:
    """Compute the means of the reference from two sets of points, float64 [2, N, 3] [m]."""
    if can_enumerate(scenario):
        known = [surface for surface in surfaces if surface]
        return np.tile(
            posterior_with_truth(scenario, codebook, received, known, positions).mean, (2, 1, 1))
    return np.stack([
        exhaustive_posterior(scenario, codebook, received, log2_points, seed=seed).mean
        for seed in range(2)])


def ratio_to_reference(reference: np.ndarray, estimate: Estimate, positions: np.ndarray
                       ) -> frame.Interval:
    """Compare the squared errors of the first fixes with those of the exhaustive posterior.

    The mean of finitely many points has an additional error. It is independent between the two
    sets of points, so that the product of their errors has the expectation without it. The
    interval resamples surfaces, because the errors at positions that share one are not
    independent.
    """
    n = len(positions)
    fix = estimate.fix[:n]
    own = np.sum((estimate.mean[:n] - positions)[fix]**2, axis=1)
    best = np.sum(np.prod(reference - positions, axis=0)[fix], axis=1)
    surface = np.flatnonzero(fix) // PER_SURFACE
    found, exact = (replicate(np.bincount(surface, errors)[None], 0)[0] for errors in (own, best))
    value, low, high = found.reduction_from(exact)
    return 1 - value / 100, 1 - high / 100, 1 - low / 100


if __name__ == '__main__':
    frame.run(main)
