"""Bootstrap intervals of comparisons."""

import numpy as np
import pytest

from rhs_isac_ros.experiments.resampling import replicate, share_percent


def test_statistics_without_resampling_are_those_of_the_results():
    results = np.random.default_rng(0).exponential(size=(3, 41))
    (average,) = replicate(results, 0)
    quarter, middle = replicate(results, 0, (0.25, 0.5))
    assert average.values[0] == average.by_member[0] == pytest.approx(results.mean(), rel=1e-6)
    assert middle.values[0] == np.median(results)
    assert quarter.values[0] == np.quantile(results, 0.25, method='inverted_cdf')
    assert middle.minus(quarter).values[0] == middle.values[0] - quarter.values[0]


@pytest.mark.parametrize(('results', 'quantiles', 'error'), [
    *((results, (), r'results: shape .*, expected \[members, cases\]') for results in (
        np.ones(3), np.ones((0, 3)), np.ones((2, 0)), np.full((2, 3), np.nan))),
    (np.ones((2, 3)), (0.5, 1.5), r'quantiles: \(0.5, 1.5\), expected 0 to 1')])
def test_results_without_a_value_and_other_quantiles_are_errors(results, quantiles, error):
    with pytest.raises(ValueError, match=f'^{error}'):
        replicate(results, 0, quantiles)


def test_cases_that_a_member_did_not_serve_do_not_count():
    results = np.tile([[1.0, np.nan, 3.0, np.nan], [np.nan, 5.0, np.nan, 6.0]], 10)
    assert replicate(results, 0)[0].values[0] == pytest.approx(15 / 4)
    assert replicate(results, 0, (0.5,))[0].values[0] == 3


def test_comparisons_of_the_same_cases_are_paired():
    results = np.random.default_rng(0).exponential(size=(1, 200))
    own, baseline = (replicate(factor * results, seed)[0]
                     for seed, factor in enumerate((0.6, 1.0)))
    assert own.reduction_from(baseline) == pytest.approx((40, 40, 40), abs=1e-3)


def test_the_interval_of_many_cases_is_that_of_their_standard_error():
    results = np.random.default_rng(0).normal(10, 1, size=(1, 4000))
    value, low, high = replicate(results, 0)[0].interval()
    assert (value, high - low) == pytest.approx((results.mean(), 2 * 1.96 / 4000**0.5), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize('members', [2, 5])
def test_intervals_of_few_members_have_their_nominal_coverage(members):
    rng, inside, variances = np.random.default_rng(0), 0, []
    for trial in range(100):
        (found,) = replicate(
            10 + rng.normal(size=(members, 1)) + rng.normal(size=(1, 50)), trial)
        _, low, high = found.interval()
        inside += low <= 10 <= high
        variances.append(found.values[1:].var())
    assert inside >= 85
    assert np.mean(variances) == pytest.approx(1 / members + 1 / 50, rel=0.35)


def test_intervals_of_positive_statistics_are_positive():
    results = np.array([[1.0], [9.0]]) * np.ones((2, 50))
    (found,) = replicate(results, 0)
    value, low, high = found.interval()
    assert 0 < low < value < high
    assert value == pytest.approx(5)
    less, low, high = found.reduction_from(replicate(2 * results, 1)[0])
    assert less == pytest.approx(50)
    assert low < less < high < 100


def test_the_interval_of_a_share_is_that_of_wilson():
    """Both ends solve |p - share| = z sqrt(p (1 - p) / n)."""
    value, *ends = share_percent(3, 40)
    assert value == 7.5
    for end in ends:
        p = end / 100
        assert abs(p - 0.075) == pytest.approx(1.959964 * np.sqrt(p * (1 - p) / 40), rel=1e-5)
    assert share_percent(0, 10)[:2] == (0.0, pytest.approx(0.0, abs=1e-12))


def test_the_share_of_nothing_is_an_error():
    with pytest.raises(ValueError, match='^total: 0, expected at least 1$'):
        share_percent(0, 0)
