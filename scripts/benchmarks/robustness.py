"""Positioning when the signals deviate from the model: errors, coverage, fixes and warnings.

Problem: real signals deviate from the model. How large are the errors then, do the 95 % regions
contain the user, how many shots have no fix, and would the residuals cause a warning? Each
deviation is measured twice: with a scenario that omits it, and with a scenario that declares it,
as an uncertainty or with its true value. Users outside the region should have no fix.

The 95 % region of an estimate is the ellipsoid of its covariance that contains 95 % of a Gaussian.
Brackets contain 95 % intervals: Wilson's for shares, and for mean squared errors those of a
percentile bootstrap over surfaces, each of which serves five positions. Warnings are those of the
monitor of the residuals, in windows of randomly drawn shots. The predicted error excludes fixes
whose user may be outside the region. Times are medians of the CPU time of an estimate.

With --pairs, the rows are all pairs of declarations instead, and some triples.

With --reference N, the first N positions of each declared row are compared in pairs with the
exhaustive posterior of the declared model, in which element errors have their covariance at every
point. Failed elements permit no such sum.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from parts import frame
from parts.exhaustive_posterior import exhaustive_posterior

from rhs_isac_ros.codebook import Codebook, random_codebook
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import Estimate, make_estimator
from rhs_isac_ros.positioning.diagnosis import WINDOW, InnovationTest
from rhs_isac_ros.positioning.failures import can_enumerate
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import integer, positive_int

# Binary logarithm of the number of points of the exhaustive posterior.
LOG2_POINTS = 18
# Positions that share a surface with its errors and failures.
PER_SURFACE = 5
SHELL_M = (0.5, 20.0)
FOUR_BANDS_HZ = (2.5e9, 2.7e9, 3.1e9, 3.6e9)
UNIFORM_RAD = 2 * np.pi
RANDOM_PHASE = 'random phase per band'
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
    RANDOM_PHASE: {'band_phase_std_rad': UNIFORM_RAD},
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
OUTSIDE = {f'a user at {name}': place for name, place in {
    'x = 18 m': (18.0, 0.0, 0.0), 'x = 30 m': (30.0, 0.0, 0.0), 'y = 6 m': (10.0, 6.0, 0.0),
    'z = 3 m': (10.0, 0.0, 3.0)}.items()}
SHELL = f'a shell {SHELL_M[0]:g} m to {SHELL_M[1]:g} m outside'


def main() -> None:
    """Run the benchmark."""
    options = parse_options()
    print(f'{options.positions} positions, seed {options.seed}\n')
    # Arguments of a job are plain.
    settings = {name: str(value) if isinstance(value, Path) else value
                for name, value in vars(options).items()
                if name not in ('dask', 'jobs', 'json', 'only')}
    found = frame.measured(options, 'robustness', rows_of, {
        name: {'name': name, 'settings': settings} for name in situations(options)
        if not options.only or any(text in name for text in options.only)})
    table = frame.Table(['signals from', 'scenario'], {
        'no fix [%]': ('without_fix', 1), 'MSE [m²]': ('mse_m2', 2),
        'predicted': ('predicted_mse_m2', 2), 'in the 95 % region [%]': ('covered', 1),
        'possibly outside [%]': ('possibly_outside', 1), 'median residual': ('residual', 0),
        'shots until a warning': ('warns_after', 0), 'warned [%]': ('warned', 0),
        'time [ms]': ('time_ms', 1), 'MSE to posterior': ('mse_to_posterior', 3)})
    frame.write_results(options.json, [
        {'signals': name, 'scenario': kind, **table.row(name, kind, **row)}
        for name, rows in found.items() for kind, row in rows.items()])


def rows_of(name: str, settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the figures of a situation, by the kind of the scenario of the estimator."""
    options, rows = argparse.Namespace(**settings), {}
    for kind, scenario, book, positions, received in cases(name, options):
        estimate, rows[kind] = measure(scenario, book, positions, received, options)
        if options.reference and kind == 'declared' and not can_enumerate(scenario):
            n = options.reference
            rows[kind]['mse_to_posterior'] = ratio_to_posterior(
                scenario, book, positions[:n], received[:n], estimate)
    return rows


def situations(options: argparse.Namespace
               ) -> dict[str, tuple[Scenario, Codebook, dict[str, Any] | None]]:
    """Return scenarios and codebooks by name, with the declaration of users in the region."""
    base, codebook = frame.scenario_of(options.config), Codebook.load(options.codebook)
    if options.pairs:
        combined = ((names, {key: value for name in names
                             for key, value in DECLARATIONS[name].items()})
                    for names in (*itertools.combinations(DECLARATIONS, 2), *TRIPLES))
        return {' + '.join(names): (base, codebook, changes) for names, changes in combined
                if len(changes) == len(names)}
    four = Scenario(center_frequencies_hz=FOUR_BANDS_HZ)
    random = random_codebook(four, streams.generator(options.seed, streams.START))
    return {**{name: (base, codebook, changes) for name, changes in DEVIATIONS.items()},
            FOUR_BANDS: (four, random, DEVIATIONS[RANDOM_PHASE]),
            **{name: (base, codebook, None) for name in (*OUTSIDE, SHELL)}}


# Kind, scenario and codebook of the estimator, positions, and received signals.
Case = tuple[str, Scenario, Codebook, np.ndarray, np.ndarray]


def cases(name: str, options: argparse.Namespace) -> Iterator[Case]:
    """Yield the signals of a situation with each scenario of the estimator.

    Users inside the region are located with a silent and a declaring scenario.
    """
    silent, book, changes = situations(options)[name]
    if changes is None:
        rng, n = streams.generator(options.seed, streams.HELD_OUT), options.positions
        around = shell(silent, n, rng)
        positions = np.tile(OUTSIDE[name], (n, 1)) if name in OUTSIDE else around
        received = MeasurementModel(silent, book).sample(positions, rng)
        yield 'silent', silent, book, positions, received
        return
    declared = dataclasses.replace(silent, **changes)
    positions, received = draw(declared, book, options)
    if changes and not options.pairs:
        yield 'silent', silent, book, positions, received
    yield 'declared', declared, book, positions, received


def parse_options() -> argparse.Namespace:
    """Parse the command line."""
    parser = frame.benchmark_parser('robustness', __doc__, 600, has_jobs=True)
    add = parser.add_argument
    add('--inside', action='store_true',
        help='estimate without reject_outside, as if no user were outside of the region')
    add('--config', type=Path, help='scenario file; Table I if omitted')
    add('--codebook', type=Path, default=frame.CONFIG / 'codebook.yaml', help='codebook file')
    add('--only', action='append', default=[], metavar='TEXT',
        help='only rows whose name contains the text; may be repeated')
    add('--reference', type=integer(0), default=0, metavar='N',
        help='compare the first N positions with the exhaustive posterior; 0 to omit')
    add('--windows', type=positive_int, default=200,
        help='number of windows to which the monitor of the residuals is applied')
    add('--pairs', action='store_true', help='all pairs of declarations, and some triples')
    return parser.parse_args()


def draw(scenario: Scenario, codebook: Codebook, options: argparse.Namespace
         ) -> tuple[np.ndarray, np.ndarray]:
    """Draw positions and signals; every few positions have another surface."""
    model, n = MeasurementModel(scenario, codebook), options.positions
    positions, received = [], []
    for group in range(-(-n // PER_SURFACE)):
        rng = streams.generator(options.seed, streams.PHASES, group)
        positions.append(scenario.sample_positions(PER_SURFACE, rng))
        received.append(model.sample(positions[-1], rng))
    return np.concatenate(positions)[:n], np.concatenate(received)[:n]


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


def measure(scenario: Scenario, codebook: Codebook, positions: np.ndarray, received: np.ndarray,
            options: argparse.Namespace) -> tuple[Estimate, dict[str, Any]]:
    """Return the estimate and the figures of a row."""
    estimate, times_s = frame.estimate_singly(make_estimator(
        'bayes', scenario, codebook, reject_outside=not options.inside), received)
    fixes, n = frame.Fixes.of(estimate, positions), len(positions)
    predicted = np.trace(estimate.covariance, axis1=1, axis2=2)
    # The covariance of users who may be outside includes the positions there.
    certain = fixes.fix & np.isfinite(estimate.expected_residual)
    residuals = np.stack([estimate.residual, estimate.expected_residual], axis=1)
    order = np.random.default_rng(0).integers(n, size=(options.windows, WINDOW))
    n_warned = sum(first_warning(residuals[window]) is not None for window in order)
    return estimate, {
        **fixes.figures(np.flatnonzero(fixes.fix) // PER_SURFACE),
        'predicted_mse_m2': float(predicted[certain].mean()) if certain.any() else None,
        'possibly_outside': share_percent(int(np.sum(fixes.fix & ~certain)), n),
        'residual': float(np.median(estimate.residual[fixes.fix])) if fixes.fix.any() else None,
        'warns_after': first_warning(residuals),
        'warned': share_percent(n_warned, options.windows),
        'time_ms': 1e3 * float(np.median(times_s[:, 1]))}


def first_warning(residuals: np.ndarray) -> int | None:
    """Return the number of phases until the monitor of the positioner warns, None without one."""
    monitor = InnovationTest()
    for count, (energy, expected) in enumerate(residuals.tolist(), 1):
        monitor.add(energy, expected)
        if monitor.drifts:
            return count
    return None


def ratio_to_posterior(scenario: Scenario, codebook: Codebook, positions: np.ndarray,
                       received: np.ndarray, estimate: Estimate) -> frame.Interval:
    """Compare the squared errors of the first fixes with those of the exhaustive posterior.

    The mean of finitely many points has an additional error. It is independent between two sets
    of points, so that the product of their errors has the expectation without it. The interval
    resamples surfaces, because the errors at positions that share one are not independent.
    """
    n = len(positions)
    fix = estimate.fix[:n]
    own = np.sum((estimate.mean[:n] - positions)[fix]**2, axis=1)
    first, second = (
        exhaustive_posterior(scenario, codebook, received, LOG2_POINTS, seed=seed).mean - positions
        for seed in range(2))
    best = np.sum((first * second)[fix], axis=1)
    surface = np.flatnonzero(fix) // PER_SURFACE
    return frame.ratio(*(np.bincount(surface, errors)[None] for errors in (own, best)))


if __name__ == '__main__':
    frame.run(main)
