"""Accuracy and time of tracks of users that walk.

Problem: users walk in straight lines between random positions of the region of interest, or stand
still with --speed 0, and are located at a constant rate. Their multipath is correlated between
cycles by Eq. (4), as in the channel node. How large are the errors of the track and of estimates
from single cycles? Are the covariances consistent with these errors? How much time does the track
take in addition to the estimate of a cycle?

Cycles within the first two seconds are not counted. The 95 % intervals are from resampling the
walks, because the cycles of a walk are not independent. The 95 % region of an estimate is the
ellipsoid of its covariance that contains 95 % of a Gaussian. --bands and --frames replace bands
and frames of the scenario; the codebook is then random unless --codebook selects one.

--peer adds the particle filter of Stone Soup (scripts/setup peers). It has the same likelihood and
motion model as the track, and starts from particles that are drawn from the posterior of the first
cycle.
"""

import os

# One thread, as in the positioner node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from parts.walks import Walks, simulate_walks
from scipy.special import chdtri

from rhs_isac_ros.codebook import Codebook, CodebookError, random_codebook
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.experiments import markdown_table
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.positioning import BayesEstimator, Motion, Tracker
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    integer,
    positive_float,
    positive_int,
    seed,
)
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import

DEFAULT_CODEBOOK = Path(__file__).parents[2] / 'config' / 'codebook.yaml'
# Squared Mahalanobis radius of the 95 % region.
REGION_RADIUS = float(chdtri(3, 0.05))
# Time after which the cycles of a walk count [s].
WARM_UP_S = 2.0
N_RESAMPLES = 2000


class Errors(NamedTuple):
    """Results of one method for W walks of N counted cycles.

    Attributes
    ----------
    squared
        Squared errors [m^2], float64 [W, N].
    normalised
        Squared errors relative to the covariance, float64 [W, N].
    times_s
        CPU times of all cycles [s], float64 [W, C].
    """

    squared: np.ndarray
    normalised: np.ndarray
    times_s: np.ndarray


class Method(Protocol):
    """A method that locates one user."""

    def update(self, time_s: float, signals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of the position after the signals of a cycle."""
        ...


def main() -> None:
    """Run the benchmark."""
    options = parse_options()
    scenario = Scenario.from_yaml(options.config) if options.config else Scenario()
    if options.bands:
        scenario = dataclasses.replace(
            scenario, center_frequencies_hz=tuple(1e9 * band for band in options.bands))
    if options.frames:
        scenario = dataclasses.replace(scenario, n_frames=options.frames)
    codebook = load_codebook(options, scenario)
    walks = simulate_walks(
        scenario, codebook, options.walks, round(options.duration * options.rate),
        1 / options.rate, options.speed, options.seed)
    estimator = BayesEstimator(scenario, codebook)
    motion = Motion(options.assumed_speed)
    methods: dict[str, Callable[[], Method]] = {
        'single cycles': lambda: Single(estimator),
        'track': lambda: Track(estimator, motion)}
    for n_particles in options.peer or ():
        with optional_import('--peer (scripts/setup peers)'):
            from peers.stonesoup_filter import ParticleFilter

        methods[f'Stone Soup, {n_particles} particles'] = (
            lambda n_particles=n_particles: ParticleFilter(
                estimator, motion, n_particles, options.seed))
    print(f'{options.walks} walks of {options.duration:g} s at {options.speed:g} m/s, '
          f'{options.rate:g} cycles a second, codebook {codebook.id}, seed {options.seed}\n')
    found = measure(methods, walks)
    print(markdown_table(
        ['method', 'rms error [m]', 'median [m]', '95 % regions contain [%]',
         'normalised error', 'CPU time of a cycle [ms]'],
        [row(name, errors) for name, errors in found.items()]))
    extra_s = np.median(found['track'].times_s - found['single cycles'].times_s)
    print(f'\nCPU time of the track beyond that of single cycles: {1e3 * extra_s:.2f} ms')


def parse_options() -> argparse.Namespace:
    """Parse the command line."""
    parser = ArgumentParser(
        prog='scripts/benchmark tracking', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add('--config', type=input_file, help='YAML file of the scenario (default: Table I)')
    add('--codebook', type=input_file, help='codebook file (default: that of Table I)')
    add('--bands', type=positive_float, nargs='+', metavar='GHZ', help='centre frequencies')
    add('--frames', type=positive_int, help='frames of each band')
    add('--walks', type=positive_int, default=200, help='number of walks (default: %(default)s)')
    add('--duration', type=positive_float, default=6.0, metavar='S',
        help='duration of a walk (default: %(default)s s)')
    add('--rate', type=positive_float, default=10.0, metavar='HZ',
        help='cycles a second of each user (default: %(default)s)')
    add('--speed', type=float, default=1.0, metavar='MPS',
        help='speed of the users (default: %(default)s m/s)')
    add('--assumed-speed', type=positive_float, default=1.0, metavar='MPS',
        help='speed that the track assumes (default: %(default)s m/s)')
    add('--peer', type=integer(1, 10**7), nargs='+', metavar='N',
        help='compare with particle filters of Stone Soup, with N particles each')
    add('--seed', type=seed, default=1, help='seed of all random numbers')
    options = parser.parse_args()
    if options.speed < 0:
        parser.error(f'argument --speed: {options.speed}, expected 0 or more')
    if options.duration <= WARM_UP_S:
        parser.error(f'argument --duration: {options.duration}, expected more than {WARM_UP_S}')
    return options


def load_codebook(options: argparse.Namespace, scenario: Scenario) -> Codebook:
    """Return the codebook to use, a random one if there is no file for the scenario."""
    if options.codebook:
        codebook = Codebook.load(options.codebook)
    elif options.config or options.bands or options.frames:
        codebook = random_codebook(scenario, np.random.default_rng(options.seed))
    else:
        codebook = Codebook.load(DEFAULT_CODEBOOK)
    codebook.check(scenario)
    return codebook


class Single:
    """Estimates of single cycles."""

    def __init__(self, estimator: BayesEstimator) -> None:
        self._estimator = estimator

    def update(self, time_s: float, signals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of the position."""
        estimate = self._estimator.estimate(signals)
        return estimate.mean, estimate.covariance


class Track:
    """Estimates of a track."""

    def __init__(self, estimator: BayesEstimator, motion: Motion) -> None:
        self._tracker = Tracker(estimator, motion)

    def update(self, time_s: float, signals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of the position."""
        estimate = self._tracker.update(time_s, signals)
        return estimate.mean, estimate.covariance


def measure(methods: dict[str, Callable[[], Method]], walks: Walks) -> dict[str, Errors]:
    """Run every method over all walks, one after the other on each, so that times compare."""
    counted = walks.times_s >= WARM_UP_S
    shape = len(methods), *walks.positions.shape[:2]
    squared, normalised, times_s = np.empty((3, *shape))
    for walk in range(shape[1]):
        for n, make in enumerate(methods.values()):
            method = make()
            for cycle, time_s in enumerate(walks.times_s):
                begin = time.process_time()
                mean, covariance = method.update(time_s, walks.signals[walk, cycle])
                times_s[n, walk, cycle] = time.process_time() - begin
                error = mean - walks.positions[walk, cycle]
                squared[n, walk, cycle] = error @ error
                normalised[n, walk, cycle] = error @ np.linalg.solve(covariance, error)
    return {name: Errors(squared[n][:, counted], normalised[n][:, counted], times_s[n])
            for n, name in enumerate(methods)}


def row(name: str, errors: Errors) -> list[str]:
    """Return the cells of a method, with intervals over the walks."""
    rng = np.random.default_rng(0)
    n_walks = len(errors.squared)
    chosen = rng.integers(n_walks, size=(N_RESAMPLES, n_walks))
    inside = 100.0 * (errors.normalised <= REGION_RADIUS)

    def interval(values: np.ndarray) -> str:
        low, high = np.quantile(values, [0.025, 0.975])
        return f'[{low:.3g}, {high:.3g}]'
    rms = np.sqrt(errors.squared.mean(axis=1)[chosen].mean(axis=1))
    share = inside.mean(axis=1)[chosen].mean(axis=1)
    return [name, f'{np.sqrt(errors.squared.mean()):.3f} {interval(rms)}',
            f'{np.sqrt(np.median(errors.squared)):.3f}', f'{inside.mean():.1f} {interval(share)}',
            f'{np.mean(errors.normalised):.2f}', f'{1e3 * np.median(errors.times_s):.1f}']


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (CodebookError, MissingLibraryError, ScenarioError)))
