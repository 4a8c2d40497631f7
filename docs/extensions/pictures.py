"""The directive ``picture``: pictures that are drawn when the documentation is built.

``.. picture:: geometry`` calls the function of that name below, which returns a figure. The name
of the figure is its description for readers who cannot see it.
"""

import os
import struct
from pathlib import Path

import matplotlib
import numpy as np
from docutils import nodes
from run_notebook import DPI
from sphinx.util.docutils import SphinxDirective

from rhs_isac_ros.codebook import default_codebook_file
from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Scenario
from rhs_isac_ros.model.geometry import element_positions, feed_positions

matplotlib.use('Agg')


def geometry():
    """Return the surface with its feeds, and the region of interest, of Table I."""
    from matplotlib import pyplot

    scenario = Scenario()
    figure, (plan, board) = pyplot.subplots(
        1, 2, num='The region of interest from above, and the surface with its feeds',
        figsize=(8, 3.6), layout='constrained')
    elements, feeds = element_positions(scenario), feed_positions(scenario)
    low, high = scenario.roi_bounds_m
    plan.add_patch(pyplot.Rectangle(
        low[:2], *(high - low)[:2], fc='C0', alpha=0.2, label='region of interest'))
    plan.plot(*elements[:, :2].T, 'ks', ms=3, label='surface')
    plan.set(xlabel='$x$ [m]', ylabel='$y$ [m]', aspect='equal', xlim=(-1, 16), ylim=(-6, 6),
             title='from above')
    plan.legend(loc='upper left', fontsize='small')
    board.plot(*elements[:, 1:].T * 100, 's', color='0.6', ms=7, label='elements')
    board.plot(*feeds[:, 1:].T * 100, 'D', color='C1', ms=6, mec='k', label='feeds')
    for number in (0, 1, scenario.n_columns):
        board.annotate(str(number), elements[number, 1:] * 100, ha='center', va='center',
                       fontsize=6)
    board.set(xlabel='$y$ [cm]', ylabel='$z$ [cm]', aspect='equal', title='from the region')
    board.legend(loc='upper left', bbox_to_anchor=(1, 1), fontsize='small')
    return figure


def range_ambiguity():
    """Return the range ambiguity functions of Table I and of the shipped band plan."""
    from matplotlib import pyplot

    lags = np.linspace(0, 6, 12000)
    plans = {
        'Table I': Scenario(),
        'config/bandplan.yaml': Scenario.from_yaml(
            default_codebook_file().parent / 'bandplan.yaml')}
    figure, axes = pyplot.subplots(
        len(plans), num='Range ambiguity functions of Table I and of config/bandplan.yaml',
        figsize=(8, 4), sharex=True, sharey=True, layout='constrained')
    for axis, (name, scenario) in zip(axes, plans.items(), strict=True):
        frequencies = np.array(scenario.center_frequencies_hz)
        turns = np.multiply.outer(lags, frequencies) / SPEED_OF_LIGHT_MPS
        axis.plot(lags, np.mean(1 - np.cos(2 * np.pi * turns), axis=1), lw=0.6)
        bands = ', '.join(f'{frequency / 1e9:g}' for frequency in frequencies)
        axis.set(title=f'{name}: {bands} GHz', ylabel='mismatch', xlim=(0, 6), ylim=(0, 2))
    axes[-1].set_xlabel('difference of the ranges [m]')
    return figure


def hall():
    """Return the propagation paths of one user of ``config/hall.yaml``, from above."""
    from matplotlib import pyplot

    scenario = Scenario.from_yaml(default_codebook_file().parent / 'hall.yaml')
    paths = scenario.channel
    user = int(np.argmin(np.linalg.norm(paths.users - [11.5, 3.0, -0.5], axis=1)))
    direct = paths.n[user] == 0
    levels_db = 20 * np.log10(np.maximum(np.abs(paths.a[user]) / np.abs(paths.a[user][direct]),
                                         1e-12))
    figure, axis = pyplot.subplots(
        num='Virtual sources of the propagation paths of a user in a hall, from above',
        figsize=(8, 4.6), layout='constrained')
    # The corners of the hall are those of docs/examples/box_hall.py.
    axis.add_patch(pyplot.Rectangle((-0.05, -7), 20, 14, fill=False, label='walls'))
    low, high = scenario.roi_bounds_m
    axis.add_patch(pyplot.Rectangle(
        low[:2], *(high - low)[:2], fc='C0', alpha=0.2, label='region of interest'))
    # Strong paths cover weak ones.
    shown = np.argsort(levels_db)[np.sum(levels_db <= -40):]
    for path in shown:
        axis.plot(*np.array([[0, 0], paths.src[user, path, :2]]).T, color='0.7', lw=0.5, zorder=1)
    points = axis.scatter(
        *paths.src[user, shown, :2].T, c=levels_db[shown], cmap='viridis', s=18, zorder=2)
    axis.plot(*paths.users[user, :2], 'o', mec='C3', mfc='none', ms=9, label='user')
    axis.plot(0, 0, 'ks', ms=5, label='surface')
    figure.colorbar(points, label='relative to the direct path [dB]')
    axis.set(xlabel='$x$ [m]', ylabel='$y$ [m]', aspect='equal')
    axis.legend(loc='upper right', fontsize='small')
    return figure


FUNCTIONS = {function.__name__: function for function in (geometry, range_ambiguity, hall)}


def image_node(directive, file, alt):
    """Return an image of a file of the resolution `DPI`, which may be outside of the sources."""
    # The header of a PNG file contains its width [pixels].
    (width,) = struct.unpack('>I', file.read_bytes()[16:20])
    page = Path(directive.env.doc2path(directive.env.docname))
    return nodes.image(uri=Path(os.path.relpath(file, page.parent)).as_posix(), alt=alt,
                       width=f'{width * 96 // DPI}px', classes=['drawn'])


class Picture(SphinxDirective):
    """Directive that draws a picture."""

    required_arguments = 1

    def run(self):
        """Return the image."""
        from matplotlib import pyplot

        (name,) = self.arguments
        figure = FUNCTIONS[name]()
        file = Path(self.env.doctreedir) / f'{name}.png'
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file, dpi=DPI)
        pyplot.close(figure)
        return [image_node(self, file, figure.get_label())]


def setup(app):
    """Register the directive."""
    app.add_directive('picture', Picture)
    return {'parallel_read_safe': True}
