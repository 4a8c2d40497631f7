"""The propagation paths of one user of ``config/hall.yaml``, from above."""

import numpy as np
from matplotlib import pyplot

from rhs_isac_ros.codebook import default_codebook_file
from rhs_isac_ros.model import Scenario

scenario = Scenario.from_yaml(default_codebook_file().parent / 'hall.yaml')
paths = scenario.channel
user = int(np.argmin(np.linalg.norm(paths.users - [11.5, 3.0, -0.5], axis=1)))
direct = paths.n[user] == 0
levels_db = 20 * np.log10(np.maximum(np.abs(paths.a[user]) / np.abs(paths.a[user][direct]),
                                     1e-12))
figure, axis = pyplot.subplots(figsize=(8, 4.6), layout='constrained')
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
