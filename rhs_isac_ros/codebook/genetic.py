"""A benchmark of the paper: a genetic algorithm."""

import numpy as np

from rhs_isac_ros.codebook.search import Search

# As in the standard implementation that the paper takes: for more than five variables.
_POPULATION = 200


def minimize_genetic(search: Search) -> str:
    """Minimise by pymoo's genetic algorithm; a step is a generation.

    Combining vectors count by their direction only, so their unscaled parts are searched from
    -1 to 1. The start is a member of the first generation.

    Parameters
    ----------
    search
        What to minimise.

    Returns
    -------
    str
        Why the method stopped.

    Raises
    ------
    ValueError
        If pymoo is not installed.
    """
    try:
        from pymoo.algorithms.soo.nonconvex.ga import GA
        from pymoo.core.callback import Callback
        from pymoo.core.problem import ElementwiseProblem
        from pymoo.optimize import minimize
    except ImportError:
        raise ValueError(
            "method: 'genetic' needs pymoo, which is not installed (pip install pymoo)") from None

    class Whole(ElementwiseProblem):
        """The objective as pymoo wants it."""

        def __init__(self) -> None:
            low = np.where(np.arange(len(search.start)) < search.n_analog, 0.0, -1.0)
            super().__init__(n_var=len(search.start), n_obj=1, xl=low, xu=1.0)

        def _evaluate(self, x: np.ndarray, out: dict, *args: object, **kwargs: object) -> None:
            out['F'] = search.value(x)

    class Generation(Callback):
        """Counts a generation as a step."""

        def notify(self, algorithm: object) -> None:
            search.on_step()

    problem = Whole()
    first = problem.xl + (problem.xu - problem.xl) * search.rng.uniform(
        size=(_POPULATION, problem.n_var))
    first[0] = np.clip(search.start, problem.xl, problem.xu)
    seed = int(search.rng.integers(2**31))
    minimize(problem, GA(pop_size=_POPULATION, sampling=first), ('n_gen', search.max_steps),
             callback=Generation(), seed=seed)
    return f'{search.max_steps} generations'
