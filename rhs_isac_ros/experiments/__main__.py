"""Measure accuracy, bounds and capacity over all combinations of values of scenario fields.

The results are a CSV file with one row per setting and measure, a picture, and a table on the
terminal. An interrupted sweep resumes when the command is repeated. Positions, signals and
codebooks depend only on the seed, and all settings with the same region use the same positions.
"""

import argparse
import importlib.util
import math
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

from rhs_isac_ros.codebook import OBJECTIVES, CodebookError
from rhs_isac_ros.experiments import calibrate
from rhs_isac_ros.experiments.sweep import (
    BOUND,
    CRLB,
    KINDS,
    OPTIMIZE,
    Point,
    Sweep,
    families,
    run_sweep,
    table,
)
from rhs_isac_ros.experiments.sweep_picture import draw, shown
from rhs_isac_ros.experiments.sweep_settings import (
    CODEBOOK,
    ESTIMATOR,
    FIELDS,
    MEASURES,
    Axis,
    names_of,
    parse_axis,
    parse_measures,
    settings_of,
)
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    check_effect,
    input_file,
    integer,
    picture_file,
    positive_int,
    seed,
    typed,
)
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.support.job_commands import add_run_options, run_command
from rhs_isac_ros.support.pictures import write_picture
from rhs_isac_ros.support.texts import markdown_table

# The bootstrap keeps 2000 weights for each position in memory.
_MAX_POSITIONS = 10**5
_MAX_SETTINGS = 10**4
_EPILOG = '\n\n'.join(textwrap.fill(f'{title}: {", ".join(names)}.', 79) for title, names in (
    ('fields', (*FIELDS, CODEBOOK, ESTIMATOR)), ('measures', MEASURES)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the code of `run_command`, or exit with 2 after a usage error."""
    parser = ArgumentParser(
        prog='python3 -m rhs_isac_ros.experiments',
        description='Run experiments on the cores of this machine or on a Dask cluster.',
        epilog='The option --help of an experiment lists its options.')
    experiments = parser.add_subparsers(dest='experiment', required=True, metavar='experiment')
    sweep = experiments.add_parser(
        'sweep', help='measures over combinations of values of scenario fields',
        description=__doc__, epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    _add_options(sweep)
    sweep.set_defaults(run=lambda options: _sweep(sweep, options))
    pilots = experiments.add_parser(
        'calibrate', help='a surface, a hall or a board, from pilots at known positions',
        description=calibrate.DESCRIPTION)
    calibrate.add_options(pilots)
    pilots.set_defaults(run=lambda options: calibrate.main(pilots, options))
    options = parser.parse_args(arguments)
    return int(options.run(options))


def _sweep(parser: ArgumentParser, options: argparse.Namespace) -> int:
    _check(parser, options)
    try:
        base = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
        settings = settings_of(base, options.vary, options.codebook, options.estimator)
        sweep = Sweep(
            base, settings, names_of(options.measure), options.positions, options.seed,
            options.objective, options.steps, options.optimize_for, options.repeats)
    except (CodebookError, ScenarioError, ValueError) as error:
        parser.error(str(error))
    return run_command(lambda: _run(sweep, options))


def _add_options(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add('--vary', type=typed(lambda text: parse_axis(text).distinct()), action='append',
        required=True, metavar='FIELD=VALUE,...',
        help='field and its values, in the syntax of scenario files; the first field is the x '
             'axis of the picture, the second has a line for each value, and the others have '
             'panels')
    add('--with', type=typed(parse_axis), action=_Along, metavar='FIELD=VALUE,...',
        help='field that varies together with the field of the previous --vary')
    add('--measure', type=typed(parse_measures), default='crlb,mse', metavar='NAME,...',
        help='measures, each in its own panel; NAME+NAME draws several in one panel '
             '(default: %(default)s)')
    add('--scenario', '--config', type=input_file, metavar='FILE',
        help="YAML file of all other fields (default: the paper's Table I)")
    add('--estimator', default='bayes', metavar='NAME',
        help='bayes, ml, an installed plug-in or MODULE:NAME (default: %(default)s)')
    add('--codebook', default=OPTIMIZE, metavar='CODEBOOK',
        help=f'{", ".join(KINDS)} for each setting, or a file for all (default: %(default)s)')
    add('--optimize-for', nargs='*', choices=(*FIELDS,), metavar='FIELD',
        help='fields whose values the optimisation of a codebook takes from the setting; it uses '
             'the base values of all others, except for fields that change the sizes, bands or '
             'amplitude levels (default: all)')
    add('--objective', choices=sorted(OBJECTIVES), default='ambiguity',
        help='objective of the optimisation (default: %(default)s)')
    add('--steps', type=positive_int, default=300, metavar='N',
        help='maximum number of steps of an optimisation (default: %(default)s)')
    add('--repeats', type=integer(1, 1000), default=1, metavar='N',
        help='codebooks for each setting, with successive seeds, if optimised or random '
             '(default: %(default)s)')
    add('--positions', type=integer(1, _MAX_POSITIONS), default=2000, metavar='N',
        help='number of positions in each setting (default: %(default)s)')
    add('--seed', type=seed, default=0, metavar='N',
        help='seed of positions, signals and codebooks (default: %(default)s)')
    add('--picture', type=picture_file, metavar='FILE',
        help='PNG, PDF or SVG file (default: sweep.png in the folder of the results)')
    add_run_options(parser, 'results/sweep')


def _check(parser: ArgumentParser, options: argparse.Namespace) -> None:
    """Exit with a usage error if an option has no effect, or there are too many settings."""
    varied = {name for axis in options.vary for name in axis.fields}
    for name in (CODEBOOK, ESTIMATOR):
        check_effect(parser, options, [name], name not in varied, f'no --vary or --with {name}')
    measures = (MEASURES[name].quantity for name in names_of(options.measure))
    check_effect(parser, options, [ESTIMATOR], {*families(measures)} - {CRLB, BOUND},
                 'a --measure of errors or capacities')
    n_settings = math.prod(len(axis.values) for axis in options.vary)
    if n_settings > _MAX_SETTINGS:
        parser.error(f'argument --vary: {n_settings} settings, expected at most {_MAX_SETTINGS}')
    if options.picture and not importlib.util.find_spec('matplotlib'):
        parser.error('argument --picture: drawing needs matplotlib, which is not installed '
                     "(pip install 'rhs_isac_ros[plot]')")


def _run(sweep: Sweep, options: argparse.Namespace) -> None:
    """Run the jobs, write the files and print the table."""
    folder = options.output
    points = run_sweep(sweep, folder / 'jobs', options.jobs, options.dask)
    print(_report(options.vary, points))
    write_whole(folder / 'sweep.csv', table(sweep, points))
    if not importlib.util.find_spec('matplotlib'):
        print(f'\nwritten: {folder}/sweep.csv; drawing the picture needs matplotlib, which is not '
              "installed (pip install 'rhs_isac_ros[plot]')")
        return
    picture = options.picture or folder / 'sweep.png'
    write_picture(picture, draw(options.vary, points, options.measure))
    print(f'\nwritten: {folder}/sweep.csv and {picture}')


def _report(axes: Sequence[Axis], points: Sequence[Point]) -> str:
    """Return the points as a Markdown table with a row per setting and a column per measure."""
    names = [axis.fields[0] for axis in axes]
    measures = list(dict.fromkeys(point.measure for point in points))
    rows: dict[tuple[str, ...], list[str]] = {}
    for point in points:
        key = tuple(shown(name, point.setting.varied[name]) for name in names)
        rows.setdefault(key, []).append('{:.4g} [{:.4g}, {:.4g}]'.format(*point.interval))
    return markdown_table(
        [*names, *(f'{name} [{MEASURES[name].unit}]' for name in measures)],
        [[*key, *cells] for key, cells in rows.items()])


class _Along(argparse.Action):
    """The action of ``--with``, which adds a field to the last axis of ``--vary``."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
                 values: Any, option_string: str | None = None) -> None:
        """Add the field of ``--with`` to the axis of the last ``--vary``."""
        if not getattr(namespace, 'vary', None):
            parser.error(f'argument {option_string}: expected after --vary')
        try:
            namespace.vary[-1] = namespace.vary[-1].along(values)
        except ValueError as error:
            parser.error(f'argument {option_string}: {error}')


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
