"""Optimisation of configurations that can take only a few amplitudes."""

import numpy as np

from rhs_isac_ros.codebook.lbfgs import run_lbfgs
from rhs_isac_ros.codebook.search import Search

# Weights of the penalty in its rounds, relative to the objective.
_WEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0)
# Shares of the steps for the relaxation and for the penalty; the exchange takes the rest.
_RELAXED, _PENALISED = 0.4, 0.3
# Steps on the combining vectors after each sweep.
_DIGITAL_STEPS = 20
# A sweep ends after as many exchanges in a row that do not lower the objective.
_MAX_FAILURES = 64


def minimize_levels(search: Search) -> str:
    """Minimise over levels of the amplitudes, and return the reason for stopping.

    Three phases follow each other. The first treats amplitudes as continuous. The second adds
    the penalty sin^2(pi (L - 1) c), which is zero at the L levels, with growing weight: the
    amplitudes reach the levels while the others and the combining vectors adapt. The third
    exchanges single amplitudes for neighbouring levels, in the order of the gradient, as long as
    that lowers the objective. L-BFGS-B minimises over continuous variables.
    """
    share = _PENALISED / len(_WEIGHTS)
    variables, left = search.start, search.max_steps
    for weight, part in ((0.0, _RELAXED), *((weight, share) for weight in _WEIGHTS)):
        # At least one step in each round, unless none is left.
        steps = min(max(int(part * search.max_steps), 1), left)
        if steps:
            variables = _penalised(search, variables, weight, steps)
        left -= steps
    return _exchange(search, variables, left)


def _penalised(search: Search, start: np.ndarray, weight: float, max_steps: int) -> np.ndarray:
    """Minimise the relaxed objective plus a penalty, and evaluate the rounded result."""
    scale = weight * search.relaxed_value_and_gradient(start)[0] / search.n_analog
    frequency = np.pi * (search.amplitude_levels - 1)

    def objective(variables: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = search.relaxed_value_and_gradient(variables)
        phase = frequency * variables[:search.n_analog]
        gradient[:search.n_analog] += scale * frequency * np.sin(2 * phase)
        return value + scale * float(np.sum(np.sin(phase)**2)), gradient

    result = run_lbfgs(objective, start, search.bounds, max_steps, search.on_step)
    search.value(result.x)
    variables: np.ndarray = result.x
    return variables


def _exchange(search: Search, variables: np.ndarray, max_steps: int) -> str:
    """Exchange single amplitudes until none lowers the objective; return why it stopped."""
    levels = search.amplitude_levels - 1
    variables = np.array(variables)
    variables[:search.n_analog] = np.rint(variables[:search.n_analog] * levels) / levels
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
    """Exchange amplitudes in the order of the expected decrease.

    Returns the variables, the number of exchanges, that of failures since the last one, and that
    of the amplitudes that have a level in the direction of descent.
    """
    levels = search.amplitude_levels - 1
    value, gradient = search.value_and_gradient(variables)
    by_analog = gradient[:search.n_analog]
    target = variables[:search.n_analog] - np.sign(by_analog) / levels
    # A level outside of [0, 1] does not exist.
    allowed = np.flatnonzero((target > -0.5 / levels) & (target < 1 + 0.5 / levels))
    exchanged = failures = 0
    for entry in allowed[np.argsort(-np.abs(by_analog[allowed]))]:
        if failures == _MAX_FAILURES or exchanged == max_exchanges:
            break
        candidate = np.array(variables)
        candidate[entry] = np.rint(target[entry] * levels) / levels
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
    steps = 0

    def objective(digital: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = search.value_and_gradient(
            np.concatenate([start[:search.n_analog], digital]))
        return value, gradient[search.n_analog:]

    def on_step() -> None:
        nonlocal steps
        steps += 1
        search.on_step()

    result = run_lbfgs(objective, start[search.n_analog:], search.bounds[search.n_analog:],
                       max_steps, on_step)
    return steps, np.concatenate([start[:search.n_analog], result.x])
