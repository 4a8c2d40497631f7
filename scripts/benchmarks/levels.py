"""Average bound of codebooks for elements that can take only a few amplitudes.

Problem: an element of a real surface has two, three or four amplitudes. How much does the average
bound grow if the continuous amplitudes of a codebook are rounded to these levels, and how much if
the codebook is optimised for them? All codebooks are evaluated on the same held-out positions.
"""

import dataclasses
import time

from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import on_levels
from rhs_isac_ros.support import streams

HELD_OUT = 2000


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser('levels', __doc__, default_seed=0).parse_args()
    free = Scenario()
    held_out = free.sample_positions(
        HELD_OUT, streams.generator(options.seed, streams.HELD_OUT))
    print(f'average CRLB on {HELD_OUT} held-out positions, seed {options.seed}\n')
    table = frame.Table(['levels'], {
        'rounded [m²]': ('rounded_m2', 4), 'optimised [m²]': ('optimised_m2', 4),
        'CPU time [s]': ('time_s', 1)})
    figures, continuous = {}, None
    for levels in (0, 2, 3, 4):
        scenario, begin = dataclasses.replace(free, amplitude_levels=levels), time.thread_time()
        optimised = optimize(scenario, seed=options.seed).codebook
        time_s, rounded_m2 = time.thread_time() - begin, None
        continuous = continuous or optimised
        if levels:
            rounded = dataclasses.replace(
                continuous, analog=on_levels(scenario, continuous.analog))
            rounded_m2 = crlb(free, rounded, held_out).mean()
        name = str(levels or 'continuous')
        figures[name] = table.row(
            name, rounded_m2=rounded_m2, optimised_m2=crlb(free, optimised, held_out).mean(),
            time_s=time_s)
    frame.write_results(options.json, figures)


if __name__ == '__main__':
    frame.run(main)
