#!/usr/bin/env bash
# filterpy 2.0.0: the likelihood of a measurement depends on its units. With a range of 100 m and an angle of 1 mrad as
# standard deviations, and the angle in radians, the likelihood leaves the angle out where it is near the prediction, and
# is zero elsewhere. In milliradians, it is right. An IMM of two models is certain in the first case, and not in the second.
#
# Guess before the run: the logarithms differ by that of 1000 for any units, and the probabilities of the IMM are the same.
# Source: `logpdf` of filterpy.stats, with which SciPy takes a covariance for singular if its eigenvalues differ by a factor
# of more than 5e9. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'filterpy==2.0.0' 'numpy==2.3.5' 'scipy==1.17.1'
cat > "$folder/observe.py" <<'PYTHON'
from importlib.metadata import version

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter

RANGE_M, ANGLE_RAD = 100.0, 1e-3


def model(angle_rad, unit):
    """Return a filter that knows the range and this angle, and measures both."""
    found = KalmanFilter(dim_x=2, dim_z=2)
    found.x = np.array([[10e3], [angle_rad * unit]])
    found.P, found.Q = np.zeros((2, 2)), np.zeros((2, 2))
    found.H, found.R = np.eye(2), np.diag([RANGE_M**2, (ANGLE_RAD * unit)**2])
    return found


print('filterpy', version('filterpy'), 'scipy', version('scipy'))
for name, unit in ('rad', 1.0), ('mrad', 1000.0):
    # The angle is two standard deviations from the first model, and three from the second.
    measured = np.array([[10e3], [2e-3 * unit]])
    both = IMMEstimator([model(0.0, unit), model(5e-3, unit)], [0.5, 0.5], np.eye(2))
    both.update(measured)
    for number, (one, deviations) in enumerate(zip(both.filters, (2, 3))):
        exact = -deviations**2 / 2 - np.log(2 * np.pi * RANGE_M * ANGLE_RAD * unit)
        print(f'{name}, model {number}: log-likelihood {one.log_likelihood:.3f}, by hand '
              f'{exact:.3f}; probability {both.mu[number]:.4f}')
PYTHON
found=$(timeout 60 "$folder/venv/bin/python" -W ignore "$folder/observe.py")
echo "$found"
[[ $found == 'filterpy 2.0.0 scipy 1.17.1
rad, model 0: log-likelihood -5.524, by hand -1.535; probability 1.0000
rad, model 1: log-likelihood -inf, by hand -4.035; probability 0.0000
mrad, model 0: log-likelihood -8.443, by hand -8.443; probability 0.9241
mrad, model 1: log-likelihood -10.943, by hand -10.943; probability 0.0759' ]]
