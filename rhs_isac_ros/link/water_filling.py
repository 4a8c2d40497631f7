"""Water-filling: the optimal division of power among parallel channels."""

import numpy as np

# Gains above this have finite reciprocals.
_MIN_GAIN = 1e-300


def water_filling(gains: np.ndarray, power_w: float) -> np.ndarray:
    """Divide power [W] among channels so that the sum of log(1 + gain * share) is highest.

    The gains are relative to noise, float64 [..., N] [1/W]; each row is a problem of its own. The
    shares, float64 [..., N] [W], are not negative, and those of a row have the sum `power_w`. If
    no gain of a row is positive, its shares are equal.
    """
    n = gains.shape[-1]
    if n == 1:
        return np.full(gains.shape, power_w)
    if gains.min() > _MIN_GAIN:
        floors = 1 / gains
        level = (power_w + floors.sum(axis=-1, keepdims=True)) / n
        if (level > floors).all():
            # Every channel is above its floor, as usual.
            filled: np.ndarray = level - floors
            return filled
    # Without any gain, all levels and floors are infinite.
    with np.errstate(divide='ignore', over='ignore', invalid='ignore'):
        floors = 1 / np.maximum(gains, 0)
        ranked = np.sort(floors, axis=-1)
        levels = (power_w + np.cumsum(ranked, axis=-1)) / np.arange(1, n + 1)
        # The channels above their floor are the first ones in the order of the floors.
        n_filled = np.sum(levels > ranked, axis=-1, keepdims=True)
        level = np.take_along_axis(levels, np.maximum(n_filled - 1, 0), axis=-1)
        shares: np.ndarray = np.maximum(level - floors, 0.0)
    if n_filled.all():
        return shares
    # The gains are so small that the power is lost in the rounding of the level.
    best = power_w * (np.arange(n) == np.argmax(gains, axis=-1)[..., None])
    even = np.broadcast_to(power_w / n, gains.shape)
    lost = np.where(gains.max(axis=-1, keepdims=True) > 0, best, even)
    return np.where(n_filled > 0, shares, lost)
