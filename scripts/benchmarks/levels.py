"""Average bound of codebooks for elements that can take only a few amplitudes.

Problem: an element of a real surface has two, three or four amplitudes. How much does the average
bound grow if the continuous amplitudes of a codebook are rounded to these levels, and how much if
the codebook is optimised for them? All codebooks are evaluated on the same held-out positions.
"""

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, optimize
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import on_levels
from rhs_isac_ros.support import streams

HELD_OUT = 2000
LEVELS = 0, 2, 3, 4


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser(
        'levels', __doc__, default_seed=0, has_jobs=True).parse_args()
    free = Scenario()
    held_out = free.sample_positions(
        HELD_OUT, streams.generator(options.seed, streams.HELD_OUT))
    print(f'average CRLB on {HELD_OUT} held-out positions, seed {options.seed}\n')
    table = frame.Table(['levels'], {
        'rounded [m²]': ('rounded_m2', 4), 'optimised [m²]': ('optimised_m2', 4),
        'CPU time [s]': ('time_s', 1)})
    found = frame.measured(options, 'levels', optimised, {
        str(levels or 'continuous'): {'levels': levels, 'seed': options.seed}
        for levels in LEVELS})
    codebooks = {name: Codebook.from_parameters(one['codebook']) for name, one in found.items()}
    continuous, figures = codebooks['continuous'], {}
    for levels, (name, codebook) in zip(LEVELS, codebooks.items(), strict=True):
        rounded = dataclasses.replace(continuous, analog=on_levels(
            dataclasses.replace(free, amplitude_levels=levels), continuous.analog))
        figures[name] = table.row(
            name, rounded_m2=crlb(free, rounded, held_out).mean() if levels else None,
            optimised_m2=crlb(free, codebook, held_out).mean(), time_s=found[name]['time_s'])
    frame.write_results(options.json, figures)


def optimised(levels: int, seed: int) -> Mapping[str, Any]:
    """Optimise a codebook for some levels, or for continuous amplitudes with 0."""
    begin = time.thread_time()
    codebook = optimize(Scenario(amplitude_levels=levels), seed=seed).codebook
    return {'time_s': time.thread_time() - begin, 'codebook': codebook.to_parameters()}


if __name__ == '__main__':
    frame.run(main)
