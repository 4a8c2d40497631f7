"""Speed of the codebook optimiser.

Problem: minimise the average Cramer-Rao bound over sampled positions. (a) What does an evaluation
of the value and its gradient cost, compared with automatic differentiation of the same objective,
and with the matrix products that are unavoidable? (b) How long does each method take to reach an
average bound of 0.0415 m^2 on held-out positions? (c) How do time and memory grow with the numbers
of positions, elements and bands? (d) How much faster is the objective ambiguity on samples of its
pairs than with all pairs in each step? (e) How much time and memory do surfaces with up to 4096
elements and four bands need? Part (e) takes several minutes and is not run by default.
"""

import argparse
import importlib.util
import os
import sys
import time
from collections.abc import Callable

import numpy as np
from parts.ambiguity_speed import ambiguity_speed
from parts.frame import Table, benchmark_parser, run, shown, write_results
from parts.jax_crlb import JaxAverageCrlb
from parts.optimizer_growth import POSITIONS, growth, side_by_side, surfaces
from scipy.optimize import minimize

from rhs_isac_ros.bounds import AverageCrlb, crlb
from rhs_isac_ros.codebook import METHODS, random_codebook
from rhs_isac_ros.codebook.objective import ROW_TOLERANCE, sobol
from rhs_isac_ros.codebook.optimize import DEFAULT_POSITIONS
from rhs_isac_ros.codebook.problem import BudgetSpent, Problem, Search
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import integer, positive_float

HAVE_JAX = importlib.util.find_spec('jax') is not None
TARGET_M2 = 0.0415
HELD_OUT = 2000


def main() -> None:
    """Run the benchmark."""
    parser = benchmark_parser('optimizer', __doc__, default_seed=None)
    parser.add_argument('--threads', type=integer(1, len(os.sched_getaffinity(0))), default=1,
                        help='number of cores and threads')
    parser.add_argument('--limit', type=positive_float, default=120.0,
                        help='time limit per method in (b) [s]')
    parser.add_argument('--parts', type=parts, default='abcd', help='letters of abcde')
    options = parser.parse_args()
    restrict_to(options.threads)
    if not HAVE_JAX:
        print('JAX is not installed, so its figures are omitted; to install it: '
              'scripts/setup peers\n', file=sys.stderr)
    figures: dict = {'threads': options.threads}
    for part, measure in (
            ('a', gradient), ('b', lambda: target(options.limit)), ('c', growth),
            ('d', ambiguity_speed), ('e', surfaces)):
        if part in options.parts:
            figures |= measure()
    write_results(options.json, figures)


def parts(text: str) -> str:
    """Parse the letters of the parts, for argparse."""
    if not text or set(text) - set('abcde'):
        raise argparse.ArgumentTypeError(f'{text!r}, expected letters of abcde')
    return text


def restrict_to(n: int) -> None:
    """Restart this process on n cores with n threads; libraries read the number when loaded."""
    cores = sorted(os.sched_getaffinity(0))
    if threads() != n or len(cores) > n:
        os.sched_setaffinity(0, cores[:n])
        os.environ['OPENBLAS_NUM_THREADS'] = str(n)
        os.execv(sys.executable, [sys.executable, *sys.argv])


def threads() -> int:
    """Return the number of threads, or 0 before it is set."""
    return int(os.environ.get('OPENBLAS_NUM_THREADS', 0))


def gradient() -> dict:
    """Run part (a)."""
    scenario = Scenario()
    positions = scenario.sample_positions(POSITIONS, streams.generator(0, streams.SAMPLES))
    start = random_codebook(scenario, streams.generator(0, streams.START))
    fast = Problem(scenario, AverageCrlb(scenario, positions, ROW_TOLERANCE))
    exact = Problem(scenario, AverageCrlb(scenario, positions))
    variables = fast.pack(start)
    contenders: dict[str, Callable] = {
        'this package': lambda: fast.value_and_gradient(variables),
        'this package, exact rows': lambda: exact.value_and_gradient(variables),
        'matrix products alone': products(fast, scenario)}
    if HAVE_JAX:
        peer = JaxAverageCrlb(scenario, positions)
        contenders['JAX'] = lambda: peer(variables)
    times_s = side_by_side(contenders)
    value = {name: contenders[name]()[0] for name in ('this package', 'this package, exact rows')}
    ours = times_s['this package']
    print(f'(a) value and gradient, Table I, {POSITIONS} positions, {threads()} thread(s)\n')
    table = Table('implementation', 'ms', 'speed-up of this package')
    for name, time_s in times_s.items():
        table.row(name, shown(1e3 * time_s, 2), shown(time_s / ours, 2))
    error = value['this package'] / value['this package, exact rows'] - 1
    print(f'\nrelative error of the value: {error:.1e}; ranks {fast.objective.rows.ranks}\n')
    return {
        'gradient_ms': {name: 1e3 * time_s for name, time_s in times_s.items()},
        'gradient_speedup_vs_jax': times_s['JAX'] / ours if HAVE_JAX else None,
        'gradient_ratio_to_matrix_products': ours / times_s['matrix products alone']}


def products(problem: Problem, scenario: Scenario) -> Callable[[], list]:
    """Return a callable for the unavoidable products: rows times patterns, and the reverse."""
    rng = np.random.default_rng(0)
    size = scenario.n_subbands * scenario.n_frames
    pairs = []
    for rows in problem.objective.rows.coefficients:
        pairs.append((rows, rng.normal(size=(rows.shape[1], size)) + 0j,
                      rng.normal(size=(len(rows), size)) + 0j))
    return lambda: [(rows @ right, rows.T @ left) for rows, right, left in pairs]


def target(limit_s: float) -> dict:
    """Run part (b)."""
    scenario = Scenario()
    # Import the lazily loaded parts of SciPy before the measurement starts.
    sobol(scenario, 1, np.random.default_rng(0))
    held_out = scenario.sample_positions(HELD_OUT, streams.generator(0, streams.HELD_OUT))
    runs = {f'lbfgs, {DEFAULT_POSITIONS} Sobol': trace_of(scenario, 'lbfgs', sobol, limit_s),
            'lbfgs, 1024 Sobol': trace_of(scenario, 'lbfgs', sobol, limit_s, 1024),
            f'lbfgs, {POSITIONS} random': trace_of(
                scenario, 'lbfgs', Scenario.sample_positions, limit_s, POSITIONS)}
    for method in ('alternating', 'direct', 'genetic'):
        runs[f'{method}, {POSITIONS} random'] = trace_of(
            scenario, method, Scenario.sample_positions, limit_s, POSITIONS)
    compiled_s = 0.0
    if HAVE_JAX:
        runs['JAX + L-BFGS-B'], compiled_s = run_peer(scenario, limit_s)
    print(f'(b) time to an average bound of {TARGET_M2} m^2 on {HELD_OUT} held-out positions\n')
    table = Table('method', 's', 'evaluations', 'final bound [m²]', 'final time [s]')
    reached = {}
    for name, trace in runs.items():
        hit = first_below(scenario, trace, held_out)
        end_m2 = held_out_crlb(scenario, trace[-1], held_out)
        reached[name] = {
            'target_s': hit and hit[0], 'evaluations': hit and hit[1], 'final_m2': end_m2,
            'final_s': trace[-1][0]}
        table.row(name, *((shown(hit[0], 2), str(hit[1])) if hit else ('not reached', '')),
                  shown(end_m2, 5), shown(trace[-1][0], 1))
    ours = reached[f'lbfgs, {DEFAULT_POSITIONS} Sobol']
    peer = reached.get('JAX + L-BFGS-B', {}).get('target_s')
    figures = {
        'target': reached, 'final_average_crlb_m2': ours['final_m2'],
        'target_speedup_vs_jax': peer and ours['target_s'] and peer / ours['target_s'],
        'target_speedup_vs_jax_with_compilation':
            peer and ours['target_s'] and (peer + compiled_s) / ours['target_s'],
        'jax_compilation_s': compiled_s}
    if peer:
        print(f'\nspeed-up of lbfgs over JAX: {figures["target_speedup_vs_jax"]:.1f}; '
              f'{figures["target_speedup_vs_jax_with_compilation"]:.1f} including its '
              f'compilation of {compiled_s:.1f} s')
    print()
    return figures


# Time [s], evaluations and best variables after each step.
Trace = list[tuple[float, int, np.ndarray]]


def trace_of(scenario: Scenario, method: str, sample: Callable, limit_s: float,
        n_positions: int = DEFAULT_POSITIONS) -> Trace:
    """Run a method with its default limit of steps; the times include sampling and set-up."""
    begin = time.perf_counter()
    positions = sample(scenario, n_positions, streams.generator(0, streams.SAMPLES))
    problem = Problem(scenario, AverageCrlb(scenario, positions, ROW_TOLERANCE))
    start = problem.pack(random_codebook(scenario, streams.generator(0, streams.START)))
    trace: Trace = []

    def record(progress: object) -> None:
        elapsed_s = time.perf_counter() - begin
        trace.append((elapsed_s, progress.evaluations, search.best))
        if elapsed_s > limit_s:
            raise BudgetSpent

    search = Search(problem, start, METHODS[method].steps, None,
                    streams.generator(0, streams.METHOD), record)
    try:
        METHODS[method].minimize(search)
    except BudgetSpent:
        pass
    return trace


def run_peer(scenario: Scenario, limit_s: float) -> tuple[Trace, float]:
    """Run SciPy's L-BFGS-B on the JAX objective; return its trace and the compilation time [s]."""
    begin = time.perf_counter()
    positions = scenario.sample_positions(POSITIONS, streams.generator(0, streams.SAMPLES))
    peer = JaxAverageCrlb(scenario, positions)
    problem = Problem(scenario, None)
    start = problem.pack(random_codebook(scenario, streams.generator(0, streams.START)))
    before = time.perf_counter()
    peer(start)
    first_s = time.perf_counter() - before
    before = time.perf_counter()
    peer(start)
    compiled_s = first_s - (time.perf_counter() - before)
    begin += time.perf_counter() - before + compiled_s
    trace: Trace = []
    evaluations = 0

    def function(variables: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal evaluations
        evaluations += 1
        return peer(variables)

    def record(variables: np.ndarray) -> None:
        trace.append((time.perf_counter() - begin, evaluations, np.array(variables)))
        if trace[-1][0] > limit_s:
            raise BudgetSpent

    try:
        minimize(function, start, jac=True, method='L-BFGS-B', bounds=problem.bounds,
                 callback=record, options={'maxiter': METHODS['lbfgs'].steps, 'maxfun': 10**6})
    except BudgetSpent:
        pass
    return trace, compiled_s


def held_out_crlb(scenario: Scenario, entry: tuple, held_out: np.ndarray) -> float:
    """Return the average bound of an entry of a trace on held-out positions [m^2]."""
    return float(crlb(scenario, Problem(scenario, None).unpack(entry[2]), held_out).mean())


def first_below(scenario: Scenario, trace: Trace, held_out: np.ndarray) -> tuple | None:
    """Return the first entry that reaches the target, by bisection; None if the last does not."""
    if held_out_crlb(scenario, trace[-1], held_out) > TARGET_M2:
        return None
    low, high = 0, len(trace) - 1
    while low < high:
        middle = (low + high) // 2
        if held_out_crlb(scenario, trace[middle], held_out) <= TARGET_M2:
            high = middle
        else:
            low = middle + 1
    return trace[high]


if __name__ == '__main__':
    run(main)
