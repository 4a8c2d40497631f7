"""Write the file of a coupled board, for the field board of a scenario."""

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.model.network import Admittances, read_touchstone
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.model.waveguides import board_of_guides
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    nonnegative_float,
    output_file,
    positive_float,
    positive_int,
)
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.files import read_yaml, write_archive
from rhs_isac_ros.support.optional import MissingLibraryError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the code of `exit_code_of`."""
    parser = ArgumentParser(prog='python3 -m rhs_isac_ros.model', description=__doc__)
    kinds = parser.add_subparsers(dest='kind', required=True)
    guides = kinds.add_parser('waveguides', help='compute waveguides with coupled dipoles')
    guides.add_argument('--scenario', '--config', type=input_file, required=True,
                        help='YAML file of the scenario; its field board is ignored')
    guides.add_argument('--loss', type=nonnegative_float, default=3.0,
                        help='loss of the guides [dB/m]')
    guides.add_argument('--across', type=positive_float, default=0.07,
                        help='position of the elements between the walls of a guide, from 0 to 1')
    read = kinds.add_parser('touchstone', help='convert a Touchstone file; needs scikit-rf')
    read.add_argument('file', type=input_file,
                      help='Touchstone file: ports of the feeds, then those of the elements')
    read.add_argument('--feeds', type=positive_int, required=True, help='number of feeds')
    read.add_argument('--conductance', type=positive_float, required=True,
                      help='conductance of the load of an element [S]')
    read.add_argument('--slope', type=positive_float, required=True,
                      help='range of the susceptance of this load [S]')
    for one in (guides, read):
        one.add_argument('--output', type=output_file, required=True, help='file to write')
    options = parser.parse_args(arguments)
    return exit_code_of(
        lambda: _run(options), (MissingLibraryError, ValueError, TypeError), parser.prog)


def _run(options: argparse.Namespace) -> None:
    if options.kind == 'waveguides':
        fields = read_yaml(options.scenario) or {}
        fields.pop('board', None)
        arrays = board_of_guides(Scenario(**fields), options.loss, options.across)
    else:
        arrays = {**read_touchstone(options.file, options.feeds),
                  'load_conductance_s': np.array(options.conductance),
                  'load_susceptance_slope_s': np.array(options.slope)}
    network = Admittances.of(arrays)
    write_archive(options.output, arrays, {})
    n_elements, n_feeds = network.between.shape[1:]
    print(f'{options.output}: {len(network.frequencies_hz)} frequencies, {n_elements} '
          f'elements, {n_feeds} feeds, reciprocal and passive')


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
