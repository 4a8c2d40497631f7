"""Print the mean squared errors of estimators on the same simulated signals.

Arguments: system file, names of estimators.
"""

import sys

import numpy as np

from rhs_isac_ros.positioning import EstimatorKind
from rhs_isac_ros.system import System

system = System.from_yaml(sys.argv[1])
positions, received = system.pairs(1000, seed=1)
for name in sys.argv[2:]:
    estimate = EstimatorKind(name).create(system).estimate(received)
    errors = np.sum((estimate.mean - positions)**2, axis=1)
    print(f'{name} {np.nanmean(errors):.3f} m^2')
