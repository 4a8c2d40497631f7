"""Bootstrap intervals of comparisons, over cases alone or over cases and members."""

import functools
from collections.abc import Callable, Sequence

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


class Statistics:
    """Mean, median and interquartile range of results of several members, with replicates.

    A member is what is repeated besides the cases: a training, or a draw of a codebook. Each
    replicate of the bootstrap resamples cases and members. Objects with the same number of cases
    share the resampled cases, which makes their comparisons paired, and resample their members
    independently.

    Of M members, M - 1 are drawn with replacement, which makes the variance of the replicates
    unbiased (Rao and Wu, Resampling inference with complex survey data, 1988). The variance
    between members is not included if there is only one.

    Attributes
    ----------
    values
        Statistic of the results, then of the replicates, float64 [1 + replicates], by name:
        ``mean``, and for each quantile its number.

    Parameters
    ----------
    results
        Float64 [members, cases]; NaN where a member has no result for a case.
    seed
        Seed of the resampled members; different for results with other members.
    quantiles
        Quantiles to compute.
    """

    def __init__(self, results: np.ndarray, seed: int, quantiles: Sequence[float] = ()) -> None:
        n_members, n_cases = results.shape
        rng, drawn = np.random.default_rng([1, seed]), max(n_members - 1, 1)
        members = np.vstack([
            np.ones(n_members),
            rng.multinomial(drawn, np.full(n_members, 1 / n_members), _RESAMPLES)])
        cases = _case_weights(n_cases)
        present = np.isfinite(results)
        filled = np.where(present, results, 0.0).astype(np.float32)
        sums, counts = cases @ filled.T, cases @ present.T.astype(np.float32)
        # A replicate without any result is NaN.
        with np.errstate(invalid='ignore'):
            self.values = {
                'mean': np.sum(members * sums, axis=1) / np.sum(members * counts, axis=1)}
        if quantiles:
            self._add_quantiles(results, members.astype(np.float32), cases, quantiles)

    def _add_quantiles(self, results: np.ndarray, members: np.ndarray, cases: np.ndarray,
                       quantiles: Sequence[float]) -> None:
        member, case = np.nonzero(np.isfinite(results))
        order = np.argsort(results[member, case])
        member, case = member[order], case[order]
        ordered, found = results[member, case], np.empty((len(quantiles), len(cases)))
        for index, (by_member, by_case) in enumerate(zip(members, cases, strict=True)):
            total = np.cumsum(by_member[member] * by_case[case], dtype=float)
            # A replicate without any result is NaN.
            found[:, index] = (
                ordered[np.searchsorted(total, np.array(quantiles) * total[-1])]
                if total[-1] else np.nan)
        self.values |= dict(zip(map(str, quantiles), found, strict=True))


def interval(replicates: np.ndarray) -> tuple[float, float, float]:
    """Return the first value, and the 95 % interval of the replicates that follow it.

    Replicates that are NaN do not count.
    """
    low, high = np.nanpercentile(replicates[1:], _INTERVAL)
    return float(replicates[0]), float(low), float(high)


@functools.lru_cache(maxsize=2)
def _case_weights(n: int) -> np.ndarray:
    """Return how often each case is drawn, float32 [1 + replicates, n]; once in the first row."""
    rng = np.random.default_rng(0)
    weights = np.ones((1 + _RESAMPLES, n), np.float32)
    for row in weights[1:]:
        row[:] = np.bincount(rng.integers(n, size=n), minlength=n)
    return weights
