"""A board without a package: elements whose amplitude is the square of their tuning."""

import numpy as np

from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elementwise import Elementwise


class Squared(Elementwise):
    """Amplitudes that are the squares of tunings."""

    kind = 'squared'

    def coefficients(self, ports, tunings):
        """Return the coefficients, [B, 1, Q, N_E]."""
        return tunings[:, None]**2

    def slopes(self, ports, tunings):
        """Return their derivatives."""
        return 2 * tunings[:, None]


result = optimize(Scenario(board=Squared()), n_positions=16, max_steps=20)
print(np.round([result.history[step].value_m2 for step in (0, -1)], 4))
