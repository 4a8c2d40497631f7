"""An NR grid: 24 resource blocks of numerology 1, with PRS on every fourth sub-carrier."""

import numpy as np

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario, nr_grid
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.system import System

scenario = Scenario(
    center_frequencies_hz=(3.5e9,), elements_per_side=8, roi_size_m=(4.0, 4.0, 1.0),
    roi_center_m=(5.0, 0.0, 0.0), multipath_to_los_db=-20,
    **nr_grid(numerology=1, resource_blocks=24, symbols=6, comb=4))
system = System(scenario, random_codebook(scenario, np.random.default_rng(0)))
positions, received = system.pairs(20, seed=1)
estimate = make_estimator('bayes', scenario, system.codebook).estimate(received)
print(scenario.n_subbands, np.median(np.linalg.norm(estimate.mean - positions, axis=1)))
