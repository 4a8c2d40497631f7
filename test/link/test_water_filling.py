"""Water-filling, compared with bisection and checked for optimality."""

import numpy as np
import pytest

from rhs_isac_ros.link.band_link import water_filling

RNG = np.random.default_rng(0)
CASES = {
    'equal': (np.ones(5), 2.0),
    'one channel': (np.array([3.0]), 0.5),
    'all filled': (np.array([2.0, 3.0, 4.0]), 10.0),
    'only the best': (np.array([1.0, 10.0, 2.0]), 0.1),
    'two equal best': (np.array([5.0, 1.0, 5.0]), 0.1),
    'just below the second': (np.array([2.0, 1.0]), 0.5 - 1e-9),
    'just above the second': (np.array([2.0, 1.0]), 0.5 + 1e-9),
    'one without gain': (np.array([0.0, 2.0, 3.0]), 1.0),
    'realistic link': (np.array([1e9, 1.1e9, 0.9e9, 3e8]), 1e-3),
    **{f'random {n}': (10**RNG.uniform(-4, 4, n), 10**RNG.uniform(-3, 3))
       for n in (2, 3, 8, 64, 500)},
}


@pytest.fixture(params=CASES)
def channels(request):
    return CASES[request.param]


def rate(gains, shares):
    return np.log1p(gains * shares).sum()


def test_shares_match_bisection(channels, bisection):
    gains, power = channels
    np.testing.assert_allclose(
        water_filling(gains, power), bisection(gains, power), rtol=1e-9, atol=1e-9 * power)


def test_shares_are_not_negative_and_sum_to_the_power(channels):
    gains, power = channels
    shares = water_filling(gains, power)
    assert shares.shape == gains.shape
    assert (shares >= 0).all()
    assert shares.sum() == pytest.approx(power, rel=1e-9)


def test_the_karush_kuhn_tucker_conditions_hold(channels):
    """The slope of the rate is equal in all channels with power, and not higher in others."""
    gains, power = channels
    shares = water_filling(gains, power)
    slopes = gains / (1 + gains * shares)
    used = shares > 0
    np.testing.assert_allclose(slopes[used], slopes[used].max(), rtol=1e-6)
    assert (slopes[~used] <= slopes[used].max() * (1 + 1e-9)).all()


def test_channels_without_gain_get_no_power():
    shares = water_filling(np.array([0.0, 2.0, -1e-20, 3.0]), 1.0)
    assert shares[0] == shares[2] == 0
    assert shares.sum() == pytest.approx(1.0)


@pytest.mark.parametrize('gains', [[0.0], [0.0] * 8, [-1e-20, 0.0]])
def test_without_any_gain_the_shares_are_equal(gains):
    np.testing.assert_allclose(water_filling(np.array(gains), 3.0), 3.0 / len(gains))


@pytest.mark.parametrize('gains', [[1e-15], [1e-15, 3e-15], [1e-200, 0.0, 1e-15]])
def test_gains_near_rounding_errors_still_get_the_power(gains):
    """A configuration that passes no signal has such gains."""
    shares = water_filling(np.array(gains), 1e-3)
    assert shares.sum() == 1e-3
    assert shares[np.argmax(gains)] == 1e-3
