"""The executables of the roles: thin adapters between a role and ROS 2."""

import os

# The matrix products are small and the processes many: further threads would only compete for the
# cores. The libraries read the variables when NumPy is first imported, which is after this module.
for _name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
