"""The executables that run nodes, most of them thin adapters between a role and ROS 2."""

import os

from rhs_isac_ros.ros.environment import check_middleware

# Many processes compute small matrix products, so additional threads would only compete for the
# cores. The libraries read these variables when NumPy is imported, so they are set before that.
for _name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
    os.environ.setdefault(_name, '1')

check_middleware()
