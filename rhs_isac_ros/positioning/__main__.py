"""Train the network of the estimator `neural` for a codebook and write it as a model file."""

import argparse
import sys
from collections.abc import Sequence

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import neural
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    check_distinct,
    input_file,
    integer,
    output_file,
    positive_int,
    seed,
)
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.files import save_or_rescue
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.support.progress import progress_bar


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the code of `exit_code_of`."""
    parser = ArgumentParser(prog='python3 -m rhs_isac_ros.positioning', description=__doc__)
    add = parser.add_argument
    add('--codebook', type=input_file, required=True, help='codebook file')
    add('--scenario', '--config', type=input_file,
        help="YAML file of the scenario; the paper's Table I if omitted")
    add('--pairs', type=integer(20, 10**7), default=neural.DEFAULT_PAIRS,
        help='simulated pairs for training, validation and test, 7 : 1.5 : 1.5')
    add('--inputs', choices=sorted(neural.INPUTS), default='parts',
        help='real and imaginary parts of the signals, or their magnitudes')
    add('--hidden', type=integer(1, 10**5), default=neural.DEFAULT_HIDDEN,
        help='units of the hidden layer')
    add('--epochs', type=positive_int, default=neural.DEFAULT_EPOCHS,
        help='maximum number of passes through the pairs')
    add('--seed', type=seed, default=0,
        help='seed of the pairs, the initial weights and the order of the pairs')
    add('--output', type=output_file, default='model.npz',
        help='file to write; an existing file is replaced at the end')
    add('--quiet', action='store_true', help='show no progress')
    options = parser.parse_args(arguments)
    check_distinct(parser, options)
    # Errors of scenario and codebook are ValueErrors.
    return exit_code_of(
        lambda: _run(options), (ValueError, MemoryError, MissingLibraryError), parser.prog)


def _run(options: argparse.Namespace) -> None:
    output = options.output
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    codebook = Codebook.load(options.codebook, scenario)
    with progress_bar(options.epochs, 'epoch', quiet=options.quiet) as show:
        network = neural.train(
            scenario, codebook, options.pairs, options.seed, options.hidden, options.epochs,
            show and (lambda epoch, mse_m2: show(epoch, f'{mse_m2:.3f} m^2')),
            options.inputs)
    save_or_rescue(network.save, output)
    about = network.about
    print(f'{output}: codebook {codebook.id}, {about["epochs"]} epochs; mean squared error '
          f'{about["validation_mse_m2"]:.3f} m^2 in validation, {about["test_mse_m2"]:.3f} m^2 '
          'in the test')


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
