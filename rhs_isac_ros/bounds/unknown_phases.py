"""Distances of signals whose phases are unknown.

The phases of the bands are theta = A z, with one column of A for each parameter and standard
normal z: the phase that all bands share, and one for each band. The distance of two signals is
the smallest over z of ``sum_i 2 |a_i exp(i theta_i) - b_i|^2 + |z|^2``. For small deviations it
is what the linear marginalisation of `bounds.nuisance` leaves; for large ones it vanishes if the
signals differ in the phases of their bands alone.
"""

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.nuisance import nuisance_parameters

# Steps of the minimisation, each of which lowers the distance.
_STEPS = 40


def phase_scales(scenario: Scenario) -> np.ndarray:
    """Return the matrix A of the declared phases, float64 [N_B, Q] [rad]."""
    columns = []
    for parameter in nuisance_parameters(scenario):
        if parameter.name in ('phase', 'band_phase'):
            column = np.zeros(scenario.n_bands)
            column[slice(None) if parameter.band is None else parameter.band] = parameter.std
            columns.append(column)
    scales: np.ndarray = np.array(columns).reshape(-1, scenario.n_bands).T
    return scales


def best_phases(products: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the phases theta with which signals a are the closest to signals b, almost always.

    Parameters
    ----------
    products
        Twice the inner products a_i^H b_i of the whitened signals, complex128 [n, N_B].
    scales
        The matrix A, float64 [N_B, Q] [rad].

    Returns
    -------
    phases : numpy.ndarray
        Theta, float64 [n, N_B] [rad].
    penalties : numpy.ndarray
        The cost ``|z|^2`` of these phases, float64 [n].
    """
    magnitude, angle = np.abs(products), np.angle(products)
    # The cosines have curvatures up to the magnitudes, so that steps with these do not overshoot.
    curvature = np.einsum('bq,nb,bp->nqp', scales, magnitude, scales) + np.eye(scales.shape[1])
    inverse = np.linalg.inv(curvature)
    candidates = []
    # Small deviations keep the minimum near 0, large ones near the angles of the products.
    for z in (np.zeros((len(products), scales.shape[1])), angle @ np.linalg.pinv(scales).T):
        for _ in range(_STEPS):
            slope = (magnitude * np.sin(z @ scales.T - angle)) @ scales + z
            z = z - np.einsum('nqp,np->nq', inverse, slope)
        penalty = np.sum(z**2, axis=1)
        phases = z @ scales.T
        cost = penalty - 2 * np.sum(magnitude * np.cos(phases - angle), axis=1)
        candidates.append((cost, phases, penalty))
    first, second = candidates
    better = first[0] <= second[0]
    return np.where(better[:, None], first[1], second[1]), np.where(better, first[2], second[2])
