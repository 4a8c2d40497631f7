"""Optimisation of objectives with many pairs, on samples of the pairs."""

import itertools

import numpy as np

from rhs_isac_ros.codebook.lbfgs import run_lbfgs
from rhs_isac_ros.codebook.search import Search

# Objectives with fewer pairs are evaluated with all of them.
FEWEST_PAIRS = 4096
# Pairs and steps of each round; the last one is repeated. The first steps change the codebook, and
# with it the pairs that matter, more than later ones, which need a more accurate objective.
_ROUNDS = (2048, 200), (4096, 600)
# Corrections that approximate the Hessian: an evaluation takes little longer than their products.
_MEMORY = 100
# Scale of the combining vectors, to which the objective is more sensitive than to configurations.
_DIGITAL_SCALE = 0.3


def minimize_sampled(search: Search) -> str:
    """Minimise with L-BFGS-B on samples of the pairs; return the reason for stopping.

    Each round draws a sample for the codebook that the previous one has found, as
    `PairwiseErrorCost.sample` describes, and evaluates this codebook with all pairs. The search
    ends with its steps, or with a round that does not lower the objective.
    """
    variables, left = search.start, search.max_steps
    value = search.value_m2
    for n_pairs, steps in itertools.chain(_ROUNDS, itertools.repeat(_ROUNDS[-1])):
        done, variables = _round(search, variables, min(n_pairs, search.n_pairs),
                                 min(steps, left))
        left -= done
        if not left:
            return 'max_steps reached'
        if search.value_m2 >= value:
            return 'no round of steps on a sample lowers the objective'
        value = search.value_m2
    raise AssertionError('unreachable: the rounds are endless')


def _round(search: Search, start: np.ndarray, n_pairs: int, steps: int) -> tuple[int, np.ndarray]:
    """Minimise on one sample; return the number of steps and the point."""
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
        # The last step of the round is recorded with the value of all pairs.
        if done:
            search.on_step()
        done += 1

    try:
        run_lbfgs(objective, start / scale, search.bounds, steps, on_step, _MEMORY)
    finally:
        # Also after Ctrl-C, and when the sample has used the evaluations but one.
        if done:
            search.value(point)
            search.on_step()
    return done, point
