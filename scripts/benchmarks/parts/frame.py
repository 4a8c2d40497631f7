"""The frame of the benchmarks: options, positions, estimates, intervals, tables and results."""

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from scipy.special import chdtri

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.positioning import Estimate, Estimator, ModelError
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    HelpFormatter,
    input_file,
    output_file,
    positive_int,
    seed,
)
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.files import write_whole

CONFIG = Path(__file__).parents[3] / 'config'
# Value and ends of the 95 % interval.
Interval = tuple[float, float, float]
# Squared Mahalanobis radius of the 95 % region of an estimate.
_REGION_RADIUS = float(chdtri(3, 0.05))
_RESAMPLES = 2000


def benchmark_parser(
        name: str, description: str | None, positions: int = 0, default_seed: int | None = 1,
        ) -> ArgumentParser:
    """Return a parser with ``--json`` and, if they have a default, ``--positions``, ``--seed``."""
    parser = ArgumentParser(
        prog=f'scripts/benchmark {name}', description=description, formatter_class=HelpFormatter)
    if positions:
        parser.add_argument('--positions', type=positive_int, default=positions,
                            help='number of positions')
    if default_seed is not None:
        parser.add_argument('--seed', type=seed, default=default_seed,
                            help='seed of all random numbers')
    parser.add_argument('--json', type=output_file, help='JSON file for the results')
    return parser


def add_plans(parser: ArgumentParser) -> None:
    """Add the options for further scenarios with their codebooks."""
    parser.add_argument('--plan', type=input_file, nargs=2, action='append', default=[],
                        metavar=('SCENARIO', 'CODEBOOK'), help='another plan and its codebook')
    parser.add_argument('--only-plans', action='store_true', help='only the plans of --plan')


def scenario_of(file: Path | None) -> Scenario:
    """Load a scenario; Table I without a file."""
    return Scenario.from_yaml(file) if file else Scenario()


def run(main: Callable[[], int | None]) -> NoReturn:
    """Run a benchmark and exit; errors in files are one line."""
    sys.exit(exit_code_of(main, (CodebookError, ModelError, ScenarioError)))


def write_results(path: Path | None, results: Any) -> None:
    """Write results if a file was given."""
    if path:
        write_whole(path, json.dumps(results, indent=2, default=float) + '\n')


class Table:
    """A table in Markdown that is printed row by row."""

    def __init__(self, *header: str) -> None:
        self.row(*header)
        print('|---' * len(header) + '|')

    def row(self, *cells: str) -> None:
        """Print a row."""
        print(f'| {" | ".join(cells)} |', flush=True)


def shown(value: float | Sequence[float] | None, digits: int) -> str:
    """Return a number, or a value with its interval, as text; ``-`` for None."""
    if value is None:
        return '-'
    if isinstance(value, Sequence):
        return '{:.{d}f} [{:.{d}f}, {:.{d}f}]'.format(*value, d=digits)
    return f'{value:.{digits}f}'


def mean_interval(samples: np.ndarray, group: np.ndarray | None = None) -> Interval | None:
    """Return a mean with its interval by the percentile bootstrap over groups; None of nothing.

    `group` contains the number of the group of each sample, int [N], for example of its surface.
    By default, each sample is a group.
    """
    if not len(samples):
        return None
    _, index = np.unique(np.arange(len(samples)) if group is None else group, return_inverse=True)
    sums, counts = np.bincount(index, samples), np.bincount(index)
    picks = np.random.default_rng(0).integers(len(sums), size=(_RESAMPLES, len(sums)))
    low, high = np.percentile(sums[picks].sum(axis=1) / counts[picks].sum(axis=1), (2.5, 97.5))
    return float(samples.mean()), float(low), float(high)


class Fixes(NamedTuple):
    """The errors of estimates at known positions.

    Attributes
    ----------
    fix
        Whether an estimate is a fix, bool [N].
    squared
        Squared errors of the fixes [m^2], float64 [F].
    normalised
        Squared errors relative to the covariance, float64 [F].
    """

    fix: np.ndarray
    squared: np.ndarray
    normalised: np.ndarray

    @classmethod
    def of(cls, estimate: Estimate, positions: np.ndarray) -> 'Fixes':
        """Compare the estimates with the positions, float64 [N, 3] [m]."""
        fix = np.asarray(estimate.fix)
        errors = (estimate.mean - positions)[fix]
        return cls(fix, np.sum(errors**2, axis=1), np.sum(
            errors * np.linalg.solve(estimate.covariance[fix], errors[..., None])[..., 0], axis=1))

    @property
    def inside(self) -> np.ndarray:
        """Whether the position of a fix is in the 95 % region of the estimate, bool [F]."""
        return self.normalised <= _REGION_RADIUS

    @property
    def without_fix(self) -> Interval:
        """Share of estimates that are no fix [%], with Wilson's interval."""
        return share_percent(int(np.sum(~self.fix)), len(self.fix))

    @property
    def covered(self) -> Interval | None:
        """Share of fixes whose 95 % region contains the position [%], with Wilson's interval."""
        return share_percent(int(self.inside.sum()), len(self.inside)) if self.fix.any() else None


def stacked(estimates: Sequence[Estimate]) -> Estimate:
    """Return estimates of single positions as one of N positions."""
    fields = [np.stack([getattr(one, name) for one in estimates])
              for name in ('mean', 'covariance', 'residual', 'expected_residual')]
    return Estimate(fields[0], fields[1], tuple(str(one.reason) for one in estimates), *fields[2:])


def estimate_singly(estimator: Estimator, received: np.ndarray) -> tuple[Estimate, np.ndarray]:
    """Locate the users of signals one by one; also return the times, float64 [N, 2] [s].

    They are the time of the clock and the CPU time of each estimate.
    """
    estimates, times_s = [], np.empty((len(received), 2))
    for row, signals in zip(times_s, received, strict=True):
        begin = time.perf_counter(), time.process_time()
        estimates.append(estimator.estimate(signals))
        row[:] = time.perf_counter() - begin[0], time.process_time() - begin[1]
    return stacked(estimates), times_s
