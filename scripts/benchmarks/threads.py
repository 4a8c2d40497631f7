"""Threads of BLAS: the calls of README.md with an untouched environment and with one thread.

Problem: by default, BLAS starts a thread for each core. Small matrix products then take longer,
and many times as long if other processes use the cores. The package limits the threads itself. How
long do its calls take with an untouched environment, relative to a process with
OPENBLAS_NUM_THREADS=1, while all cores but one are busy?

Both processes take turns, so that a disturbance affects both. With --unlimited, a third process
runs without the limit.
"""

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from rhs_isac_ros.bounds import average_crlb, crlb
from rhs_isac_ros.codebook import Codebook, default_codebook_file, optimize
from rhs_isac_ros.link import capacity, steer
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator, simulate_pairs
from rhs_isac_ros.support import threads
from rhs_isac_ros.support.arguments import ArgumentParser, positive_int

VARIABLES = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')
CONTENDERS = {'one thread': 'one', 'untouched': 'untouched', 'without the limit': 'unlimited'}


def main() -> None:
    """Run the benchmark."""
    parser = ArgumentParser(
        prog='scripts/benchmark threads', description=__doc__.partition('\n')[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--rounds', type=positive_int, default=7, help='repetitions of each call')
    parser.add_argument('--idle', action='store_true', help='leave the other cores idle')
    parser.add_argument('--unlimited', action='store_true',
                        help='measure without the limit, too')
    parser.add_argument('--worker', choices=CONTENDERS.values(), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(options.worker)
        return
    names = list(CONTENDERS)[:3 if options.unlimited else 2]
    n_busy = 0 if options.idle else len(os.sched_getaffinity(0)) - 1
    with busy_cores(n_busy):
        times_s = measure([CONTENDERS[name] for name in names], options.rounds)
    print(f'{n_busy} busy core(s); median of {options.rounds} rounds\n')
    print('| call | ' + ' | '.join(f'{name} [ms]' for name in names) + ' | ratio |')
    print('|---' * (len(names) + 2) + '|')
    for task, rows in times_s.items():
        medians = np.median(rows, axis=0)
        print(f'| {task} | ' + ' | '.join(f'{1e3 * median:.2f}' for median in medians)
              + f' | {np.median(rows[:, 1] / rows[:, 0]):.2f} |')
    print(f'\nentering and leaving the limit: {limit_cost_s() * 1e6:.1f} us')


@contextmanager
def busy_cores(n: int) -> Iterator[None]:
    """Keep n cores busy with processes of the same priority."""
    context = multiprocessing.get_context('spawn')
    processes = [context.Process(target=spin, daemon=True) for _ in range(n)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def spin() -> None:
    """Use a core until the process is killed."""
    while True:
        pass


def measure(contenders: list[str], rounds: int) -> dict[str, np.ndarray]:
    """Return the times [s] of each task, [rounds, contenders]."""
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    workers = [
        subprocess.Popen(
            [sys.executable, __file__, '--worker', kind], text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment | ({VARIABLES[0]: '1'} if kind == 'one' else {}))
        for kind in contenders]
    found: dict[str, list[list[float]]] = {}
    # The first round imports libraries and fills caches.
    for number in range(rounds + 1):
        for task in tasks():
            row = []
            for worker in workers:
                worker.stdin.write(f'{json.dumps(task)}\n')
                worker.stdin.flush()
                row.append(float(worker.stdout.readline()))
            if number:
                found.setdefault(task, []).append(row)
    for worker in workers:
        worker.stdin.close()
        worker.wait()
    return {task: np.array(rows) for task, rows in found.items()}


def work(kind: str) -> None:
    """Run the tasks whose names arrive on the standard input, and print their times [s]."""
    if kind == 'unlimited':
        threads.one_blas_thread.find_libraries = lambda: None
        threads.one_blas_thread._shared = threads.one_blas_thread._per_thread = []
    functions = tasks()
    for line in sys.stdin:
        function = functions[json.loads(line)]
        begin = time.perf_counter()
        function()
        print(time.perf_counter() - begin, flush=True)


def tasks() -> dict[str, Callable]:
    """Return the calls of README.md by their names."""
    scenario, codebook = Scenario(), Codebook.load(default_codebook_file())
    rng = np.random.default_rng(1)
    positions = scenario.sample_positions(3, rng)
    _, received = simulate_pairs(scenario, codebook, 3, 1)
    estimators = []

    def estimate() -> None:
        if not estimators:
            estimators.append(make_estimator('bayes', scenario, codebook))
        for _ in range(10):
            estimators[0].estimate(received)

    def transmit() -> None:
        beam = steer(scenario, positions[0])
        capacity(scenario, beam, positions[:1])

    return {
        'crlb': lambda: crlb(scenario, codebook, positions),
        'average_crlb': lambda: average_crlb(scenario, codebook, positions),
        'simulate_received': lambda: simulate_received(scenario, codebook, positions, rng),
        'make_estimator': lambda: make_estimator('bayes', scenario, codebook),
        'estimate, 10 times 3 fixes': estimate,
        'steer, capacity': transmit,
        'optimize, 50 steps': lambda: optimize(scenario, seed=2, max_steps=50),
    }


def limit_cost_s(n: int = 2000) -> float:
    """Return the time to enter and to leave the limit of the threads [s]."""
    begin = time.perf_counter()
    for _ in range(n):
        with threads.one_blas_thread:
            pass
    return (time.perf_counter() - begin) / n


if __name__ == '__main__':
    main()
