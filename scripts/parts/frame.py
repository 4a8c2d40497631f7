"""The frame of benchmarks and experiments: options, errors of estimates, intervals and results."""

import argparse
import importlib
import json
import multiprocessing
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from scipy.special import chdtri

from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.experiments.resampling import Interval, replicate, share_percent
from rhs_isac_ros.experiments.sweep import with_power
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.positioning import Estimate, Estimator, ModelError
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    HelpFormatter,
    input_file,
    integer,
    output_file,
    positive_int,
    seed,
)
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.support.job_commands import add_run_options, unfinished
from rhs_isac_ros.support.jobs import Job, JobError, Strand
from rhs_isac_ros.support.pictures import PICTURE_FORMATS, write_picture

CONFIG = Path(__file__).parents[2] / 'config'
# Scenario and codebook of the two systems that most benchmarks compare.
SYSTEMS = {'table1': ('table1.yaml', 'codebook_ambiguity.yaml'),
           'bandplan': ('bandplan.yaml', 'codebook_bandplan.yaml')}
_FILES = {**SYSTEMS, 'lab_walk': ('lab_walk.yaml', 'codebook_lab.yaml')}
# Squared Mahalanobis radius of the 95 % region of an estimate.
_REGION_RADIUS = float(chdtri(3, 0.05))
_RESAMPLES = 2000


def benchmark_parser(
        name: str, description: str | None, positions: int = 0, default_seed: int | None = 1,
        has_jobs: bool = False) -> ArgumentParser:
    """Return a parser with ``--json`` and, if they have a default, ``--positions``, ``--seed``.

    The options of a benchmark that calls `measured` include those of jobs.
    """
    parser = ArgumentParser(
        prog=f'scripts/benchmark {name}', description=description, formatter_class=HelpFormatter)
    if positions:
        parser.add_argument('--positions', type=positive_int, default=positions,
                            help='number of positions')
    if default_seed is not None:
        parser.add_argument('--seed', type=seed, default=default_seed,
                            help='seed of all random numbers')
    parser.add_argument('--json', type=output_file, help='JSON file for the results')
    if has_jobs:
        add_run_options(parser)
    return parser


def measured(options: argparse.Namespace, name: str, function: Callable[..., Mapping[str, Any]],
             cases: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Run a function for each case of a benchmark as a job; return the results by case.

    Results of an unfinished run are kept in results/benchmarks/NAME.jobs.
    """
    work = imported(function)

    def strand(case: str) -> Strand[dict[str, Any]]:
        return (yield work, [Job.of(re.sub(r'\W+', '-', case), cases[case])])[0]

    with unfinished(Path('results/benchmarks') / name, options) as workers:
        return dict(zip(cases, workers.run([strand(case) for case in cases]), strict=True))


def imported(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of the main program as one of a module, which other processes import.

    They would receive it by value, and what it uses of the main program by name: caches, and
    functions of SciPy, are then missing in these processes.
    """
    if function.__module__ != '__main__':
        return function
    program = Path(str(sys.modules['__main__'].__file__))
    module = importlib.import_module(f'{program.parent.name}.{program.stem}')
    return getattr(module, function.__name__)


def experiment_options(
        name: str, description: str | None, trials: int, quick_trials: int,
        arguments: Sequence[str] | None = None,
        add: Callable[[ArgumentParser], Any] = lambda parser: None) -> argparse.Namespace:
    """Parse the command line of an experiment, with a number of trials and one for ``--quick``.

    `add` adds the experiment's own options to the parser.
    """
    parser = ArgumentParser(
        prog=f'scripts/reproduce {name}', description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    count = parser.add_mutually_exclusive_group()
    count.add_argument('--quick', action='store_true', help=f'run only {quick_trials} trials')
    count.add_argument('--trials', type=integer(1, 10**5), metavar='N',
                       help=f'number of trials (default: {trials})')
    add(parser)
    add_run_options(parser, f'results/{name}')
    parser.add_argument('--format', choices=PICTURE_FORMATS, default=PICTURE_FORMATS[0],
                        help='format of the picture, and suffix of its name (default: '
                             '%(default)s); drawing again repeats no job')
    options = parser.parse_args(arguments)
    options.trials = quick_trials if options.quick else options.trials or trials
    return options


def add_plans(parser: ArgumentParser, known: Sequence[str]) -> None:
    """Add the option for further scenarios with their codebooks, beside those with known names."""
    class Pair(argparse.Action):
        """Adds a scenario and its codebook, which are checked before anything runs."""

        def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
                     files: Any, option_string: str | None = None) -> None:
            (scenario_file, codebook_file), plans = files, dict(namespace.plan)
            if scenario_file.stem in (*known, *plans):
                parser.error(f'argument {option_string}: {scenario_file.stem} more than once, '
                             'expected different names')
            try:
                scenario = Scenario.from_yaml(scenario_file)
                codebook = Codebook.load(codebook_file)
            except (CodebookError, ScenarioError) as error:
                parser.error(f'argument {option_string}: {error}')
            try:
                with_power(codebook, scenario.max_power_w).check(scenario)
            except CodebookError as error:
                parser.error(f'argument {option_string}: {codebook_file}: {error}')
            namespace.plan = plans | {scenario_file.stem: (scenario_file, codebook_file)}

    parser.add_argument('--plan', type=input_file, nargs=2, action=Pair, default={},
                        metavar=('SCENARIO', 'CODEBOOK'), help='another plan and its codebook')


def system(name: str) -> tuple[Scenario, Codebook]:
    """Load a scenario and its codebook: one of `SYSTEMS`, or the walking users of the lab."""
    scenario, codebook = _FILES[name]
    return Scenario.from_yaml(CONFIG / scenario), Codebook.load(CONFIG / codebook)


def scenario_of(file: Path | str | None) -> Scenario:
    """Load a scenario; Table I without a file."""
    return Scenario.from_yaml(file) if file else Scenario()


def run(main: Callable[[], int | None]) -> NoReturn:
    """Run a benchmark and exit; errors in files are one line."""
    sys.exit(exit_code_of(
        main, (CodebookError, ConnectionError, JobError, ModelError, ScenarioError)))


def write_results(path: Path | None, results: Any) -> None:
    """Write the results of a benchmark if a file was given."""
    if path:
        write_whole(path, json.dumps(results, indent=2, default=float) + '\n')


def write_report(options: argparse.Namespace, name: str, title: str, report: str, figure: Any,
                 data: Mapping[str, str]) -> None:
    """Print the report of an experiment, and write it with its picture and files of data."""
    picture, files = f'{name}.{options.format}', [f'{name}.md', *data]
    write_picture(options.output / picture, figure)
    for file, text in data.items():
        write_whole(options.output / file, text)
    write_whole(options.output / f'{name}.md',
                f'# {title}\n\n![{title}]({picture})\n\n{report}\n')
    print(f'{report}\n\nwritten: {options.output}/{picture}, {", ".join(files[:-1])} and '
          f'{files[-1]}')


class Table:
    """A table in Markdown that is printed row by row.

    Parameters
    ----------
    names
        Headers of the columns with names.
    columns
        Header of each column with figures, the key of its figure, and the number of digits.
    """

    def __init__(self, names: Sequence[str], columns: Mapping[str, tuple[str, int]]) -> None:
        self._columns = columns.values()
        self._print(*names, *columns)
        self._print(*['---'] * (len(names) + len(columns)))

    def row(self, *names: str, **figures: Any) -> dict[str, Any]:
        """Print a row, and return its figures, of which some may have no column."""
        self._print(*names, *(shown(figures.get(key), digits) for key, digits in self._columns))
        return figures

    def _print(self, *cells: str) -> None:
        print(f'| {" | ".join(cells)} |', flush=True)


def shown(value: float | str | Sequence[float] | None, digits: int) -> str:
    """Return a text, a number, or a value with its interval as text; ``-`` for None."""
    if value is None or isinstance(value, str):
        return value or '-'
    if isinstance(value, Sequence):
        return '{:.{d}f} [{:.{d}f}, {:.{d}f}]'.format(*value, d=digits)
    return f'{value:.{digits}f}'


def mean_interval(samples: np.ndarray, group: np.ndarray | None = None,
                  relative_to: np.ndarray | None = None) -> Interval | None:
    """Return a mean with its interval by the percentile bootstrap over groups; None of nothing.

    `group` contains the number of the group of each sample, int [N], for example of its surface.
    By default, each sample is a group. With `relative_to`, float64 [N], return the ratio to its
    mean.
    """
    if not len(samples):
        return None
    _, index = np.unique(np.arange(len(samples)) if group is None else group, return_inverse=True)
    sums, counts = np.bincount(index, samples), np.bincount(index, relative_to)
    picks = np.random.default_rng(0).integers(len(sums), size=(_RESAMPLES, len(sums)))
    low, high = np.percentile(sums[picks].sum(axis=1) / counts[picks].sum(axis=1), (2.5, 97.5))
    return Interval(float(sums.sum() / counts.sum()), float(low), float(high))


def ratio(results: np.ndarray, baseline: np.ndarray) -> Interval:
    """Return the ratio of two means over members and cases, with its interval by `replicate`."""
    own, other = (replicate(one, 0)[0] for one in (results, baseline))
    value, low, high = own.reduction_from(other)
    return Interval(1 - value / 100, 1 - high / 100, 1 - low / 100)


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

    def figures(self, group: np.ndarray | None = None) -> dict[str, Any]:
        """Return mean squared error, its root, median error, NEES, and shares [%].

        They are the shares of estimates with and without a fix, and of fixes whose 95 % region
        contains the position, with Wilson's intervals. `group` is that of `mean_interval`, for
        each fix.
        """
        mse = mean_interval(self.squared, group)
        n, n_fixes = len(self.fix), len(self.squared)
        return {
            'mse_m2': mse, 'rms_m': mse and tuple(value**0.5 for value in mse),
            'median_m': float(np.median(self.squared))**0.5 if n_fixes else None,
            'nees': mean_interval(self.normalised, group),
            'fix': share_percent(n_fixes, n), 'without_fix': share_percent(n - n_fixes, n),
            'covered': share_percent(int(self.inside.sum()), n_fixes) if n_fixes else None}


def in_new_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a function in a new process, so that its peak memory is its own."""
    with multiprocessing.get_context('spawn').Pool(1) as pool:
        return pool.apply(function, arguments)


def peak_mib() -> float:
    """Return the peak memory of this process [MiB]."""
    # getrusage would include the peak of the process that this one was forked from.
    peak = re.search(r'VmHWM:\s*(\d+) kB', Path('/proc/self/status').read_text(encoding='ascii'))
    assert peak
    return int(peak[1]) / 1024


def estimate_singly(estimator: Estimator, received: np.ndarray) -> tuple[Estimate, np.ndarray]:
    """Locate the users of signals one by one; also return the times, float64 [N, 2] [s].

    They are the time of the clock and the CPU time of each estimate.
    """
    estimates, times_s = [], np.empty((len(received), 2))
    for row, signals in zip(times_s, received, strict=True):
        begin = time.perf_counter(), time.process_time()
        estimates.append(estimator.estimate(signals))
        row[:] = time.perf_counter() - begin[0], time.process_time() - begin[1]
    return Estimate.of_each(estimates), times_s
