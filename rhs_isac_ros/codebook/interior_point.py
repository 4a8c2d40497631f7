"""The interior-point method of the paper, on a subset of the variables."""

import warnings

import numpy as np

from rhs_isac_ros.codebook.search import Search
from rhs_isac_ros.model.threads import one_blas_thread

# Initial weight of the barrier; the objective is scaled to 1 at the start.
_BARRIER = 1e-3
_MIN_STEP = 1e-9


def minimize_interior_point(
        search: Search, start: np.ndarray, free: np.ndarray, max_steps: int) -> np.ndarray:
    """Minimise over the free variables: barrier, trust region, conjugate gradients, BFGS Hessian.

    SciPy's `trust-constr` is the algorithm of Byrd, Hribar and Nocedal that the paper cites.

    Parameters
    ----------
    start
        Initial values of all variables, float64 [n].
    free
        Mask of the variables to change, bool [n].

    Returns
    -------
    numpy.ndarray
        The best point evaluated, `start` included, float64 [n].
    """
    # A slow import, which loading a codebook does not need.
    from scipy.optimize import BFGS, Bounds, OptimizeResult, minimize

    # SciPy multiplies the Hessian matrix with a BLAS of its own.
    one_blas_thread.find_libraries()
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

    def on_iteration(_: np.ndarray, state: OptimizeResult) -> bool:
        """Count the iterations that moved; SciPy also reports the start and each new barrier."""
        nonlocal steps, evaluations
        if steps < max_steps and state.nfev > max(evaluations, 1):
            steps, evaluations = steps + 1, state.nfev
            search.on_step()
        return steps >= max_steps

    low, high = np.array(search.bounds, dtype=float).T[:, free]
    bounded = not np.isnan(low).all()
    bounds = Bounds(np.nan_to_num(low, nan=-np.inf), np.nan_to_num(high, nan=np.inf))
    with warnings.catch_warnings():
        # SciPy warns whenever a step leaves the gradient, and so the Hessian, unchanged.
        warnings.filterwarnings('ignore', 'delta_grad == 0.0', UserWarning)
        minimize(
            objective, start[free], jac=True, hess=BFGS(), method='trust-constr',
            bounds=bounds if bounded else None,
            callback=on_iteration,
            options={'maxiter': 2 * max_steps + 50, 'initial_barrier_parameter': _BARRIER,
                     'initial_barrier_tolerance': _BARRIER, 'sparse_jacobian': True,
                     'gtol': 1e-10, 'xtol': _MIN_STEP})
    return best[1]
