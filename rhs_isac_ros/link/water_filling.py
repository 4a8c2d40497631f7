"""Water-filling: the optimal division of power among parallel channels."""

import numpy as np


def water_filling(gains: np.ndarray, power: float) -> np.ndarray:
    """Divide power [W] among channels so that the sum of log(1 + gain * share) is highest.

    The gains are over noise, float64 [N] [1/W]. The shares, float64 [N] [W], are not negative and
    have the sum `power`. If no gain is positive, all shares are equal.
    """
    useful = gains > 0
    if not useful.any():
        return np.full(len(gains), power / len(gains))
    floors = np.sort(1 / gains[useful])
    levels = (power + np.cumsum(floors)) / np.arange(1, len(floors) + 1)
    (filled,) = np.nonzero(levels > floors)
    shares = np.zeros(len(gains))
    if not len(filled):
        # The gains are so small that the power is lost in the rounding of the level.
        shares[np.argmax(gains)] = power
        return shares
    level = levels[filled[-1]]
    shares[useful] = np.maximum(level - 1 / gains[useful], 0.0)
    return shares
