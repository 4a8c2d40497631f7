"""A benchmark from the paper: the interior-point method on all variables at once."""

import numpy as np

from rhs_isac_ros.codebook.interior_point import minimize_interior_point
from rhs_isac_ros.codebook.search import Search


def minimize_direct(search: Search) -> str:
    """Minimise over analog and digital beamforming jointly; return the reason for stopping."""
    minimize_interior_point(
        search, search.start, np.ones(len(search.start), bool), search.max_steps)
    return f'{search.max_steps} steps at most'
