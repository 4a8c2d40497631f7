"""Average bound of codebooks for elements that can take only a few amplitudes.

Problem: an element of a real surface has two, three or four amplitudes. How much does the average
bound grow if the continuous amplitudes of a codebook are rounded to these levels, and how much if
the codebook is optimised for them? All codebooks are evaluated on the same held-out positions.
"""

import os

# One thread. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import dataclasses
import sys
import time

from parts.command import benchmark_parser, write_results

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, optimize
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.experiments import markdown_table
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.model.surface import on_levels
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import (
    input_file,
    positive_int,
)

LEVELS = (2, 3, 4)
HELD_OUT = 2000


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('levels', __doc__, default_seed=0)
    parser.add_argument('--scenario', type=input_file, help='YAML file of the scenario')
    parser.add_argument('--steps', type=positive_int, default=3000,
                        help='maximum number of update steps of each codebook')
    options = parser.parse_args()
    given = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    free = dataclasses.replace(given, amplitude_levels=0)
    held_out = free.sample_positions(
        HELD_OUT, streams.generator(options.seed, streams.HELD_OUT))

    def bound(codebook: Codebook) -> float:
        return float(crlb(free, codebook, held_out).mean())

    begin = time.thread_time()
    continuous = optimize(free, seed=options.seed, max_steps=options.steps).codebook
    figures = {'continuous': {
        'optimised_m2': bound(continuous), 'time_s': time.thread_time() - begin}}
    for levels in LEVELS:
        scenario, begin = dataclasses.replace(free, amplitude_levels=levels), time.thread_time()
        optimised = optimize(scenario, seed=options.seed, max_steps=options.steps).codebook
        rounded = dataclasses.replace(continuous, analog=on_levels(scenario, continuous.analog))
        figures[str(levels)] = {
            'optimised_m2': bound(optimised), 'rounded_m2': bound(rounded),
            'time_s': time.thread_time() - begin}
    print(f'average CRLB on {HELD_OUT} held-out positions, seed {options.seed}\n')
    print(markdown_table(
        ['levels', 'rounded [m²]', 'optimised [m²]', 'CPU time [s]'],
        [[name, f'{row["rounded_m2"]:.4f}' if 'rounded_m2' in row else '–',
          f'{row["optimised_m2"]:.4f}', f'{row["time_s"]:.1f}'] for name, row in figures.items()]))
    write_results(options.json, figures)


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (ScenarioError,)))
