"""The gain pattern of a patch antenna: 6 dBi on boresight, no backward radiation."""

import numpy as np

from rhs_isac_ros.model import GainPattern


def amplitude(angles):
    """Return the amplitude gain; its square is the power gain 4 cos^2."""
    return 2 * np.maximum(np.cos(angles), 0)


def slope(angles):
    """Return the derivative [1/rad]; it is optional, and finite differences are the default."""
    return np.where(np.cos(angles) > 0, -2 * np.sin(angles), 0.0)


PATCH = GainPattern(amplitude, slope)
