"""A mobility: a user who moves on a circle."""

import numpy as np


class Circle:
    """A circle of 2 m radius around the centre of the region, at constant speed.

    If `start` is given, the user begins at the point of the circle closest to it.
    """

    RADIUS_M = 2.0

    def __init__(self, scenario, speed_mps, rng, start):
        self._center = np.array(scenario.roi_center_m)
        self._rate = speed_mps / self.RADIUS_M
        if start is None:
            self._angle = rng.uniform(0, 2 * np.pi)
        else:
            self._angle = np.arctan2(*(np.array(start) - self._center)[[1, 0]])
        self._begin_s = None

    def state(self, now_s):
        """Return position [m] and velocity [m/s], [3] each; the epoch of `now_s` is arbitrary."""
        if self._begin_s is None:
            self._begin_s = now_s
        angle = self._angle + self._rate * (now_s - self._begin_s)
        radial = np.array([np.cos(angle), np.sin(angle), 0.0])
        tangential = np.array([-np.sin(angle), np.cos(angle), 0.0])
        return self._center + self.RADIUS_M * radial, self.RADIUS_M * self._rate * tangential
