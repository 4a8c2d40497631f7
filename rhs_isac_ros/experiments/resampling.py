"""Bootstrap intervals over cases and members, and confidence intervals of shares."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_RESAMPLES = 2000
_INTERVAL = (2.5, 97.5)


class Interval(NamedTuple):
    """A value and the ends of its 95 % interval."""

    value: float
    low: float
    high: float


class Replicates(NamedTuple):
    """A statistic over several members and cases, with its replicates from the bootstrap.

    Cases are, for example, positions; members are repetitions, such as other random codebooks.
    """

    #: The statistic, followed by its replicates, which resample cases and members, float64
    #: [1 + replicates]; NaN if a replicate contains no result.
    values: np.ndarray
    by_member: np.ndarray  #: Like `values`, but the replicates resample only members.
    n_members: int

    def minus(self, other: 'Replicates') -> 'Replicates':
        """Return this statistic minus another one of the same members and cases."""
        return Replicates(
            self.values - other.values, self.by_member - other.by_member, self.n_members)

    def interval(self) -> Interval:
        """Return the statistic and its 95 % interval."""
        return _interval(self.values, [(self.by_member, self.n_members)])

    def reduction_from(self, baseline: 'Replicates') -> Interval:
        """Return the reduction relative to a baseline, and its 95 % interval [%].

        The cases are paired if both statistics have the same number of cases.
        """
        with np.errstate(divide='ignore', invalid='ignore'):
            ratios, own, other = (one / two for one, two in (
                (self.values, baseline.values), (self.by_member, baseline.values[0]),
                (self.values[0], baseline.by_member)))
        ratio, low, high = _interval(
            ratios, [(own, self.n_members), (other, baseline.n_members)])
        return Interval(100 * (1 - ratio), 100 * (1 - high), 100 * (1 - low))


def replicate(results: np.ndarray, seed: int, quantiles: Sequence[float] = ()) -> list[Replicates]:
    """Return the mean or quantiles of results, each with replicates over cases and members.

    `results` are float64 [members, cases], NaN where a member has no result for a case. Of M
    members, M - 1 are drawn with replacement, which makes the variance of the replicates unbiased
    (Rao and Wu, Resampling inference with complex survey data, 1988). A single member contributes
    no variance. Use different seeds for different sets of members. Results with the same number of
    cases share the resampled cases. `quantiles` are from 0 to 1; if empty, return the mean.
    Raises ValueError if no result is finite, or a quantile is out of range.
    """
    if results.ndim != 2 or not np.isfinite(results).any():
        raise ValueError(f'results: shape {results.shape}, expected [members, cases] with a '
                         'finite value')
    if not all(0 <= quantile <= 1 for quantile in quantiles):
        raise ValueError(f'quantiles: {quantiles}, expected 0 to 1')
    n_members, n_cases = results.shape
    rng, drawn = np.random.default_rng([1, seed]), max(n_members - 1, 1)
    members = np.vstack([
        np.ones(n_members), rng.multinomial(drawn, np.full(n_members, 1 / n_members), _RESAMPLES)])
    resampled = _case_weights(n_cases)
    statistic = functools.partial(_quantiles, quantiles=quantiles) if quantiles else _mean
    with np.errstate(invalid='ignore'):
        values = statistic(results, members, resampled)
        by_member = statistic(results, members, np.broadcast_to(resampled[:1], resampled.shape))
    # Both begin with the statistic, but products of matrices of other strides round differently.
    values[:, 0] = by_member[:, 0]
    return [Replicates(*rows, n_members) for rows in zip(values, by_member, strict=True)]


def share_percent(count: int, total: int) -> Interval:
    """Return `count` relative to `total` [%], and the ends of Wilson's 95 % interval [%]."""
    if total < 1:
        raise ValueError(f'total: {total}, expected at least 1')
    from scipy.special import ndtri
    z2 = float(ndtri(0.975))**2
    centre = (count + z2 / 2) / (total + z2)
    half = np.sqrt(z2 * (count * (total - count) / total + z2 / 4)) / (total + z2)
    return Interval(
        100 * count / total, 100 * float(centre - half), 100 * float(centre + half))


def _mean(results: np.ndarray, members: np.ndarray, cases: np.ndarray) -> np.ndarray:
    """Return the mean for each row of weights of members and cases, float64 [1, rows]."""
    present = np.isfinite(results)
    sums = cases @ np.where(present, results, 0.0).astype(np.float32).T
    counts = cases @ present.T.astype(np.float32)
    return (np.sum(members * sums, axis=1) / np.sum(members * counts, axis=1))[None]


def _quantiles(results: np.ndarray, members: np.ndarray, cases: np.ndarray,
               quantiles: Sequence[float]) -> np.ndarray:
    """Return quantiles for each row of weights of members and cases, float64 [Q, rows]."""
    member, case = np.nonzero(np.isfinite(results))
    order = np.argsort(results[member, case])
    member, case = member[order], case[order]
    ordered, found = results[member, case], np.full((len(quantiles), len(cases)), np.nan)
    for index, (by_member, by_case) in enumerate(zip(members, cases, strict=True)):
        total = np.cumsum(by_member[member] * by_case[case], dtype=float)
        if total[-1]:
            found[:, index] = ordered[np.searchsorted(total, np.array(quantiles) * total[-1])]
    return found


def _interval(values: np.ndarray, parts: Sequence[tuple[np.ndarray, int]]) -> Interval:
    """Return the first value, and the 95 % interval of the other values, its replicates.

    With few members, the percentiles are too close to the statistic. Their distances from it are
    multiplied by the ratio of the quantiles of Student's t and the normal distribution, with
    Satterthwaite's degrees of freedom. Each part contains the replicates due to the members of one
    sample, and the number of members. The scale is logarithmic if all values are positive.
    """
    with np.errstate(invalid='ignore'):
        if all(np.nanmin(array) > 0 for array in (values, *(part for part, _ in parts))):
            logarithms = _spread(np.log(values), [(np.log(part), n) for part, n in parts])
            return Interval(*np.exp(logarithms).tolist())
        return _spread(values, parts)


def _spread(values: np.ndarray, parts: Sequence[tuple[np.ndarray, int]]) -> Interval:
    # Division by zero yields infinite ratios, between which percentiles must not interpolate.
    low, high = np.nanpercentile(values[1:], _INTERVAL, method='inverted_cdf')
    total = np.nanvar(values[1:])**2
    uncertain = sum(np.nanvar(part[1:])**2 / (n - 1) for part, n in parts if n > 1)
    widening = 1.0
    if uncertain > 0 and np.isfinite(total):
        from scipy.special import ndtri, stdtrit
        widening = float(stdtrit(max(total / uncertain, 1.0), 0.975) / ndtri(0.975))
    return Interval(float(values[0]), float(values[0] + widening * (low - values[0])),
                    float(values[0] + widening * (high - values[0])))


@functools.lru_cache(maxsize=2)
def _case_weights(n: int) -> np.ndarray:
    """Return the multiplicities of the cases, float32 [1 + replicates, n]; row 0 has ones."""
    rng = np.random.default_rng(0)
    weights = np.ones((1 + _RESAMPLES, n), np.float32)
    for row in weights[1:]:
        row[:] = np.bincount(rng.integers(n, size=n), minlength=n)
    return weights
