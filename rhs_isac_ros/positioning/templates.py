"""Templates of the received signals on a polar grid over the region of interest.

A template's carrier is factored out: exp(i k_i r) t_i(p) changes slowly with the range, so that a
coarse grid holds it.
"""

import numpy as np

from rhs_isac_ros.bounds.fisher import quadratic_form
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.whitened import WhitenedModel

RANGE_CELL_M = 0.5
DIRECTION_STEP = 0.025
# Points that represent a Gaussian where it is cut to the region of interest.
_SPREAD = 128
# Grid points that are computed at a time.
_BLOCK = 256
# Largest sine of the angle from the normal that the grid goes to.
_RIM = 0.995


def tabulate(model: WhitenedModel) -> dict[str, np.ndarray]:
    """Compute the templates of a scenario and codebook.

    Parameters
    ----------
    model
        The whitened model.

    Returns
    -------
    dict of numpy.ndarray
        By name, for G grid points: ``points`` (r [m], u, v), float64 [G, 3]; ``filters``, the
        conjugate templates without carrier, complex64 [N_B, G, N_SB F]; ``slope_filters``, the
        same of their derivatives by the point, complex64 [G, 3, N_B N_SB F]; ``energy`` of the
        templates, float32 [G]; ``energy_slope``, its derivative, float64 [G, 3]; ``curvature`` of
        the log-likelihood, float64 [G, 3, 3]; and, of no codebook, ``normal``, points that
        represent a standard Gaussian, float64 [128, 3].
    """
    points = polar_grid(model.scenario)
    n, (n_bands, n_rows) = len(points), model.shape
    table = {
        'points': points,
        'filters': np.empty((n_bands, n, n_rows), np.complex64),
        'slope_filters': np.empty((n, 3, n_bands * n_rows), np.complex64),
        'energy': np.empty(n, np.float32),
        'energy_slope': np.empty((n, 3)),
        'curvature': np.empty((n, 3, 3)),
        'normal': _standard_normal(),
    }
    wavenumbers = carrier_wavenumbers(model.scenario)
    for start in range(0, n, _BLOCK):
        block = slice(start, start + _BLOCK)
        mean, by_position = model.mean_and_jacobian(to_positions(points[block]))
        slopes = np.matmul(
            np.swapaxes(jacobian(points[block]), 1, 2), by_position.reshape(len(mean), 3, -1))
        carrier = np.exp(1j * wavenumbers * points[block, :1])[..., None]
        table['filters'][:, block] = np.swapaxes(mean * carrier, 0, 1).conj()
        table['slope_filters'][block] = (
            slopes.reshape(by_position.shape) * carrier[:, None]).conj().reshape(slopes.shape)
        flat = mean.reshape(len(mean), -1)
        table['energy'][block] = np.sum(np.abs(flat)**2, axis=1)
        table['energy_slope'][block] = 2 * np.matmul(slopes.conj(), flat[..., None])[..., 0].real
        table['curvature'][block] = quadratic_form(slopes)
    return table


def _standard_normal() -> np.ndarray:
    # Here, and kept with the table: what it imports takes longer to load than the table.
    from scipy.special import ndtri
    from scipy.stats import qmc

    return ndtri(np.clip(qmc.Sobol(3, seed=0).random(_SPREAD), 1e-6, 1 - 1e-6))


def carrier_wavenumbers(scenario: Scenario) -> np.ndarray:
    """Wavenumbers of the bands' centres.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    numpy.ndarray
        k_i, float64 [N_B] [1/m].
    """
    return 2 * np.pi * np.array(scenario.center_frequencies_hz) / SPEED_OF_LIGHT_MPS


def polar_grid(scenario: Scenario) -> np.ndarray:
    """Grid whose cells cover the region of interest.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    numpy.ndarray
        (r [m], u, v), float64 [G, 3].
    """
    low, high = scenario.roi_bounds_m
    axes = [np.linspace(low[u], high[u], 33) for u in range(3)]
    x, y, z = np.meshgrid(*axes, indexing='ij')
    reach = to_polar(np.stack([x, y, z], axis=-1).reshape(-1, 3))
    steps = (RANGE_CELL_M, DIRECTION_STEP, DIRECTION_STEP)
    lines = [np.arange(np.floor(reach[:, a].min() / steps[a]),
                       np.ceil(reach[:, a].max() / steps[a]) + 1) * steps[a] for a in range(3)]
    # No direction belongs to the range 0; its first cell is centred half a step further out.
    lines[0] = np.where(lines[0] > 0, lines[0], RANGE_CELL_M / 4)
    points = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 3)
    # Directions beyond the rim of the half space stand for those just inside it.
    rim = np.maximum(np.hypot(points[:, 1], points[:, 2]) / _RIM, 1.0)
    points = points[rim < 1 + 2 * DIRECTION_STEP]
    points[:, 1:] /= rim[rim < 1 + 2 * DIRECTION_STEP, None]
    # A cell counts if the box around its corners meets the region.
    halves = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing='ij'), axis=-1).reshape(-1, 3)
    corners = to_positions(points[:, None] + halves * steps)
    meets = (corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)
    return points[meets.all(axis=1)]
