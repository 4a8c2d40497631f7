"""The paper's algorithm: optimise analog and digital beamforming alternately."""

import numpy as np

from rhs_isac_ros.codebook.interior_point import minimize_interior_point
from rhs_isac_ros.codebook.search import Search

# N_itr of Table I. With the default number of steps, each sub-problem takes N_us = 50 steps.
_ITERATIONS = 4


def minimize_alternating(search: Search) -> str:
    """Implements Algorithm 1. Solve sP1 and sP2 alternately until neither changes a variable.

    The steps of the search are divided evenly among the 2 N_itr sub-problems. Returns the reason
    for stopping.
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
