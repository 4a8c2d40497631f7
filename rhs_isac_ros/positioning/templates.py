"""Templates of the received signals on a polar grid over the region of interest.

A template is a whitened mean without its carrier: exp(i k_i r) t_i(p) changes slowly with the
range, so that a coarse grid suffices.
"""

import numpy as np

from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.model.threads import map_blocks
from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.whitened import WhitenedModel

RANGE_CELL_M = 0.5
DIRECTION_STEP = 0.025
# Number of points that represent a standard Gaussian.
_N_NORMAL = 128
# Number of grid points to compute at a time.
_BLOCK = 256
# Largest sine of the angle from boresight on the grid.
_MAX_SINE = 0.995
# Number of positions along each edge of the region that determine the extent of the grid.
_N_EDGE = 33


def tabulate(model: WhitenedModel) -> dict[str, np.ndarray]:
    """Compute the templates of a scenario and codebook.

    Returns
    -------
    dict of numpy.ndarray
        By name, for G grid points: ``points`` (r [m], u, v), float64 [G, 3]; ``filters``, the
        conjugate templates, complex64 [N_B, G, N_SB F]; ``slope_filters``, the conjugate
        derivatives of the templates with respect to the point, complex64 [N_B, G, 3, N_SB F];
        ``energy`` of the templates, float32 [G]; ``energy_slope``, its derivative, float64
        [G, 3]; ``curvature`` of the log-likelihood, float64 [G, 3, 3]; and, independent of the
        codebook, ``normal``, points that represent a standard Gaussian, float64 [128, 3].
    """
    points = polar_grid(model.scenario)
    n, (n_bands, n_rows) = len(points), model.shape
    table = {
        'points': points,
        'filters': np.empty((n_bands, n, n_rows), np.complex64),
        'slope_filters': np.empty((n_bands, n, 3, n_rows), np.complex64),
        'energy': np.empty(n, np.float32),
        'energy_slope': np.empty((n, 3)),
        'curvature': np.empty((n, 3, 3)),
        'normal': standard_normal(_N_NORMAL),
    }
    wavenumbers = carrier_wavenumbers(model.scenario)

    def fill(start: int) -> None:
        block = slice(start, start + _BLOCK)
        mean, by_position = model.mean_and_jacobian(to_positions(points[block]))
        by_point = np.matmul(
            np.swapaxes(jacobian(points[block]), 1, 2), by_position.reshape(len(mean), 3, -1))
        carrier = np.exp(1j * wavenumbers * points[block, :1])[..., None]
        table['filters'][:, block] = np.swapaxes(mean * carrier, 0, 1).conj()
        slopes = by_point.reshape(by_position.shape) * carrier[:, None]
        table['slope_filters'][:, block] = np.moveaxis(slopes, 2, 0).conj()
        flat = mean.reshape(len(mean), -1)
        table['energy'][block] = np.sum(np.abs(flat)**2, axis=1)
        table['energy_slope'][block] = 2 * np.matmul(by_point.conj(), flat[..., None])[..., 0].real
        table['curvature'][block] = quadratic_form(by_point)

    map_blocks(fill, range(0, n, _BLOCK))
    return table


def standard_normal(n: int) -> np.ndarray:
    """Return points that represent a standard Gaussian, float64 [n, 3], for a power of two."""
    # The points are kept with the table because these imports take longer than loading a table.
    from scipy.special import ndtri
    from scipy.stats import qmc

    points: np.ndarray = ndtri(
        np.clip(qmc.Sobol(3, seed=0).random(n), 1e-6, 1 - 1e-6))
    return points


def carrier_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Return the wavenumbers k_i at the bands' centres, float64 [N_B] [1/m]."""
    wavenumbers: np.ndarray = (
        2 * np.pi * np.array(scenario.center_frequencies_hz) / SPEED_OF_LIGHT_MPS)
    return wavenumbers


def polar_grid(scenario: Scenario) -> np.ndarray:
    """Return a grid whose cells cover the region of interest, (r [m], u, v), float64 [G, 3]."""
    low, high = scenario.roi_bounds_m
    edges = [np.linspace(low[u], high[u], _N_EDGE) for u in range(3)]
    extent = to_polar(np.stack(np.meshgrid(*edges, indexing='ij'), axis=-1).reshape(-1, 3))
    steps = (RANGE_CELL_M, DIRECTION_STEP, DIRECTION_STEP)
    lines = [np.arange(np.floor(extent[:, a].min() / steps[a]),
                       np.ceil(extent[:, a].max() / steps[a]) + 1) * steps[a] for a in range(3)]
    # The direction is undefined at range 0; the first cell is centred a quarter cell further out.
    lines[0] = np.where(lines[0] > 0, lines[0], RANGE_CELL_M / 4)
    points = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 3)
    # Directions slightly beyond the rim of the half space are moved onto it.
    excess = np.maximum(np.hypot(points[:, 1], points[:, 2]) / _MAX_SINE, 1.0)
    near = excess < 1 + 2 * DIRECTION_STEP
    points = points[near]
    points[:, 1:] /= excess[near, None]
    # A cell belongs to the grid if the bounding box of its corners intersects the region.
    halves = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing='ij'), axis=-1).reshape(-1, 3)
    corners = to_positions(points[:, None] + halves * steps)
    intersects = (corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)
    chosen: np.ndarray = points[intersects.all(axis=1)]
    return chosen
