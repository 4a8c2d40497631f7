"""Water-filling: the optimal division of power among parallel channels."""

import numpy as np


def water_filling(gains: np.ndarray, power: float) -> np.ndarray:
    """Divide power among channels so that the sum of log(1 + gain * share) is highest.

    Parameters
    ----------
    gains
        Gain over noise of each channel, float64 [N] [1/W]. If none is positive, all channels get
        the same share.
    power
        Power to divide [W].

    Returns
    -------
    numpy.ndarray
        Shares, float64 [N] [W], none negative, with the sum `power`.
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
