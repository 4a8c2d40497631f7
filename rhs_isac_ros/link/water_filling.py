"""Water-filling: the optimal division of power among parallel channels."""

import numpy as np


def water_filling(gains: np.ndarray, power_w: float) -> np.ndarray:
    """Divide power [W] among channels so that the sum of log(1 + gain * share) is highest.

    The gains are relative to noise, float64 [N] [1/W]. The shares, float64 [N] [W], are not
    negative and have the sum `power_w`. If no gain is positive, all shares are equal.
    """
    useful = gains > 0
    if not useful.any():
        return np.full(len(gains), power_w / len(gains))
    floors = np.sort(1 / gains[useful])
    levels = (power_w + np.cumsum(floors)) / np.arange(1, len(floors) + 1)
    (filled,) = np.nonzero(levels > floors)
    shares = np.zeros(len(gains))
    if not len(filled):
        # The gains are so small that the power is lost in the rounding of the level.
        shares[np.argmax(gains)] = power_w
        return shares
    level = levels[filled[-1]]
    shares[useful] = np.maximum(level - 1 / gains[useful], 0.0)
    return shares
