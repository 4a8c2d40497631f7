"""A disc of elements: a board whose elements outside of a circle do not radiate."""

import numpy as np

from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elementwise import Elementwise


class Disc(Elementwise):
    """Amplitudes as in the paper, on the largest disc in the surface."""

    kind = 'disc'

    def coefficients(self, ports, tunings):
        """Return the tunings, and 0 outside of the disc, [B, 1, Q, N_E]."""
        return tunings[:, None] * self.slopes(ports, tunings)

    def slopes(self, ports, tunings):
        """Return 1 on the disc and 0 elsewhere, [N_E]."""
        distances, edge = np.linalg.norm(ports.elements_m, axis=1), ports.elements_m.max()
        return (distances <= edge).astype(float)


print(optimize(Scenario(board=Disc()), n_positions=16, max_steps=20).codebook.average_crlb_m2)
