"""Run experiments on the cores of this machine or on a Dask cluster.

The figures of the paper are experiments of their own: scripts/reproduce.
"""

import sys
from collections.abc import Sequence

from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.experiments import sweep_command
from rhs_isac_ros.model.arguments import ArgumentParser, HelpFormatter

_COMMANDS = {'sweep': sweep_command.main}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = ArgumentParser(
        prog=sweep_command.PROGRAM, description=__doc__, formatter_class=HelpFormatter,
        epilog='The option --help of an experiment lists its options.')
    parser.add_argument('experiment', choices=_COMMANDS,
                        help='sweep: measures over combinations of values of scenario fields')
    # Only the first argument: all others belong to the experiment.
    options = parser.parse_args(arguments[:1])
    return _COMMANDS[options.experiment](arguments[1:])


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
