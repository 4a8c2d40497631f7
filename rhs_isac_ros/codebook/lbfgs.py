"""Bound-constrained quasi-Newton optimisation of all variables at once."""

from rhs_isac_ros.codebook.search import Search

# Number of corrections that approximate the Hessian. Evaluations are expensive, so more
# corrections than SciPy's default of 10 pay off.
_MEMORY = 30


def minimize_lbfgs(search: Search) -> str:
    """Minimise with L-BFGS-B; return the reason for stopping."""
    # A slow import, which loading a codebook does not need.
    from scipy.optimize import minimize

    result = minimize(
        search.value_and_gradient, search.start, jac=True, method='L-BFGS-B',
        bounds=search.bounds, callback=lambda _: search.on_step(),
        options={'maxiter': search.max_steps, 'maxfun': 20 * search.max_steps,
                 'maxcor': _MEMORY, 'ftol': 1e-10, 'gtol': 1e-10})
    return 'max_steps reached' if result.status == 1 else str(result.message)
