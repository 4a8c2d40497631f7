"""Bound-constrained quasi-Newton over both variables at once."""

from rhs_isac_ros.codebook.search import Search

# Corrections that approximate the Hessian; more pay off here, an evaluation being dear.
_MEMORY = 30


def minimize_lbfgs(search: Search) -> str:
    """Minimise by L-BFGS-B.

    Parameters
    ----------
    search
        What to minimise, from where, and for how long.

    Returns
    -------
    str
        Why the method stopped.
    """
    # Here: a slow import, and most that use a codebook do not optimise one.
    from scipy.optimize import minimize

    result = minimize(
        search.value_and_gradient, search.start, jac=True, method='L-BFGS-B',
        bounds=search.bounds, callback=lambda _: search.on_step(),
        options={'maxiter': search.max_steps, 'maxfun': 20 * search.max_steps,
                 'maxcor': _MEMORY, 'ftol': 1e-10, 'gtol': 1e-10})
    return 'max_steps reached' if result.status == 1 else str(result.message)
