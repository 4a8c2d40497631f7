"""An impairment without a package: the class takes the place of its name in a scenario."""

import numpy as np

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Impairment, Linear, Scenario


class BandGain(Impairment):
    """A gain of each band; the strength is its standard deviation [Np]."""

    def __init__(self, strength):
        self.strength = strength

    def linear(self, scenario):
        """Return a real exponent for each band."""
        n, size = scenario.n_bands, scenario.n_subbands * scenario.n_frames
        patterns = np.eye(n)[:, :, None] * np.ones(size, complex)
        return Linear(patterns, self.strength * np.eye(n))


positions = Scenario().sample_positions(50, np.random.default_rng(0))
for strength in (0.0, 0.3):
    print(crlb(Scenario(impairments={BandGain: strength}), Codebook.default(), positions).mean())
