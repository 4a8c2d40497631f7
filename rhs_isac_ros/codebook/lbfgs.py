"""Bound-constrained quasi-Newton optimisation of all variables at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from rhs_isac_ros.codebook.search import Search
from rhs_isac_ros.model.threads import one_blas_thread

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

# Number of corrections that approximate the Hessian. Evaluations are expensive, so more
# corrections than SciPy's default of 10 pay off.
_MEMORY = 30


def minimize_lbfgs(search: Search) -> str:
    """Minimise with L-BFGS-B; return the reason for stopping."""
    result = run_lbfgs(search.value_and_gradient, search.start, search.bounds, search.max_steps,
                       search.on_step)
    return 'max_steps reached' if result.status == 1 else str(result.message)


def run_lbfgs(
        objective: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray,
        bounds: Sequence[tuple[float, float] | tuple[None, None]], max_steps: int,
        on_step: Callable[[], None], memory: int = _MEMORY) -> OptimizeResult:
    """Minimise a function that returns its value and gradient, with SciPy's L-BFGS-B.

    The result does not depend on the unit of the function, whose value is positive. `on_step` is
    called after each of at most `max_steps` steps; `memory` is the number of corrections.
    """
    # A slow import, which loading a codebook does not need.
    from scipy.optimize import minimize

    # SciPy multiplies the corrections with a BLAS of its own.
    one_blas_thread.find_libraries()
    unit = 0.0

    def relative(variables: np.ndarray) -> tuple[float, np.ndarray]:
        """Divide by the value at the start: SciPy's tolerances are for values of about 1."""
        nonlocal unit
        value, gradient = objective(variables)
        unit = unit or value or 1.0
        return value / unit, gradient / unit

    result = minimize(
        relative, start, jac=True, method='L-BFGS-B', bounds=bounds,
        callback=lambda _: on_step(),
        options={'maxiter': max_steps, 'maxfun': 20 * max_steps,
                 'maxcor': memory, 'ftol': 1e-10, 'gtol': 1e-10})
    result.fun, result.jac = unit * result.fun, unit * result.jac
    return result
