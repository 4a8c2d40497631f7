"""Optimise a codebook and write it as a ROS 2 parameter file."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook.codebook import CodebookError
from rhs_isac_ros.codebook.optimize import DEFAULT_POSITIONS, METHODS, Progress, optimize
from rhs_isac_ros.model import Scenario, ScenarioError, streams

# Positions on which the average bound of the result is measured; none of them is a sample.
HELD_OUT_POSITIONS = 2000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code: 0, or 2 if an argument or a file is wrong.
    """
    options = _parser().parse_args(arguments)
    try:
        scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
        result = optimize(
            scenario, method=options.method, n_positions=options.positions, seed=options.seed,
            max_steps=options.steps, progress=_show)
        held_out = scenario.sample_positions(
            HELD_OUT_POSITIONS, streams.generator(options.seed, streams.HELD_OUT))
        average = float(crlb(scenario, result.codebook, held_out).mean())
        dataclasses.replace(result.codebook, average_crlb_m2=average).save(options.output)
    except (ScenarioError, CodebookError, ValueError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    print(f'{options.output}: average CRLB {average:.5f} m^2 over {HELD_OUT_POSITIONS} held-out '
          f'positions; {result.reason}')
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='python -m rhs_isac_ros.codebook', description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--output', type=Path, default=Path('codebook.yaml'),
                        help='file to write; it is replaced at the end')
    parser.add_argument('--scenario', type=Path,
                        help="YAML file of the scenario; the paper's Table I if none is given")
    parser.add_argument('--method', choices=sorted(METHODS), default='lbfgs', help='optimiser')
    parser.add_argument('--positions', type=int, default=DEFAULT_POSITIONS,
                        help='positions that sample the region of interest')
    parser.add_argument('--steps', type=int, default=600, help='limit of update steps')
    parser.add_argument('--seed', type=int, default=0, help='seeds samples and start')
    return parser


def _show(progress: Progress) -> None:
    if progress.step % 50 == 0:
        print(f'step {progress.step}: {progress.value_m2:.5f} m^2 after '
              f'{progress.elapsed_s:.0f} s', file=sys.stderr)


if __name__ == '__main__':
    sys.exit(main())
