"""The executables: each a thin adapter between a role and ROS 2."""

import os

# Many small products in many processes: threads of the linear algebra only fight for the cores.
# This takes effect because it comes before NumPy is loaded.
for _name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
