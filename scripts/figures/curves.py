"""Positioning error beside the local and the global bound, over one parameter at a time.

Problem: how do the error of `bayes` and the bounds depend on the number of bands at equal pilots
(`bands`: equally spaced, and chosen for the region), on the number of pilots (`pilots`), on
the transmit power (`power`), on the Rice factor (`rice`: power of the direct path relative to the
multipath) and on the number of elements (`elements`)? NAME restricts the run to some of them. Each
curve compares the plans of Table I, of four equally spaced and of four unequally spaced bands,
with the same spectrum, and those of --plan (their codebooks serve `power` and `rice`).

A trial is a block of 250 positions. Codebooks are optimised against ambiguities, anew at each
value of `bands`, `pilots` and `elements`.

Duration on two cores: five minutes with --quick, about two hours without.
"""

import os

# One thread per job. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
from collections.abc import Sequence

from parts.plan_curves import Changes, Curve, Sizes, add_plan_options, evaluate, read_plans
from parts.plan_report import write

from rhs_isac_ros.experiments import parse_options, run_command
from rhs_isac_ros.model import Scenario

TRIALS, QUICK_TRIALS = 20, 1
PHASES, QUICK_PHASES = 4096, 1024
STEPS, QUICK_STEPS = 600, 100
CANDIDATES, QUICK_CANDIDATES = 6, 2


def more_frames(factor: float, plan: Changes) -> Changes:
    """Multiply the number of frames of a plan, up to a whole number."""
    return {'n_frames': max(round(factor * Scenario(**plan).n_frames), 1)}


CURVES = {
    'bands': Curve('number of bands, 8 band-frames', (1, 2, 4, 8), None),
    'pilots': Curve('pilots, relative to 8 band-frames', (0.5, 1, 2, 4), more_frames,
                    reoptimise=True),
    'power': Curve('transmit power [dBm]', (-70, -60, -50, -40, -20, 0),
                   lambda value, plan: {'max_power_w': 1e-3 * 10**(value / 10)}),
    'rice': Curve('Rice factor [dB]', (-10, -5, 0, 5, 10, 20),
                  lambda value, plan: {'multipath_to_los_db': -value}),
    'elements': Curve('elements along one side', (4, 6, 10, 14),
                      lambda value, plan: {'elements_per_side': int(value)}, reoptimise=True)}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment."""
    parser.add_argument('names', nargs='*', metavar='NAME', help=f'one of {", ".join(CURVES)}')
    add_plan_options(parser, STEPS, QUICK_STEPS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parse_options(__doc__, 'curves', TRIALS, QUICK_TRIALS, arguments, add_options)
    unknown = set(options.names) - set(CURVES)
    if unknown:
        raise SystemExit(f'scripts/reproduce curves: error: NAME: {", ".join(sorted(unknown))}, '
                         f'expected some of {", ".join(CURVES)}')
    sizes = Sizes(options.trials, QUICK_PHASES if options.quick else PHASES,
                  options.steps or (QUICK_STEPS if options.quick else STEPS),
                  QUICK_CANDIDATES if options.quick else CANDIDATES)

    def reproduce() -> None:
        for name in options.names or CURVES:
            curves = {name: CURVES[name]}
            entries = evaluate(curves, read_plans(options.plan), sizes, options.output / 'jobs',
                               options.jobs, options.dask)
            write(name, curves, entries, [], options.output,
                  options.format)

    return run_command(reproduce)


if __name__ == '__main__':
    raise SystemExit(main())
