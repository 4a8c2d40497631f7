"""A plot of an optimisation and of the resulting codebook."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.codebook.problem import Progress
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.surface import radiation_matrix
from rhs_isac_ros.support import pictures

# Number of points along each axis of the map of the bound, and number of azimuths of a beam.
_N_MAP_POINTS = 60
_N_AZIMUTHS = 361
# Number of panels of beams side by side.
_N_COLUMNS = 3


@pictures.paper_style('plotting')
def plot_optimization(
        scenario: Scenario, codebook: Codebook, history: Sequence[Progress]) -> Any:
    """Plot convergence, the bound over the region of interest, and the beam patterns.

    Returns a `matplotlib.figure.Figure`. Raises MissingLibraryError without Matplotlib.
    """
    rows = -(-scenario.n_bands // _N_COLUMNS)
    heights_in = 2.7, 2.3 * rows
    figure = pictures.new_figure(pictures.PAGE_IN, sum(heights_in))
    above, below = figure.add_gridspec(2, 1, height_ratios=heights_in)
    left, right = above.subgridspec(1, 2).subplots()
    _draw_convergence(left, history)
    _draw_bound(right, scenario, codebook)
    axes, legend = pictures.add_panels(
        below, rows, min(scenario.n_bands, _N_COLUMNS), sharex=True, sharey=True)
    for axis in axes.flat[scenario.n_bands:]:
        axis.set_visible(False)
    for band, axis in zip(range(scenario.n_bands), axes.flat, strict=False):
        _draw_beams(axis, scenario, codebook, band)
    for axis in axes[:, 0]:
        axis.set_ylabel('relative power [dB]')
    if scenario.n_frames <= len(pictures.LOOKS):
        legend.legend(*axes[0, 0].get_legend_handles_labels(), loc='lower center', ncols=4)
    return figure


def beam_powers(
        scenario: Scenario, codebook: Codebook, band: int) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths, float64 [n] [rad], and the received powers, float64 [F, n] [W].

    The powers apply to the middle sub-band and to a user at the height and the horizontal distance
    of the centre of the region of interest.
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
    axis.semilogy([entry.step for entry in history], [entry.value_m2 for entry in history],
                  color=pictures.look(0).colour)
    axis.set(xlabel='step', ylabel='objective [m$^2$]', title='convergence')
    pictures.label_decades(axis.yaxis)
    axis.grid()


def _draw_bound(axis: Any, scenario: Scenario, codebook: Codebook) -> None:
    low, high = scenario.roi_bounds_m
    x, y = np.linspace(low[0], high[0], _N_MAP_POINTS), np.linspace(low[1], high[1], _N_MAP_POINTS)
    grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), scenario.roi_center_m[2])], -1)
    bound = np.sqrt(crlb(scenario, codebook, grid.reshape(-1, 3))).reshape(len(y), len(x))
    image = axis.pcolormesh(x, y, np.where(np.isfinite(bound), bound, np.nan), shading='gouraud',
                            rasterized=True)
    axis.set(xlabel='$x$ [m]', ylabel='$y$ [m]', aspect='equal', title='bound at mid-height')
    axis.figure.colorbar(image, ax=axis, label='√CRLB [m]')


def _draw_beams(axis: Any, scenario: Scenario, codebook: Codebook, band: int) -> None:
    azimuths, powers = beam_powers(scenario, codebook, band)
    for frame, power in enumerate(powers):
        decibels = 10 * np.log10(np.maximum(power / powers.max(), 1e-3))
        own = pictures.look(frame)
        axis.plot(np.degrees(azimuths), decibels, color=own.colour, linestyle=own.line,
                  label=f'frame {frame}')
    axis.set(xlabel='azimuth [°]', xlim=(-90, 90), ylim=(-30, 1),
             xticks=range(-90, 91, 45),
             title=f'beams of band {band}, {scenario.center_frequencies_hz[band] / 1e9:g} GHz')
    axis.grid()
