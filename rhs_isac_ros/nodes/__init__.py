"""The executables of the roles: thin adapters between a role and ROS 2."""

import os

# The matrix products are small and there are many processes, so additional threads would only
# compete for the cores. The libraries read these variables when NumPy is first imported, which
# happens after this module is imported.
for _name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
