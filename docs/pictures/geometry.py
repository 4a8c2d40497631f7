"""The surface with its feeds, and the region of interest, of Table I."""

from matplotlib import pyplot

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_positions, feed_positions

scenario = Scenario()
figure, (plan, board) = pyplot.subplots(1, 2, figsize=(8, 3.6), layout='constrained')
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
