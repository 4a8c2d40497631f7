"""Parts (c) and (e) of the benchmark of the optimizer: time and memory by the size of the problem.

As a program, it measures the sizes in its argument, a JSON object, on the cores assigned to it.
"""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from parts.frame import Table, shown

from rhs_isac_ros.bounds import AverageCrlb
from rhs_isac_ros.codebook import Progress, optimize, random_codebook
from rhs_isac_ros.codebook.objective import ROW_TOLERANCE
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import streams

POSITIONS = 1200
# Sizes to measure: numbers of positions, elements and bands.
GROWTH = {'N_sam': (100, 300, 1000, 3000, 10000), 'N_E': (100, 256, 484, 1024),
          'N_B': (1, 2, 4, 8)}
LARGE = {'N_sam': POSITIONS, 'N_E': 1024, 'N_B': 4}
# Numbers of elements of part (e), and steps of its optimisation.
SURFACES = (64, 256, 1024, 4096)
STEPS = 10


def growth() -> dict:
    """Run part (c), each size in a new process so that its peak memory can be measured."""
    print('(c) growth: set-up, value with gradient, peak memory of the process\n')
    table = Table('size', 'set-up [s]', 'evaluation [ms]', 'peak [MiB]', 'ranks')
    base = {'N_sam': POSITIONS, 'N_E': 100, 'N_B': 2}
    sizes = {f'{symbol} = {value}': base | {symbol: value}
             for symbol, values in GROWTH.items() for value in values}
    large = ', '.join(f'{symbol} = {value}' for symbol, value in LARGE.items())
    rows = {name: measure(one) for name, one in (sizes | {large: LARGE}).items()}
    for name, row in rows.items():
        table.row(name, shown(row['setup_s'], 2), shown(row['evaluation_ms'], 1),
                  shown(row['peak_mib'], 0), ', '.join(map(str, row['ranks'])))

    def relative_to_linear(symbol: str, a: int, b: int) -> float:
        first, second = (rows[f'{symbol} = {n}']['evaluation_ms'] for n in (a, b))
        return second / first * a / b

    whole = {symbol: relative_to_linear(symbol, values[0], values[-1])
             for symbol, values in GROWTH.items()}
    step = {symbol: max(relative_to_linear(symbol, *pair)
                        for pair in zip(values, values[1:], strict=False))
            for symbol, values in GROWTH.items()}
    print('\nrelative to linear growth, overall (and in the steepest step): '
          + ', '.join(f'{s} {whole[s]:.2f} ({step[s]:.2f})' for s in GROWTH) + '\n')
    return {'growth': rows, 'growth_to_linear': whole, 'growth_to_linear_steepest': step,
            'large_peak_mib': rows[large]['peak_mib']}


def surfaces() -> dict:
    """Run part (e), each size in a new process so that its peak memory can be measured."""
    print(f'(e) large surfaces: optimize(max_steps={STEPS}), four bands, default positions\n')
    table = Table('N_E', 'set-up, CPU [s]', 'step, CPU [s]', 'peak [MiB]')
    rows = {n: measure({'N_E': n, 'N_B': 4, 'steps': STEPS}) for n in SURFACES}
    for n, row in rows.items():
        table.row(str(n), shown(row['setup_s'], 2), shown(row['step_s'], 3),
                  shown(row['peak_mib'], 0))
    powers = {}
    for name in ('setup_s', 'step_s', 'peak_mib'):
        values = np.log([row[name] for row in rows.values()])
        powers[name] = (np.diff(values) / np.diff(np.log(SURFACES))).tolist()
    print('\nexponent of N_E from one size to the next: ' + '; '.join(
        f'{name} ' + ', '.join(f'{power:.2f}' for power in values)
        for name, values in powers.items()) + '\n')
    return {'surfaces': rows, 'surfaces_exponents': powers}


def measure(sizes: dict[str, int]) -> dict:
    """Measure one size in a new process."""
    done = subprocess.run(
        [sys.executable, '-m', 'parts.optimizer_growth', json.dumps(sizes)],
        cwd=Path(__file__).parents[1], stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def grow(sizes: dict[str, int]) -> dict:
    """Measure set-up time, evaluation time, and peak memory of this process."""
    scenario = scenario_of(sizes)
    positions = scenario.sample_positions(sizes['N_sam'], streams.generator(0, streams.SAMPLES))
    codebook = random_codebook(scenario, streams.generator(0, streams.START))
    begin = time.perf_counter()
    average = AverageCrlb(scenario, positions, ROW_TOLERANCE)
    setup_s = time.perf_counter() - begin
    average(codebook)
    seconds = side_by_side({'evaluation': lambda: average(codebook)}, 15)['evaluation']
    return {'setup_s': setup_s, 'evaluation_ms': 1e3 * seconds, 'peak_mib': peak_mib(),
            'ranks': average.rows.ranks}


def optimize_surface(sizes: dict[str, int]) -> dict:
    """Measure an optimisation of few steps, and the peak memory of this process."""
    scenario = scenario_of(sizes)
    times_s: list[float] = []
    begin = time.process_time()

    def record(entry: Progress) -> None:
        # The value is infinite during the set-up.
        if np.isfinite(entry.value_m2):
            times_s.append(time.process_time() - begin)

    optimize(scenario, max_steps=sizes['steps'], progress=record)
    return {'setup_s': times_s[0], 'step_s': float(np.median(np.diff(times_s))),
            'peak_mib': peak_mib()}


def scenario_of(sizes: dict[str, int]) -> Scenario:
    """Return a scenario with these numbers of elements and bands."""
    return Scenario(
        center_frequencies_hz=tuple(2e9 + 0.5e9 * (i + 1) for i in range(sizes['N_B'])),
        elements_per_side=round(sizes['N_E']**0.5))


def peak_mib() -> float:
    """Return the peak memory of this process [MiB]."""
    # getrusage would include the peak of the process that this one was forked from.
    peak = re.search(r'VmHWM:\s*(\d+) kB', Path('/proc/self/status').read_text(encoding='ascii'))
    return int(peak[1]) / 1024


def side_by_side(contenders: dict[str, Callable], rounds: int = 25) -> dict[str, float]:
    """Return median times [s], measured in turn so that a disturbance affects all contenders."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, function in contenders.items():
            begin = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - begin)
    return {name: float(np.median(values[3:])) for name, values in times.items()}


if __name__ == '__main__':
    chosen = json.loads(sys.argv[1])
    print(json.dumps(optimize_surface(chosen) if 'steps' in chosen else grow(chosen)))
