"""The running test of the residuals' energy."""

import math

import numpy as np
import pytest
from scipy.stats import gamma

from rhs_isac_ros.positioning import make_estimator, simulate_pairs
from rhs_isac_ros.positioning.innovation_test import (
    MIN_FIXES,
    MIN_RETURN,
    WINDOW,
    InnovationTest,
)

EXPECTED = 62.5


def energies(n, scale=1.0, seed=0):
    """Residuals of a model whose covariance is too small by a factor."""
    return scale * gamma(EXPECTED).rvs(n, random_state=np.random.default_rng(seed))


def filled(values):
    test = InnovationTest()
    for value in values:
        test.add(float(value), EXPECTED)
    return test


def test_residuals_of_the_model_cause_no_warning():
    test = InnovationTest()
    for value in energies(5000):
        test.add(float(value), EXPECTED)
        assert not test.drifts
    assert test.n_fixes == WINDOW
    assert test.ratio == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize('scale', [0.93, 1.07])
def test_slightly_wrong_residuals_cause_a_warning_after_some_fixes(scale):
    values = energies(4 * WINDOW, scale)
    assert not filled(values[:MIN_FIXES]).drifts
    # A small deviation does not come and go.
    for n in range(1, 5):
        test = filled(values[:n * WINDOW])
        assert test.drifts
        assert test.ratio == pytest.approx(scale, abs=0.03)


def test_residuals_that_vary_too_much_cause_a_warning():
    """Their mean alone would not: most of the excess of a few phases is made up by others."""
    values = energies(WINDOW)
    mean = EXPECTED * 1.02
    test = filled(mean + 1.6 * (values - EXPECTED))
    assert test.drifts
    assert test.spread == pytest.approx(1.6**2, abs=0.4)
    assert not filled(mean + values - EXPECTED).drifts


@pytest.mark.parametrize('shape', [1.0, 10.0, 62.5])
def test_the_variance_of_the_model_causes_no_warning(shape):
    """Energies of few measurements have a skewed distribution."""
    rng = np.random.default_rng(4)
    for window in rng.standard_gamma(shape, (200, MIN_RETURN)):
        test = InnovationTest(MIN_RETURN)
        for value in window:
            test.add(float(value), shape)
            assert not test.drifts


def test_few_residuals_are_not_judged():
    assert not filled([1e6] * (MIN_FIXES - 1)).drifts
    assert filled([1e6] * MIN_FIXES).drifts


@pytest.mark.parametrize('window', [-1, 0, MIN_RETURN - 1])
def test_a_window_without_an_end_of_warnings_is_an_error(window):
    with pytest.raises(ValueError, match=f'^window: {window}, expected at least {MIN_RETURN}$'):
        InnovationTest(window)


def test_a_single_signal_causes_no_warning():
    assert not filled([*energies(MIN_FIXES), 1e9]).drifts
    assert not filled([*energies(MIN_FIXES), -1e9]).drifts


def test_a_warning_ends_after_some_residuals_of_the_model():
    values = energies(3 * MIN_RETURN)
    bad = energies(WINDOW, 2.0)
    assert filled([*bad, *values[:MIN_RETURN // 2]]).drifts
    test = filled([*bad, *values])
    assert not test.drifts
    # What preceded the end of the warning is forgotten.
    assert test.n_fixes < WINDOW
    assert filled([*bad, *values, *energies(MIN_RETURN, 2.0, 1)]).drifts


def test_residuals_are_forgotten_on_request():
    test = filled(energies(WINDOW, 2.0))
    test.clear()
    assert not test.drifts
    assert test.n_fixes == 0
    assert math.isnan(test.ratio)
    assert math.isnan(test.spread)


@pytest.mark.parametrize(('energy', 'expected'), [
    (math.nan, EXPECTED), (1e6, math.nan), (math.nan, math.nan)])
def test_estimates_without_a_residual_or_an_expectation_are_ignored(energy, expected):
    test = InnovationTest()
    for _ in range(WINDOW):
        test.add(energy, expected)
    assert not test.drifts
    assert test.n_fixes == 0


@pytest.mark.slow
@pytest.mark.parametrize('reject_outside', [False, True])
def test_the_expectation_accounts_for_the_choice_of_the_best_mode(
        small, random_beams, reject_outside):
    """With few measurements, there are many modes, of which the best leaves less energy."""
    codebook = random_beams(small.scenario, np.random.default_rng(0))
    estimator = make_estimator('bayes', small.scenario, codebook, reject_outside=reject_outside)
    estimate = estimator.estimate(simulate_pairs(small.scenario, codebook, 400, 1)[1])
    known = np.isfinite(estimate.expected_residual)
    residual, expected = estimate.residual[known], estimate.expected_residual[known]
    error = 4 * residual.std() / np.sqrt(len(residual))
    assert residual.mean() == pytest.approx(expected.mean(), abs=0.5 + error)
    n_measurements = codebook.digital[..., 0].size
    assert (expected <= n_measurements - 1.5).all()
