"""A plot of an optimisation and of the resulting codebook."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.codebook.search import Progress
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.optional import optional_import
from rhs_isac_ros.model.pictures import write_picture
from rhs_isac_ros.model.surface import radiation_matrix

# Points of the map of the bound along each axis, and of a beam over azimuth.
_N_MAP_POINTS = 60
_N_AZIMUTHS = 361


def plot_optimization(
        scenario: Scenario, codebook: Codebook, history: Sequence[Progress],
        path: str | Path) -> None:
    """Plot convergence, the bound over the region of interest, and the beam patterns.

    The suffix of `path` determines the file format.

    Raises
    ------
    MissingLibraryError
        If matplotlib is not installed.
    ValueError
        If matplotlib does not support the file format.
    OSError
        If the file cannot be written.
    """
    with optional_import('plotting', extra='plot'):
        from matplotlib.figure import Figure

    rows = -(-scenario.n_bands // 3)
    figure = Figure(figsize=(11, 4.2 + 3 * rows), layout='constrained')
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(4.2, 3 * rows))[:, 0]
    left, right = above.subplots(1, 2)
    _draw_convergence(left, history)
    _draw_bound(right, scenario, codebook)
    axes = below.subplots(rows, min(scenario.n_bands, 3), squeeze=False)
    for axis in axes.flat[scenario.n_bands:]:
        axis.set_visible(False)
    for band, axis in zip(range(scenario.n_bands), axes.flat, strict=False):
        _draw_beams(axis, scenario, codebook, band)
    write_picture(path, figure)


def beam_powers(
        scenario: Scenario, codebook: Codebook, band: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the power of every frame's beam over azimuth, in the middle sub-band of a band.

    The azimuths are float64 [361] [rad], at the height and distance of the centre of the region
    of interest; the powers that a user there would receive are float64 [F, 361] [W].
    """
    azimuths = np.linspace(-np.pi / 2, np.pi / 2, _N_AZIMUTHS)
    x, y, z = scenario.roi_center_m
    distance = np.hypot(x, y)
    circle = np.stack([distance * np.cos(azimuths), distance * np.sin(azimuths),
                       np.full(_N_AZIMUTHS, z)], axis=1)
    middle = scenario.n_subbands // 2
    radiation = radiation_matrix(scenario, codebook)[band]
    radiation = radiation.reshape(scenario.n_subbands, scenario.n_frames, -1)[middle]
    signals = los_gain(scenario, circle, band)[:, middle] @ radiation.T
    return azimuths, np.abs(signals.T)**2


def _draw_convergence(axis: Any, history: Sequence[Progress]) -> None:
    axis.semilogy([entry.step for entry in history], [entry.value_m2 for entry in history])
    axis.set(xlabel='step', ylabel='objective [m$^2$]', title='Convergence')
    axis.grid(alpha=0.3)


def _draw_bound(axis: Any, scenario: Scenario, codebook: Codebook) -> None:
    low, high = scenario.roi_bounds_m
    x, y = np.linspace(low[0], high[0], _N_MAP_POINTS), np.linspace(low[1], high[1], _N_MAP_POINTS)
    grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), scenario.roi_center_m[2])], -1)
    bound = np.sqrt(crlb(scenario, codebook, grid.reshape(-1, 3))).reshape(len(y), len(x))
    image = axis.pcolormesh(x, y, np.where(np.isfinite(bound), bound, np.nan), shading='gouraud')
    axis.set(xlabel='x [m]', ylabel='y [m]', aspect='equal',
             title='Root of the CRLB at mid-height')
    axis.figure.colorbar(image, ax=axis, label='m')


def _draw_beams(axis: Any, scenario: Scenario, codebook: Codebook, band: int) -> None:
    azimuths, powers = beam_powers(scenario, codebook, band)
    for frame, power in enumerate(powers):
        decibels = 10 * np.log10(np.maximum(power / powers.max(), 1e-3))
        axis.plot(np.degrees(azimuths), decibels, label=f'frame {frame}')
    axis.set(xlabel='azimuth [deg]', ylabel='power [dB]', xlim=(-90, 90), ylim=(-30, 1),
             xticks=range(-90, 91, 30),
             title=f'Beams of band {band}, {scenario.center_frequencies_hz[band] / 1e9:g} GHz')
    axis.grid(alpha=0.3)
    if scenario.n_frames <= 8:
        axis.legend(fontsize='x-small')
