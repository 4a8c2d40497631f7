"""Bootstrap intervals of comparisons."""

from collections.abc import Callable

import numpy as np

_RESAMPLES = 2000
_INTERVAL = (2.5, 97.5)


def reduction(
        samples: np.ndarray, baseline: np.ndarray,
        statistic: Callable[[np.ndarray], np.ndarray], paired: bool = True
) -> tuple[float, float, float]:
    """Return the relative reduction of a statistic and its 95 % interval.

    The interval is that of the percentile bootstrap, with a fixed seed.

    Parameters
    ----------
    samples, baseline
        Samples, float64 [N]; if paired, equal indices belong to the same case.
    statistic
        Callable that takes samples, float64 [..., N], and returns float64 [...].
    paired
        Whether to resample both with the same indices.

    Returns
    -------
    tuple of float
        Reduction and the ends of its interval [%]; NaN or infinite where the statistic of the
        baseline is 0.

    Raises
    ------
    ValueError
        If a sample is empty, or paired samples differ in length.
    """
    samples, baseline = np.asarray(samples, dtype=float), np.asarray(baseline, dtype=float)
    n_samples, n_baseline = len(samples), len(baseline)
    if not n_samples or not n_baseline or (paired and n_samples != n_baseline):
        raise ValueError(f'samples, baseline: {n_samples} and {n_baseline} values, expected at '
                         'least one each, and the same number if paired')
    rng = np.random.default_rng(0)
    picks = rng.integers(n_samples, size=(_RESAMPLES, n_samples))
    others = picks if paired else rng.integers(n_baseline, size=(_RESAMPLES, n_baseline))
    with np.errstate(divide='ignore', invalid='ignore'):
        reductions = 1 - statistic(samples[picks]) / statistic(baseline[others])
        low, high = np.percentile(100 * reductions, _INTERVAL)
        return 100 * float(1 - statistic(samples) / statistic(baseline)), float(low), float(high)
