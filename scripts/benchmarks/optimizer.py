"""Speed of the codebook optimiser.

Problem: minimise the average Cramer-Rao bound over sampled positions, on one core. (a) What does
an evaluation of the value and its gradient cost, compared with automatic differentiation of the
same objective, and with the matrix products that are unavoidable? (b) How long does each method
take to reach an average bound of 0.0415 m^2 on held-out positions? (c) How much time and memory do
surfaces with up to 4096 elements and four bands need?
"""

import importlib.util
import os
import sys
import time
from collections.abc import Callable

import numpy as np
from parts import frame
from scipy.optimize import minimize

from rhs_isac_ros.bounds import AverageCrlb, crlb
from rhs_isac_ros.codebook import METHODS, Progress, optimize, random_codebook
from rhs_isac_ros.codebook.objective import ROW_TOLERANCE, sobol
from rhs_isac_ros.codebook.optimize import DEFAULT_POSITIONS
from rhs_isac_ros.codebook.problem import BudgetSpent, Problem, Search
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_and_derivative
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.surface import onboard_matrix
from rhs_isac_ros.support import streams

HAVE_JAX = importlib.util.find_spec('jax') is not None
POSITIONS, HELD_OUT, TARGET_M2 = 1200, 2000, 0.0415
# Time limit of each method in part (b) [s].
LIMIT_S = 120.0
# Numbers of elements of part (c), and steps of its optimisation.
SURFACES, STEPS = (64, 256, 1024, 4096), 10


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('optimizer', __doc__, default_seed=None)
    parts = {'a': gradient, 'b': target, 'c': surfaces}
    parser.add_argument('--parts', nargs='+', choices=parts, default=[*parts], help='only these')
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if not HAVE_JAX:
        print('JAX is not installed, so its figures are omitted; to install it: '
              'scripts/setup peers\n', file=sys.stderr)
    frame.write_results(options.json, {part: parts[part]() for part in options.parts})


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
    print(f'(a) value and gradient, Table I, {POSITIONS} positions\n')
    table = frame.Table(['implementation'], {
        'ms': ('ms', 2), 'speed-up of this package': ('ratio', 2)})
    figures = {name: table.row(name, ms=1e3 * time_s, ratio=time_s / times_s['this package'])
               for name, time_s in times_s.items()}
    error = value['this package'] / value['this package, exact rows'] - 1
    print(f'\nrelative error of the value: {error:.1e}; ranks {fast.objective.rows.ranks}\n')
    return figures


def side_by_side(contenders: dict[str, Callable]) -> dict[str, float]:
    """Return median times [s], measured in turn so that a disturbance affects all contenders."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(25):
        for name, function in contenders.items():
            begin = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - begin)
    return {name: float(np.median(values[3:])) for name, values in times.items()}


def products(problem: Problem, scenario: Scenario) -> Callable[[], list]:
    """Return a callable for the unavoidable products: rows times patterns, and the reverse."""
    rng = np.random.default_rng(0)
    size = scenario.n_subbands * scenario.n_frames
    pairs = []
    for rows in problem.objective.rows.coefficients:
        pairs.append((rows, rng.normal(size=(rows.shape[1], size)) + 0j,
                      rng.normal(size=(len(rows), size)) + 0j))
    return lambda: [(rows @ right, rows.T @ left) for rows, right, left in pairs]


def target() -> dict:
    """Run part (b)."""
    scenario = Scenario()
    # Import the lazily loaded parts of SciPy before the measurement starts.
    sobol(scenario, 1, np.random.default_rng(0))
    held_out = scenario.sample_positions(HELD_OUT, streams.generator(0, streams.HELD_OUT))
    runs = {f'lbfgs, {DEFAULT_POSITIONS} Sobol': trace_of(scenario, 'lbfgs', sobol)}
    for method in ('lbfgs', 'alternating', 'direct', 'genetic'):
        runs[f'{method}, {POSITIONS} random'] = trace_of(
            scenario, method, Scenario.sample_positions, POSITIONS)
    compiled_s = 0.0
    if HAVE_JAX:
        runs['JAX + L-BFGS-B'], compiled_s = run_peer(scenario)
    print(f'(b) time to an average bound of {TARGET_M2} m^2 on {HELD_OUT} held-out positions\n')
    table = frame.Table(['method'], {
        's': ('target_s', 2), 'evaluations': ('evaluations', 0),
        'final bound [m²]': ('final_m2', 5), 'final time [s]': ('final_s', 1)})
    figures: dict = {}
    for name, trace in runs.items():
        hit = first_below(scenario, trace, held_out)
        figures[name] = table.row(
            name, target_s=hit and hit[0], evaluations=hit and hit[1],
            final_m2=held_out_crlb(scenario, trace[-1], held_out), final_s=trace[-1][0])
    if HAVE_JAX:
        print(f'\nJAX compiled for {compiled_s:.1f} s, which its times exclude')
    print()
    return figures | {'jax_compilation_s': compiled_s}


# Time [s], evaluations and best variables after each step.
Trace = list[tuple[float, int, np.ndarray]]


def trace_of(scenario: Scenario, method: str, sample: Callable,
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
        if elapsed_s > LIMIT_S:
            raise BudgetSpent

    search = Search(problem, start, METHODS[method].steps, None,
                    streams.generator(0, streams.METHOD), record)
    try:
        METHODS[method].minimize(search)
    except BudgetSpent:
        pass
    return trace


def run_peer(scenario: Scenario) -> tuple[Trace, float]:
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
        if trace[-1][0] > LIMIT_S:
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


class JaxAverageCrlb:
    """Average bound at fixed positions with its gradient, compiled, in double precision.

    Parameters
    ----------
    positions
        Float64 [N, 3] [m].
    """

    def __init__(self, scenario: Scenario, positions: np.ndarray) -> None:
        import jax
        import jax.numpy as jnp

        jax.config.update('jax_enable_x64', True)
        self._block = jax.block_until_ready
        n, n_bands, n_subbands = len(positions), scenario.n_bands, scenario.n_subbands
        n_rows = n_subbands * scenario.n_frames
        # With the sub-bands first, the products read contiguous memory.
        derivatives = np.stack([
            np.moveaxis(los_and_derivative(scenario, positions, band)[1], 2, 0).reshape(
                n_subbands, 3 * n, scenario.n_elements) for band in range(n_bands)])
        self._constants = [jnp.asarray(array) for array in (
            derivatives, onboard_matrix(scenario), multipath_covariance(scenario),
            measurement_correlation(scenario))]
        noise = scenario.noise_power_w * jnp.eye(n_rows)
        self._shapes = ((n_bands, scenario.n_frames, scenario.n_elements),
                        (n_bands, n_subbands, scenario.n_frames, scenario.n_feeds))
        root_power = np.sqrt(scenario.max_power_w)

        def bound(analog, real, imag, derivatives, onboard, spatial, correlation):
            raw = real + 1j * imag
            norm = jnp.sqrt(jnp.sum(real**2 + imag**2, axis=(1, 3), keepdims=True))
            patterns = analog[:, None] * jnp.matmul(raw * (root_power / norm), onboard)
            means = jnp.matmul(derivatives, jnp.swapaxes(patterns, 2, 3))
            means = jnp.transpose(means, (0, 1, 3, 2)).reshape(n_bands, n_rows, 3 * n)
            rows = patterns.reshape(n_bands, n_rows, -1)
            scattered = rows @ spatial @ jnp.conj(jnp.swapaxes(rows, 1, 2))
            factor = jnp.linalg.cholesky(correlation * scattered + noise)
            whitened = jax.scipy.linalg.solve_triangular(factor, means, lower=True)
            whitened = whitened.reshape(n_bands, n_rows, n, 3)
            information = 2 * jnp.real(
                jnp.einsum('iknu,iknv->nuv', jnp.conj(whitened), whitened))
            return jnp.mean(jnp.trace(jnp.linalg.inv(information), axis1=1, axis2=2))

        self._function: Callable = jax.jit(jax.value_and_grad(bound, argnums=(0, 1, 2)))

    def __call__(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        """Return value [m^2] and gradient, float64 [n], at variables in the order of `Problem`."""
        analog_shape, digital_shape = self._shapes
        analog = variables[:np.prod(analog_shape)].reshape(analog_shape)
        real, imag = variables[analog.size:].reshape(2, *digital_shape)
        value, gradients = self._block(self._function(analog, real, imag, *self._constants))
        return float(value), np.concatenate([np.asarray(g).ravel() for g in gradients])


def surfaces() -> dict:
    """Run part (c), each size in a new process so that its peak memory can be measured."""
    print(f'(c) large surfaces: optimize(max_steps={STEPS}), four bands, default positions\n')
    table = frame.Table(['N_E'], {
        'set-up, CPU [s]': ('setup_s', 2), 'step, CPU [s]': ('step_s', 3),
        'peak [MiB]': ('peak_mib', 0)})
    return {n: table.row(str(n), **frame.in_new_process(optimize_surface, n)) for n in SURFACES}


def optimize_surface(n_elements: int) -> dict:
    """Measure an optimisation of few steps, and the peak memory of this process."""
    scenario = Scenario(center_frequencies_hz=(2.5e9, 3e9, 3.5e9, 4e9),
                        elements_per_side=round(n_elements**0.5))
    times_s: list[float] = []
    begin = time.process_time()

    def record(entry: Progress) -> None:
        # The value is infinite during the set-up.
        if np.isfinite(entry.value_m2):
            times_s.append(time.process_time() - begin)

    optimize(scenario, max_steps=STEPS, progress=record)
    return {'setup_s': times_s[0], 'step_s': float(np.median(np.diff(times_s))),
            'peak_mib': frame.peak_mib()}


if __name__ == '__main__':
    frame.run(main)
