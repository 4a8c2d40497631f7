"""Optimisation methods: each minimises a `Search` and returns the reason for stopping.

The default method is L-BFGS-B. For objectives with many pairs, it evaluates samples of them. For
elements with discrete levels, it ends with changes of single amplitudes. The alternating, direct
and genetic methods are described in the paper and its references.
"""

import itertools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rhs_isac_ros.codebook.problem import Search
from rhs_isac_ros.support.optional import optional_import

# Number of corrections that approximate the Hessian: more than SciPy's default of 10, because
# evaluations are expensive.
_MEMORY = 30


# Objectives with fewer pairs are evaluated with all pairs.
FEWEST_PAIRS = 4096


def minimize_lbfgs(search: Search) -> str:
    """Minimise with L-BFGS-B, and return the reason for stopping.

    Discrete levels and objectives with many pairs have variants of their own.
    """
    if search.problem.scenario.amplitude_levels:
        return minimize_levels(search)
    if search.problem.n_pairs >= FEWEST_PAIRS:
        return minimize_sampled(search)
    return minimize_exactly(search)


def minimize_exactly(search: Search) -> str:
    """Minimise with L-BFGS-B on all pairs; return the reason for stopping."""
    result = run_lbfgs(search.value_and_gradient, search.start, search.bounds, search.max_steps,
                       search.on_step)
    return 'max_steps reached' if result.status == 1 else str(result.message)


def run_lbfgs(
        objective: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray,
        bounds: Sequence[tuple[float, float] | tuple[None, None]], max_steps: int,
        on_step: Callable[[], None], memory: int = _MEMORY) -> Any:
    """Minimise a function that returns its value and gradient, with SciPy's L-BFGS-B.

    The values must not be negative; their unit does not affect the steps. In SciPy's result, `fun`
    and `jac` are relative to the first value, unless that is 0. `on_step` is called after each
    step.
    """
    # A slow import, which loading a codebook does not need.
    from scipy.optimize import minimize

    unit = 0.0

    def relative(variables: np.ndarray) -> tuple[float, np.ndarray]:
        """Divide by the first value, because SciPy's tolerances assume values of about 1."""
        nonlocal unit
        value, gradient = objective(variables)
        unit = unit or value or 1.0
        return value / unit, gradient / unit

    return minimize(
        relative, start, jac=True, method='L-BFGS-B', bounds=bounds,
        callback=lambda _: on_step(),
        options={'maxiter': max_steps, 'maxfun': 20 * max_steps,
                 'maxcor': memory, 'ftol': 1e-10, 'gtol': 1e-10})


# Pairs and steps of each round. The first steps change the codebook, and with it the important
# pairs, the most. Later steps need a more accurate objective.
_ROUNDS = (2048, 200), (4096, 600)
# Number of corrections. With more corrections, their products would take longer than evaluations.
_SAMPLED_MEMORY = 100
# Scale of the combining vectors, to which the objective is more sensitive than to configurations.
_DIGITAL_SCALE = 0.3


def minimize_sampled(search: Search, rounds: Sequence[tuple[int, int]] = _ROUNDS) -> str:
    """Minimise with L-BFGS-B on samples of the pairs; return the reason for stopping.

    Each round draws a sample for the codebook of the previous round (`PairwiseErrorCost.sample`)
    and evaluates the result with all pairs. The search ends when no steps are left, or when a
    round does not lower the objective. `rounds` are numbers of pairs and steps; the last entry is
    repeated.
    """
    variables, left = search.start, search.max_steps
    value = search.value_m2
    for n_pairs, steps in itertools.chain(rounds, itertools.repeat(rounds[-1])):
        done, variables = _round(search, variables, min(n_pairs, search.problem.n_pairs),
                                 min(steps, left))
        left -= done
        if not left:
            return 'max_steps reached'
        if search.value_m2 >= value:
            return 'no round of steps on a sample lowers the objective'
        value = search.value_m2
    raise AssertionError('unreachable: the rounds are endless')


def _round(search: Search, start: np.ndarray, n_pairs: int, steps: int) -> tuple[int, np.ndarray]:
    """Minimise the objective on one sample; return the number of steps and the lowest point."""
    scale = np.ones(len(start))
    scale[search.n_analog:] = _DIGITAL_SCALE
    sample = search.sample(start, n_pairs)
    lowest, point, done = np.inf, start, 0

    def objective(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal lowest, point
        value, gradient = sample(scaled * scale)
        if value < lowest:
            lowest, point = value, scaled * scale
        return value, gradient * scale

    def on_step() -> None:
        nonlocal done
        # A step is recorded when the next one ends, and the last one with the value for all pairs.
        if done:
            search.on_step()
        done += 1

    try:
        run_lbfgs(objective, start / scale, search.bounds, steps, on_step, _SAMPLED_MEMORY)
    finally:
        # Also after Ctrl-C, and if the sample has used all evaluations but one.
        if done:
            search.value(point)
            search.on_step()
    return done, point


# Weights of the penalty in its rounds, relative to the objective.
_WEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0)
# Shares of the steps without and with the penalty; the rest is for changes of single amplitudes.
_RELAXED, _PENALISED = 0.4, 0.3
# Maximum number of steps on the combining vectors before each sweep.
_DIGITAL_STEPS = 20
# Number of successive attempts that do not lower the objective after which a sweep ends.
_MAX_FAILURES = 64


def minimize_levels(search: Search) -> str:
    """Minimise over amplitudes with L discrete levels, and return the reason for stopping.

    The first of three stages treats amplitudes as continuous. The second adds the penalty
    sin^2(pi (L - 1) c) for each amplitude c, which is zero at the levels. Its weight grows, and
    amplitudes move to the levels while all other variables adapt. The third moves single
    amplitudes to neighbouring levels, those with the largest gradient first, as long as this
    lowers the objective. All stages minimise over continuous variables with L-BFGS-B.
    """
    share = _PENALISED / len(_WEIGHTS)
    variables, left = search.start, search.max_steps
    for weight, part in ((0.0, _RELAXED), *((weight, share) for weight in _WEIGHTS)):
        # Each round has at least one step if any are left.
        steps = min(max(int(part * search.max_steps), 1), left)
        if steps:
            variables = _penalised(search, variables, weight, steps)
        left -= steps
    return _exchange(search, variables, left)


def _penalised(search: Search, start: np.ndarray, weight: float, max_steps: int) -> np.ndarray:
    """Minimise with continuous amplitudes and a penalty; evaluate the end point with levels."""
    scale = weight * search.relaxed_value_and_gradient(start)[0] / search.n_analog
    frequency = np.pi * _top_level(search)

    def objective(variables: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = search.relaxed_value_and_gradient(variables)
        phase = frequency * variables[:search.n_analog]
        gradient[:search.n_analog] += scale * frequency * np.sin(2 * phase)
        return value + scale * float(np.sum(np.sin(phase)**2)), gradient

    result = run_lbfgs(objective, start, search.bounds, max_steps, search.on_step)
    search.value(result.x)
    return result.x


def _exchange(search: Search, variables: np.ndarray, max_steps: int) -> str:
    """Change amplitudes by one level while this lowers the objective; return the reason to stop.

    Combining vectors are optimised before each sweep over the amplitudes.
    """
    top = _top_level(search)
    variables = np.array(variables)
    variables[:search.n_analog] = np.rint(variables[:search.n_analog] * top) / top
    while max_steps > 0:
        used, variables = _digital(search, variables, min(_DIGITAL_STEPS, max_steps))
        max_steps -= used
        if max_steps:
            variables, exchanged, n_failed, n_allowed = _sweep(search, variables, max_steps)
            max_steps -= exchanged
            if not exchanged:
                return ('no exchange of an amplitude lowers the objective'
                        if n_failed == n_allowed else
                        f'none of the {n_failed} most promising exchanges lowers the objective')
    return 'max_steps reached'


def _sweep(search: Search, variables: np.ndarray, max_exchanges: int
           ) -> tuple[np.ndarray, int, int, int]:
    """Change amplitudes by one level where this lowers the objective, the most promising first.

    Returns the variables and three numbers: of changes, of failed attempts since the last change,
    and of amplitudes with a level in the direction of descent.
    """
    top = _top_level(search)
    value, gradient = search.value_and_gradient(variables)
    by_analog = gradient[:search.n_analog]
    target = variables[:search.n_analog] - np.sign(by_analog) / top
    # There is no level outside [0, 1], and no direction for an element without effect.
    allowed = np.flatnonzero(
        (by_analog != 0) & (target > -0.5 / top) & (target < 1 + 0.5 / top))
    exchanged = failures = 0
    for entry in allowed[np.argsort(-np.abs(by_analog[allowed]))]:
        if failures == _MAX_FAILURES or exchanged == max_exchanges:
            break
        candidate = np.array(variables)
        candidate[entry] = np.rint(target[entry] * top) / top
        lower = search.value(candidate)
        if lower < value:
            value, variables = lower, candidate
            exchanged, failures = exchanged + 1, 0
            search.on_step()
        else:
            failures += 1
    return variables, exchanged, failures, len(allowed)


def _digital(search: Search, start: np.ndarray, max_steps: int) -> tuple[int, np.ndarray]:
    """Minimise over the combining vectors alone; return the steps taken and the variables."""
    def objective(digital: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = search.value_and_gradient(
            np.concatenate([start[:search.n_analog], digital]))
        return value, gradient[search.n_analog:]

    result = run_lbfgs(objective, start[search.n_analog:], search.bounds[search.n_analog:],
                       max_steps, search.on_step)
    return result.nit, np.concatenate([start[:search.n_analog], result.x])


def _top_level(search: Search) -> int:
    return search.problem.scenario.amplitude_levels - 1


# Initial weight of the barrier; the objective is scaled to 1 at the start.
_BARRIER = 1e-3
_MIN_STEP = 1e-9


def minimize_interior_point(
        search: Search, start: np.ndarray, free: np.ndarray, max_steps: int) -> np.ndarray:
    """Minimise over the free variables with SciPy's `trust-constr` and a BFGS Hessian.

    With bounds, this is the interior-point algorithm of Byrd, Hribar and Nocedal that the paper
    cites; without bounds, a trust-region method. `start`, float64 [n], contains all variables;
    `free`, bool [n], marks the free ones. Returns the best of `start` and all evaluated points.
    """
    # A slow import, which loading a codebook does not need.
    from scipy.optimize import BFGS, Bounds, minimize

    best = search.value_and_gradient(start)[0], np.array(start)
    scale = best[0]

    def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        variables = np.array(start)
        variables[free] = values
        value, gradient = search.value_and_gradient(variables)
        if value < best[0]:
            best = value, variables
        return value / scale, gradient[free] / scale

    steps = evaluations = 0

    def on_iteration(_: np.ndarray, state: Any) -> bool:
        """Count steps, and end at the limit; SciPy also reports the start and new barriers."""
        nonlocal steps, evaluations
        if steps < max_steps and state.nfev > max(evaluations, 1):
            steps, evaluations = steps + 1, state.nfev
            search.on_step()
        return steps >= max_steps

    low, high = np.array(search.bounds, dtype=float).T[:, free]
    bounded = not np.isnan(low).all()
    bounds = Bounds(np.nan_to_num(low, nan=-np.inf), np.nan_to_num(high, nan=np.inf))
    with warnings.catch_warnings():
        # SciPy warns whenever a step does not change the gradient, and hence the Hessian.
        warnings.filterwarnings('ignore', 'delta_grad == 0.0', UserWarning)
        minimize(
            objective, start[free], jac=True, hess=BFGS(), method='trust-constr',
            bounds=bounds if bounded else None,
            callback=on_iteration,
            options={'maxiter': 2 * max_steps + 50, 'initial_barrier_parameter': _BARRIER,
                     'initial_barrier_tolerance': _BARRIER, 'sparse_jacobian': True,
                     'gtol': 1e-10, 'xtol': _MIN_STEP})
    return best[1]


# N_itr of Table I. With the default number of steps, each sub-problem may take N_us = 50 steps.
_ITERATIONS = 4


def minimize_alternating(search: Search) -> str:
    """Implements Algorithm 1. Solve sP1 and sP2 alternately, at most N_itr times.

    It ends earlier if neither changes a variable. The 2 N_itr sub-problems share the steps evenly.
    """
    steps = max(search.max_steps // (2 * _ITERATIONS), 1)
    remaining = search.max_steps
    analog = np.arange(len(search.start)) < search.n_analog
    variables = search.start
    for iteration in range(_ITERATIONS):
        previous = variables
        for free in (analog, ~analog):
            if remaining < steps:
                return 'max_steps reached'
            variables = minimize_interior_point(search, variables, free, steps)
            remaining -= steps
        if np.array_equal(previous, variables):
            return f'iteration {iteration + 1} changed nothing'
    return f'{_ITERATIONS} iterations of 2 x {steps} steps'


def minimize_direct(search: Search) -> str:
    """Minimise over analog and digital beamforming jointly; return the reason for stopping."""
    minimize_interior_point(
        search, search.start, np.ones(len(search.start), bool), search.max_steps)
    return f'{search.max_steps} steps at most'


# Default of the implementation that the paper uses, for more than five variables.
_POPULATION = 200


def minimize_genetic(search: Search) -> str:
    """Minimise with pymoo's genetic algorithm; each step is a generation.

    Combining vectors are scaled later, so their real and imaginary parts are confined to [-1, 1].
    The first generation contains the start. Raises MissingLibraryError without pymoo.
    """
    with optional_import("method 'genetic'", extra='genetic'):
        from pymoo.algorithms.soo.nonconvex.ga import GA
        from pymoo.optimize import minimize
        from pymoo.problems.functional import FunctionalProblem

    n_variables = len(search.start)
    low = np.where(np.arange(n_variables) < search.n_analog, 0.0, -1.0)
    problem = FunctionalProblem(n_variables, search.value, xl=low, xu=1.0)
    first = problem.xl + (problem.xu - problem.xl) * search.rng.uniform(
        size=(_POPULATION, n_variables))
    first[0] = np.clip(search.start, problem.xl, problem.xu)
    seed = int(search.rng.integers(2**31))
    minimize(problem, GA(pop_size=_POPULATION, sampling=first), ('n_gen', search.max_steps),
             callback=lambda _: search.on_step(), seed=seed)
    return f'{search.max_steps} generations'
