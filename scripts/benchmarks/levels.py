"""Average bound of codebooks for elements that can take only a few amplitudes.

Problem: an element of a real surface has two, three or four amplitudes. How much does the average
bound grow if the continuous amplitudes of a codebook are rounded to these levels, and how much if
the codebook is optimised for them? All codebooks are evaluated on the same held-out positions.
"""

import dataclasses
import time

from parts.frame import Table, benchmark_parser, run, scenario_of, shown, write_results

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.model.surface import on_levels
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import input_file, positive_int

HELD_OUT = 2000


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('levels', __doc__, default_seed=0)
    parser.add_argument('--scenario', type=input_file, help='YAML file of the scenario')
    parser.add_argument('--steps', type=positive_int, default=3000,
                        help='maximum number of update steps of each codebook')
    options = parser.parse_args()
    free = dataclasses.replace(scenario_of(options.scenario), amplitude_levels=0)
    held_out = free.sample_positions(
        HELD_OUT, streams.generator(options.seed, streams.HELD_OUT))
    print(f'average CRLB on {HELD_OUT} held-out positions, seed {options.seed}\n')
    table = Table('levels', 'rounded [m²]', 'optimised [m²]', 'CPU time [s]')
    figures, continuous = {}, None
    for levels in (0, 2, 3, 4):
        scenario, begin = dataclasses.replace(free, amplitude_levels=levels), time.thread_time()
        optimised = optimize(scenario, seed=options.seed, max_steps=options.steps).codebook
        time_s, rounded_m2 = time.thread_time() - begin, None
        continuous = continuous or optimised
        if levels:
            rounded = dataclasses.replace(
                continuous, analog=on_levels(scenario, continuous.analog))
            rounded_m2 = crlb(free, rounded, held_out).mean()
        name = str(levels or 'continuous')
        figures[name] = {'optimised_m2': crlb(free, optimised, held_out).mean(), 'time_s': time_s}
        if levels:
            figures[name]['rounded_m2'] = rounded_m2
        table.row(name, shown(rounded_m2, 4), shown(figures[name]['optimised_m2'], 4),
                  shown(time_s, 1))
    write_results(options.json, figures)


if __name__ == '__main__':
    run(main)
