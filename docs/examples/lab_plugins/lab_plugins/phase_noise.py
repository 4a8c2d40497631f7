"""An impairment: phase noise of an oscillator, a random walk over the frames of a cycle."""

import numpy as np

from rhs_isac_ros.model import Impairment, Linear


class PhaseNoise(Impairment):
    """A phase that changes from each frame to the next, through all bands of a cycle.

    The strength is the standard deviation of the change from one frame to the next [rad].
    """

    def __init__(self, strength):
        self._std_rad = strength

    def linear(self, scenario):
        """Return an exponent for the phase of each frame, and the prior of a random walk."""
        shape = scenario.n_bands, scenario.n_subbands, scenario.n_frames
        patterns = np.zeros((scenario.n_bands * scenario.n_frames, *shape), complex)
        for number, pattern in enumerate(patterns):
            band, frame = divmod(number, scenario.n_frames)
            pattern[band, :, frame] = 1j
        # Each phase is the sum of all changes so far.
        root = self._std_rad * np.tri(len(patterns))
        return Linear(patterns.reshape(len(patterns), scenario.n_bands, -1), root)
