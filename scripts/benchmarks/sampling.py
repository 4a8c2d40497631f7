"""Quality of codebooks by number of samples, with Sobol points and with random points.

Problem: the optimiser evaluates the region of interest only at samples, and overfits if there are
too few. How does the quality of the codebook on the whole region, after a fixed number of steps,
depend on the number of samples and on how they are drawn? All codebooks are evaluated on the same
held-out Sobol points.
"""

import time

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.codebook.objective import sobol
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import streams

CHOICES = (('monte_carlo', 300), ('monte_carlo', 600), ('monte_carlo', 1200), ('sobol', 64),
           ('sobol', 128), ('sobol', 256), ('sobol', 1024))
HELD_OUT, HELD_OUT_SEED = 16384, 1 << 20
# Runs of each choice, and their update steps.
SEEDS, STEPS = 5, 600


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser(
        'sampling', __doc__, default_seed=None, has_jobs=True).parse_args()
    print(f'average CRLB on {HELD_OUT} held-out points after {STEPS} steps of L-BFGS, '
          f'{SEEDS} seeds\n')
    found = frame.measured(options, 'sampling', measure, {
        f'{n} {sampling} {seed}': {'sampling': sampling, 'n': n, 'seed': seed}
        for sampling, n in CHOICES for seed in range(SEEDS)})
    table = frame.Table(['samples'], {
        'mean [m²]': ('mean_m2', 5), 'standard deviation [m²]': ('std_m2', 5),
        'time per run [s]': ('time_s', 1)})
    figures = {}
    for sampling, n in CHOICES:
        name = f'{n} {sampling}'
        bounds, times_s = zip(*(found[f'{name} {seed}'].values() for seed in range(SEEDS)),
                              strict=True)
        figures[name] = table.row(name, mean_m2=np.mean(bounds), std_m2=np.std(bounds, ddof=1),
                                  time_s=np.mean(times_s))
    frame.write_results(options.json, figures)


def measure(sampling: str, n: int, seed: int) -> dict[str, float]:
    """Run a job: optimise a codebook, and compute its average bound and the time."""
    scenario, begin = Scenario(), time.thread_time()
    codebook = optimize(scenario, sampling=sampling, n_positions=n, seed=seed,
                        max_steps=STEPS).codebook
    time_s = time.thread_time() - begin
    held_out = sobol(scenario, HELD_OUT, streams.generator(HELD_OUT_SEED, streams.HELD_OUT))
    return {'bound_m2': np.mean([crlb(scenario, codebook, part).mean()
                                 for part in np.split(held_out, 16)]), 'time_s': time_s}


if __name__ == '__main__':
    frame.run(main)
