"""Bootstrap intervals of comparisons."""

import numpy as np
import pytest

from rhs_isac_ros.experiments.resampling import Statistics, interval, reduction


def mean(values):
    return values.mean(axis=-1)


def test_the_reduction_is_that_of_the_statistics():
    less, low, high = reduction([1.0, 2.0, 3.0], [4.0, 4.0, 4.0], mean)
    assert less == pytest.approx(50)
    assert low < 50 < high


def test_paired_samples_have_narrower_intervals():
    rng = np.random.default_rng(0)
    baseline = rng.exponential(size=500)
    samples = 0.6 * baseline
    less, low, high = reduction(samples, baseline, mean)
    assert (less, low, high) == pytest.approx((40, 40, 40))
    less, low, high = reduction(samples, baseline, mean, paired=False)
    assert less == pytest.approx(40)
    assert high - low > 5


def test_intervals_have_their_nominal_coverage():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(100):
        samples, baseline = rng.normal(3.0, 1.0, 60), rng.normal(4.0, 1.0, 60)
        _, low, high = reduction(samples, baseline, mean)
        inside += low <= 25 <= high
    assert 88 <= inside <= 99


@pytest.mark.parametrize(('samples', 'baseline', 'paired'), [
    ([], [1.0], False), ([1.0], [], False), ([1.0], [1.0, 2.0], True)])
def test_empty_or_mismatched_samples_are_errors(samples, baseline, paired):
    with pytest.raises(ValueError, match='^samples, baseline: '):
        reduction(samples, baseline, mean, paired)


def test_the_reduction_from_zero_is_nan():
    assert np.isnan(reduction([0.0, 0.0], [0.0, 0.0], mean)).all()


def test_statistics_without_resampling_are_those_of_the_results():
    results = np.random.default_rng(0).exponential(size=(3, 41))
    values = Statistics(results, 0, (0.25, 0.5)).values
    assert values['mean'][0] == pytest.approx(results.mean(), rel=1e-6)
    assert values['0.5'][0] == np.median(results)
    assert values['0.25'][0] == np.quantile(results, 0.25, method='inverted_cdf')


def test_statistics_ignore_cases_that_a_member_did_not_serve():
    results = np.tile([[1.0, np.nan, 3.0, np.nan], [np.nan, 5.0, np.nan, 6.0]], 10)
    values = Statistics(results, 0, (0.5,)).values
    assert values['mean'][0] == pytest.approx(15 / 4)
    assert values['0.5'][0] == 3


def test_comparisons_of_the_same_cases_are_paired():
    results = np.random.default_rng(0).exponential(size=(1, 200))
    one, other = (Statistics(factor * results, seed).values['mean']
                  for seed, factor in enumerate((1.0, 2.0)))
    np.testing.assert_allclose(one / other, 0.5, rtol=1e-5)


@pytest.mark.parametrize('members', [2, 5])
def test_the_variance_of_the_replicates_includes_that_of_the_members(members):
    rng, inside, estimates, spreads = np.random.default_rng(0), 0, [], []
    for trial in range(60):
        results = (rng.normal(size=(members, 1)) + rng.normal(size=(1, 50))
                   + np.zeros((members, 50)))
        value, low, high = interval(Statistics(results, trial).values['mean'])
        inside += low <= 0 <= high
        estimates.append(value)
        spreads.append(Statistics(results, trial).values['mean'][1:].var())
    # The expectation of the variance is 1 / members + 1 / 50.
    assert np.mean(spreads) == pytest.approx(1 / members + 1 / 50, rel=0.35)
    assert inside >= (60 * 0.6 if members == 2 else 60 * 0.75)
