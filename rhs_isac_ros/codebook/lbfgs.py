"""Bound-constrained quasi-Newton over both variables at once."""

from collections.abc import Callable, Sequence

import numpy as np

# Corrections that approximate the Hessian; more pay off here, an evaluation being dear.
_MEMORY = 30


def minimize_lbfgs(
        function: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray,
        bounds: Sequence, max_steps: int, on_step: Callable[[], None]) -> str:
    """Minimise by L-BFGS-B.

    Parameters
    ----------
    function
        Returns value and gradient at a float64 [n] vector.
    start
        First point, float64 [n].
    bounds
        Bounds of every variable, in SciPy's form.
    max_steps
        Limit of update steps.
    on_step
        Called after each step.

    Returns
    -------
    str
        Why the method stopped.
    """
    # Here: a slow import, and most that use a codebook do not optimise one.
    from scipy.optimize import minimize

    result = minimize(
        function, start, jac=True, method='L-BFGS-B', bounds=bounds,
        callback=lambda _: on_step(),
        options={'maxiter': max_steps, 'maxfun': 20 * max_steps, 'maxcor': _MEMORY,
                 'ftol': 1e-10, 'gtol': 1e-10})
    return str(result.message)
