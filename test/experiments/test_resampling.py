"""Bootstrap intervals of comparisons."""

import numpy as np
import pytest

from rhs_isac_ros.experiments.resampling import reduction


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
