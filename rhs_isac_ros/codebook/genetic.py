"""A benchmark from the paper: a genetic algorithm."""

import numpy as np

from rhs_isac_ros.codebook.search import Search
from rhs_isac_ros.model.optional import optional_import

# The default of the implementation that the paper uses, for more than five variables.
_POPULATION = 200


def minimize_genetic(search: Search) -> str:
    """Minimise with pymoo's genetic algorithm, one step a generation.

    Only the direction of a combining vector matters, so its unscaled parts are searched in
    [-1, 1]. The first generation contains the start. Returns the reason for stopping; raises
    MissingLibraryError if pymoo is not installed.
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
