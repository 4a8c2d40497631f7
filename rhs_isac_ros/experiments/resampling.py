"""Bootstrap intervals of comparisons."""

from collections.abc import Callable

import numpy as np

_RESAMPLES = 2000
_INTERVAL = (2.5, 97.5)


def reduction(
        ours: np.ndarray, theirs: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray],
        paired: bool = True) -> tuple[float, float, float]:
    """Return the relative reduction of a statistic and its 95 % interval.

    The interval is that of the percentile bootstrap, with a fixed seed.

    Parameters
    ----------
    ours, theirs
        Samples, float64 [N]; if paired, equal indices belong to the same case.
    statistic
        Callable that takes samples, float64 [..., N], and returns float64 [...].
    paired
        Whether to resample both with the same indices.

    Returns
    -------
    tuple of float
        Reduction and the ends of its interval [%]; NaN or infinite where theirs is 0.

    Raises
    ------
    ValueError
        If a sample is empty, or paired samples differ in length.
    """
    ours, theirs = np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float)
    if not len(ours) or not len(theirs) or (paired and len(ours) != len(theirs)):
        raise ValueError(f'ours, theirs: {len(ours)} and {len(theirs)} values, expected at '
                         'least one each, and equally many if paired')
    rng = np.random.default_rng(0)
    picks = rng.integers(len(ours), size=(_RESAMPLES, len(ours)))
    others = picks if paired else rng.integers(len(theirs), size=(_RESAMPLES, len(theirs)))
    with np.errstate(divide='ignore', invalid='ignore'):
        samples = 1 - statistic(ours[picks]) / statistic(theirs[others])
        low, high = np.percentile(100 * samples, _INTERVAL)
        return 100 * float(1 - statistic(ours) / statistic(theirs)), float(low), float(high)
