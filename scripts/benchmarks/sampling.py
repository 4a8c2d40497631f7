"""Quality of codebooks by number of samples, with Sobol points and with random points.

Problem: the optimiser evaluates the region of interest only at samples, and overfits if there are
too few. How does the quality of the codebook on the whole region, after a fixed number of steps,
depend on the number of samples and on how they are drawn? All codebooks are evaluated on the same
held-out Sobol points.
"""

import os

# One thread. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import sys
import time

import numpy as np
from parts.command import benchmark_parser, write_results

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.codebook.objective import sobol
from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import positive_int

CHOICES = (('monte_carlo', 300), ('monte_carlo', 600), ('monte_carlo', 1200), ('sobol', 64),
           ('sobol', 128), ('sobol', 256), ('sobol', 1024))
HELD_OUT, HELD_OUT_SEED = 16384, 1 << 20


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('sampling', __doc__, default_seed=None)
    parser.add_argument('--seeds', type=positive_int, default=5, help='number of runs per choice')
    parser.add_argument('--steps', type=positive_int, default=600,
                        help='update steps of each run')
    options = parser.parse_args()
    scenario = Scenario()
    held_out = sobol(scenario, HELD_OUT, streams.generator(HELD_OUT_SEED, streams.HELD_OUT))
    print(f'average CRLB on {HELD_OUT} held-out points after {options.steps} steps of L-BFGS, '
          f'{options.seeds} seeds\n')
    print('| samples | mean [m^2] | standard deviation [m^2] | time per run [s] |')
    print('|---|---|---|---|')
    figures = {}
    for sampling, n in CHOICES:
        bounds, times_s = [], []
        for seed in range(options.seeds):
            begin = time.thread_time()
            result = optimize(scenario, sampling=sampling, n_positions=n, seed=seed,
                              max_steps=options.steps)
            times_s.append(time.thread_time() - begin)
            bounds.append(np.mean([crlb(scenario, result.codebook, part).mean()
                                   for part in np.split(held_out, 16)]))
        name = f'{n} {sampling}'
        figures[name] = {'mean_m2': np.mean(bounds), 'std_m2': np.std(bounds, ddof=1),
                         'time_s': np.mean(times_s)}
        print('| {} | {mean_m2:.5f} | {std_m2:.5f} | {time_s:.1f} |'.format(name, **figures[name]),
              flush=True)
    write_results(options.json, figures)


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
