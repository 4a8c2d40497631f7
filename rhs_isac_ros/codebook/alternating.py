"""The paper's algorithm: analog and digital beamforming in turn."""

import numpy as np

from rhs_isac_ros.codebook.interior_point import minimize_interior_point
from rhs_isac_ros.codebook.search import Search

# N_itr of Table I; its N_us is 50, with the default number of steps.
_ITERATIONS = 4


def minimize_alternating(search: Search) -> str:
    """Implements Algorithm 1. Solve sP1 and sP2 in turn until neither changes its variables.

    Parameters
    ----------
    search
        What to minimise; its steps are shared evenly among the 2 N_itr sub-problems.

    Returns
    -------
    str
        Why the method stopped.
    """
    steps = max(search.max_steps // (2 * _ITERATIONS), 1)
    left = search.max_steps
    analog = np.arange(len(search.start)) < search.n_analog
    variables = search.start
    for iteration in range(_ITERATIONS):
        before = variables
        for chosen in (analog, ~analog):
            if left < steps:
                return 'max_steps reached'
            variables = minimize_interior_point(search, variables, chosen, steps)
            left -= steps
        if np.array_equal(before, variables):
            return f'iteration {iteration + 1} changed nothing'
    return f'{_ITERATIONS} iterations of 2 x {steps} steps'
