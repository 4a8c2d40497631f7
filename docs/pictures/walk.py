"""A walk through the lab, from above: positions of a user who stops, and of one who walks on.

``python3 docs/pictures/walk.py FILE`` also writes the picture to a file.
"""

import sys

import numpy as np
from matplotlib import pyplot
from matplotlib.patches import Ellipse

from rhs_isac_ros.codebook import default_codebook_file
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.system import System

SPEED_MPS, N_CYCLES = 1.0, 12
# Squared radius of the 95 % region in a plane, and time that an arrow covers.
REGION, ARROW_S = 5.99, 0.5

system = System.from_yaml(default_codebook_file().parent / 'lab_walk_system.yaml')
estimator, rng = BayesEstimator(system), np.random.default_rng(7)
# Once around the centre of the region, at a constant speed.
centre, radius_m = np.array([4.0, 0.0]), 1.4
angle = 2 * np.pi * np.arange(N_CYCLES) / N_CYCLES
ways = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(N_CYCLES)])
places = np.zeros((N_CYCLES, 3))
places[:, :2] = centre + radius_m * np.column_stack([np.cos(angle), np.sin(angle)])

figure, panels = pyplot.subplots(1, 2, figsize=(9, 5.1), layout='constrained', sharey=True)
low, high = system.scenario.roi_bounds_m[:, :2]
for axis, speed_mps, title in zip(panels, (0.0, SPEED_MPS), (
        'at rest in each cycle', f'walking at {SPEED_MPS:g} m/s'), strict=True):
    states = np.hstack([places, speed_mps * ways])
    found = estimator.estimate(system.sample(states, rng))
    axis.add_patch(pyplot.Rectangle(low, *(high - low), fc='0.92'))
    for mean, covariance in zip(found.mean[found.fix], found.covariance[found.fix], strict=True):
        variances, axes = np.linalg.eigh(covariance[:2, :2])
        axis.add_patch(Ellipse(
            mean[:2], *2 * np.sqrt(REGION * variances), fill=False, ec='0.5',
            angle=np.degrees(np.arctan2(*axes[::-1, 0]))))
    axis.plot(*places[:, :2].T, 'k+', ms=8, label='true position')
    axis.plot(*found.mean[:, :2].T, 'o', color='C0', mfc='none', label='estimate')
    axis.plot([], [], color='0.5', label='95 % region')
    arrows = dict(angles='xy', scale_units='xy', scale=1 / ARROW_S, width=0.006)
    axis.quiver(*places[:, :2].T, *states[:, 3:5].T, color='k', **arrows, label='true velocity')
    axis.quiver(*found.mean[:, :2].T, *found.velocity[:, :2].T, color='C0', **arrows,
                label='estimated velocity')
    axis.set(xlabel='$x$ [m]', title=title, aspect='equal',
             xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(low[1] - 0.3, high[1] + 0.3))
panels[0].set_ylabel('$y$ [m]')
panels[0].legend(*panels[1].get_legend_handles_labels(), loc='center', fontsize='x-small')
if len(sys.argv) > 1:
    figure.savefig(sys.argv[1], dpi=120)
