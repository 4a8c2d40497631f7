"""Print the mean squared errors of estimators on the same simulated signals.

Arguments: scenario file, codebook file, names of estimators.
"""

import sys

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.system import System

scenario = Scenario.from_yaml(sys.argv[1])
codebook = Codebook.load(sys.argv[2])
positions, received = System(scenario, codebook).pairs(1000, seed=1)
for name in sys.argv[3:]:
    estimate = make_estimator(name, scenario, codebook).estimate(received)
    errors = np.sum((estimate.mean - positions)**2, axis=1)
    print(f'{name} {np.nanmean(errors):.3f} m^2')
