"""The interior point method of the paper, on some of the variables."""

import warnings

import numpy as np

from rhs_isac_ros.codebook.search import Search

# Weight of the barrier at the start; the objective there is 1.
_BARRIER = 1e-3
_SMALLEST_STEP = 1e-9


def minimize_interior_point(
        search: Search, start: np.ndarray, chosen: np.ndarray, max_steps: int) -> np.ndarray:
    """Minimise over chosen variables: barrier, trust region, conjugate gradients, BFGS Hessian.

    SciPy's `trust-constr` is the algorithm of Byrd, Hribar and Nocedal that the paper cites.

    Parameters
    ----------
    search
        What to minimise.
    start
        Values of all variables, float64 [n].
    chosen
        Which of them to change, bool [n].
    max_steps
        Limit of update steps.

    Returns
    -------
    numpy.ndarray
        Float64 [n]: the best values that were met, `start` included.
    """
    # Here: a slow import, and most that use a codebook do not optimise one.
    from scipy.optimize import BFGS, Bounds, minimize

    best = search.value_and_gradient(start)[0], np.array(start)
    scale = best[0]

    def function(values: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        variables = np.array(start)
        variables[chosen] = values
        value, gradient = search.value_and_gradient(variables)
        if value < best[0]:
            best = value, variables
        return value / scale, gradient[chosen] / scale

    steps = evaluations = 0

    def on_iteration(_: np.ndarray, state: object) -> bool:
        """Count iterations that moved; SciPy also reports its start and each new barrier."""
        nonlocal steps, evaluations
        if steps < max_steps and state.nfev > max(evaluations, 1):
            steps, evaluations = steps + 1, state.nfev
            search.on_step()
        return steps >= max_steps

    low, high = np.array(search.bounds, dtype=float).T[:, chosen]
    bounded = not np.isnan(low).all()
    bounds = Bounds(np.nan_to_num(low, nan=-np.inf), np.nan_to_num(high, nan=np.inf))
    with warnings.catch_warnings():
        # A step that changes nothing leaves the Hessian as it is; SciPy says so each time.
        warnings.filterwarnings('ignore', 'delta_grad == 0.0', UserWarning)
        minimize(
            function, start[chosen], jac=True, hess=BFGS(), method='trust-constr',
            bounds=bounds if bounded else None,
            callback=on_iteration,
            options={'maxiter': 2 * max_steps + 50, 'initial_barrier_parameter': _BARRIER,
                     'initial_barrier_tolerance': _BARRIER, 'sparse_jacobian': True,
                     'gtol': 1e-10, 'xtol': _SMALLEST_STEP})
    return best[1]
