"""Whether signals fit the model: those of one phase, and of the latest cycles."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from scipy.stats import chi2, gamma

from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.model.gaussian import FALSE_ALARM
from rhs_isac_ros.positioning import Estimate, diagnosis, make_estimator
from rhs_isac_ros.positioning.alternatives import (
    LIMIT,
    Blocked,
    Outside,
    describe_doubts,
    rejection,
)
from rhs_isac_ros.system import System


@pytest.fixture(scope='module', params=['bayes', 'ml'])
def setting(request, random_beams):
    """A scenario with strong signals, a codebook and an estimator."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook = random_beams(scenario, np.random.default_rng(1))
    return scenario, codebook, make_estimator(request.param, scenario, codebook)


def assert_no_fix(estimate, message):
    assert not estimate.fix.any()
    assert np.isnan(estimate.mean).all()
    assert np.isnan(estimate.covariance).all()
    reasons = [estimate.reason] if isinstance(estimate.reason, str) else estimate.reason
    assert len(reasons) == np.size(estimate.fix)
    for reason in reasons:
        assert message in reason
        assert 'expected at ' in reason


def test_limits_are_quantiles_of_the_chi_square_distribution():
    test = diagnosis.FitTest(64)
    assert 2 * test.min_energy == pytest.approx(chi2.ppf(FALSE_ALARM, 128))
    assert 2 * test.max_residual == pytest.approx(chi2.isf(FALSE_ALARM, 128))
    for check, limit, sign in ((test.min_energy_test, test.min_energy, -1),
                               (test.residual_test, test.max_residual, 1)):
        assert check(limit * (1 - 1e-6 * sign)) == ''
        assert check(limit * (1 + 1e-6 * sign)) != ''


def test_weak_signals_are_a_direct_path_or_nothing():
    """Multipath may be weaker than in the model, as in an empty hall."""
    test = diagnosis.FitTest(64)
    assert test.weak_test(1.0, 0.1) == ''
    assert test.weak_test(test.min_energy, 1e3) == ''
    assert 'expected at most 0.723 of signals weaker' in test.weak_test(1.0, 0.8)
    # A survey inflates the covariance, relative to which the usual multipath is weak.
    assert diagnosis.FitTest(64, 0.1).weak_test(test.min_energy / 9, 1e3) == ''


def test_the_largest_energy_is_that_of_the_strongest_position_with_noise():
    test = diagnosis.FitTest(64)
    limit = (np.sqrt(500.0) + np.sqrt(test.max_residual))**2
    assert test.max_energy_test(limit * 0.999, 500.0) == ''
    assert f'expected at most {limit:.3g}' in test.max_energy_test(limit * 1.001, 500.0)


@pytest.mark.parametrize('factor', [0.0, 1e-30, 1e-3], ids=str)
def test_signals_weaker_than_noise_give_no_fix(setting, factor):
    scenario, codebook, estimator = setting
    received = factor * System(scenario, codebook).pairs(1, 0)[1][0]
    assert_no_fix(estimator.estimate(received), 'energy')


def test_a_user_with_a_low_gain_is_not_weaker_than_the_multipath(setting):
    scenario, codebook, estimator = setting
    declared = dataclasses.replace(scenario, user_gain_std_db=6.0)
    received = System(scenario, codebook).pairs(4, 0)[1] / 4
    estimate = make_estimator(estimator.name, declared, codebook).estimate(received)
    assert estimate.reason == ('',) * 4 and estimate.fix.all()


@pytest.mark.parametrize('position', [(4.0, 0.0, 1.5), (4.0, -3.0, 0.0), (2.0, 0.0, 0.0)], ids=str)
def test_a_user_far_outside_the_region_gives_no_fix(setting, position):
    scenario, codebook, estimator = setting
    received = simulate_received(
        scenario, codebook, np.tile(position, (4, 1)), np.random.default_rng(0))
    assert_no_fix(estimator.estimate(received), 'residual')


@pytest.mark.parametrize('change', [
    lambda received: 3 * received,
    lambda received: received.conj(),
    lambda received: received[:, ::-1],
    lambda received: received * np.exp(2j * np.pi * np.arange(received.shape[2]) / 7),
], ids=['amplified', 'conjugate', 'bands swapped', 'rotating phase'])
def test_distorted_signals_give_no_fix(setting, change):
    scenario, codebook, estimator = setting
    received = System(scenario, codebook).pairs(20, 0)[1]
    assert_no_fix(estimator.estimate(change(received)), 'residual')


def test_a_user_who_is_more_probably_outside_is_rejected():
    assert rejection(Outside, LIMIT, 1 - LIMIT) == ''
    assert rejection(Outside, 0.505, 0.495) == (
        'position outside of the region: probability 0.505, expected at most 0.5')
    # The position is as probable as each alternative, but less probable than both.
    assert rejection(Outside, 0.48, 0.49) == (
        'position outside of the region: probability 0.48, and 0.49 of a user in the region and '
        'in sight, expected at least 0.5')
    assert rejection(Blocked, 0.03, 0.49) == (
        'blocked: probability 0.0576923, expected at most 0.05')


def test_valid_signals_are_located_beside_invalid_ones(setting):
    scenario, codebook, estimator = setting
    positions, received = System(scenario, codebook).pairs(6, 0)
    expected = estimator.estimate(received)
    received[[1, 4]] = 0
    estimate = estimator.estimate(received)
    assert estimate.fix.tolist() == [True, False, True, True, False, True]
    # Sums over a batch depend on its size in the last digits.
    np.testing.assert_allclose(
        estimate.mean[estimate.fix], expected.mean[estimate.fix], rtol=0, atol=1e-9)
    assert [bool(reason) for reason in estimate.reason] == (~estimate.fix).tolist()
    assert np.linalg.norm(estimate.mean - positions, axis=1)[estimate.fix].max() < 0.1


EXPECTED = 62.5


def energies(n, scale=1.0, seed=0):
    """Residuals of a model whose covariance is too small by a factor."""
    return scale * gamma(EXPECTED).rvs(n, random_state=np.random.default_rng(seed))


def filled(values, *arguments, expected=EXPECTED, may_warn=True):
    """Return a test after residuals."""
    test = diagnosis.InnovationTest(*arguments)
    for value in values:
        test.add(float(value), expected)
        assert may_warn or not test.drifts
    return test


#: Returns a test after residuals, none of which causes a warning.
without_warning = functools.partial(filled, may_warn=False)


@pytest.mark.slow
def test_residuals_of_the_model_cause_no_warning():
    test = without_warning(energies(2500))
    assert test.n_residuals == diagnosis.WINDOW
    assert test.ratio == pytest.approx(1, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize('scale', [0.93, 1.07])
def test_slightly_wrong_residuals_cause_a_warning_after_some_fixes(scale):
    values = energies(4 * diagnosis.WINDOW, scale)
    assert not filled(values[:diagnosis.MIN_RESIDUALS]).drifts
    # A small deviation does not come and go.
    for n in range(1, 5):
        test = filled(values[:n * diagnosis.WINDOW])
        assert test.drifts
        assert test.ratio == pytest.approx(scale, abs=0.03)


def test_residuals_that_vary_too_much_cause_a_warning():
    """Their mean alone would not: most of the excess of a few phases is made up by others."""
    values = energies(diagnosis.WINDOW)
    mean = EXPECTED * 1.02
    test = filled(mean + 1.6 * (values - EXPECTED))
    assert test.drifts
    assert test.spread == pytest.approx(1.6**2, abs=0.4)
    assert not filled(mean + values - EXPECTED).drifts


@pytest.mark.slow
@pytest.mark.parametrize('shape', [1.0, 62.5])
def test_the_variance_of_the_model_causes_no_warning(shape):
    """Energies of few measurements have a skewed distribution."""
    rng = np.random.default_rng(4)
    for window in rng.standard_gamma(shape, (100, diagnosis.MIN_RETURN)):
        without_warning(window, diagnosis.MIN_RETURN, expected=shape)


@pytest.mark.parametrize('level_db', [-4.5, -3.0, -1.0])
def test_a_user_at_rest_may_have_any_usual_level(level_db):
    """The level of a measured covariance differs among users, here by 1 dB, and stays the same."""
    values = energies(diagnosis.WINDOW, 10**(level_db / 10))
    test = without_warning(values, diagnosis.WINDOW, (-3.0, 1.0))
    assert test.ratio == pytest.approx(10**((level_db + 3) / 10), rel=0.03)
    assert filled(values, diagnosis.WINDOW, (-3.0, 0.0)).drifts == (level_db != -3.0)


def test_levels_of_many_users_are_no_excess_of_the_variance():
    levels = 10**(np.random.default_rng(1).normal(0, 0.1, diagnosis.WINDOW))
    test = filled(levels * energies(diagnosis.WINDOW), diagnosis.WINDOW, (0.0, 1.0))
    assert not test.drifts
    assert test.spread == pytest.approx(1, abs=0.2)


def test_a_level_far_from_the_survey_causes_a_warning():
    residuals = energies(diagnosis.MIN_RESIDUALS, 10**-1.3)
    assert filled(residuals, diagnosis.WINDOW, (-3.0, 1.0)).drifts


def test_few_residuals_are_not_judged():
    assert not filled([1e6] * (diagnosis.MIN_RESIDUALS - 1)).drifts
    assert filled([1e6] * diagnosis.MIN_RESIDUALS).drifts


@pytest.mark.parametrize('window', [-1, 0, diagnosis.MIN_RETURN - 1])
def test_a_window_without_an_end_of_warnings_is_an_error(window):
    expected = f'^window: {window}, expected at least {diagnosis.MIN_RETURN}$'
    with pytest.raises(ValueError, match=expected):
        diagnosis.InnovationTest(window)


def test_a_warning_ends_after_some_residuals_of_the_model():
    values = energies(3 * diagnosis.MIN_RETURN)
    bad = energies(diagnosis.WINDOW, 2.0)
    assert filled([*bad, *values[:diagnosis.MIN_RETURN // 2]]).drifts
    test = filled([*bad, *values])
    assert not test.drifts
    # What preceded the end of the warning is forgotten.
    assert test.n_residuals < diagnosis.WINDOW
    assert filled([*bad, *values, *energies(diagnosis.MIN_RETURN, 2.0, 1)]).drifts


def test_residuals_are_forgotten_on_request():
    test = filled(energies(diagnosis.WINDOW, 2.0))
    test.clear()
    assert not test.drifts
    assert test.n_residuals == 0
    assert math.isnan(test.ratio)
    assert math.isnan(test.spread)


@pytest.mark.parametrize(('energy', 'expected'), [
    (math.nan, EXPECTED), (1e6, math.nan), (1e6, math.inf), (math.nan, math.nan)])
def test_estimates_without_a_residual_or_an_expectation_are_ignored(energy, expected):
    test = filled([energy] * diagnosis.WINDOW, expected=expected)
    assert not test.drifts
    assert test.n_residuals == 0


@pytest.mark.slow
@pytest.mark.parametrize('reject_outside', [False, True])
def test_the_expectation_accounts_for_the_choice_of_the_best_mode(
        small, random_beams, reject_outside):
    """With few measurements, there are many modes, of which the best leaves less energy."""
    codebook = random_beams(small.scenario, np.random.default_rng(0))
    estimator = make_estimator('bayes', small.scenario, codebook, reject_outside=reject_outside)
    estimate = estimator.estimate(System(small.scenario, codebook).pairs(200, 1)[1])
    known = np.isfinite(estimate.expected_residual)
    residual, expected = estimate.residual[known], estimate.expected_residual[known]
    error = 4 * residual.std() / np.sqrt(len(residual))
    assert residual.mean() == pytest.approx(expected.mean(), abs=0.5 + error)
    n_measurements = codebook.digital[..., 0].size
    # A position fits three numbers of signals above the noise, and fewer below it.
    assert (expected < n_measurements).all()
    assert expected.mean() <= n_measurements - 1.5


N_USERS = 100


def one(found, row):
    """Return one of several estimates."""
    return found[row]


def diagnosis_of(found, deviates):
    return diagnosis.diagnose([one(found, row) for row in range(len(found.mean))], deviates)


def located(world, codebook, estimator):
    rng = np.random.default_rng(5)
    positions = rng.uniform(*Scenario().roi_bounds_m, (N_USERS, 3))
    return estimator.estimate(simulate_received(world, codebook, positions, rng))


@pytest.mark.slow
@pytest.mark.parametrize(('change', 'cause'), [
    ({'multipath_to_los_db': Scenario().multipath_to_los_db + 6}, diagnosis.LEVEL),
    ({'delay_spread_s': 2 * Scenario().delay_spread_s}, diagnosis.SPREAD),
    ({'angular_spread_deg': 3 * Scenario().angular_spread_deg}, diagnosis.SPREAD)],
    ids=['level', 'delays', 'angles'])
def test_wrong_levels_and_spreads_of_the_multipath_are_told_apart(
        change, cause, shipped, table1_estimator):
    found = located(dataclasses.replace(Scenario(), **change), shipped, table1_estimator)
    assert not found.fix.any()
    values = diagnosis_of(found, True)
    assert values['no_fix.cause'] == cause
    assert values['no_fix.share'] == f'{N_USERS} of {N_USERS}'


def test_blocked_users_are_the_cause_unless_the_residuals_deviate(shipped):
    declared = dataclasses.replace(Scenario(), blocked_probability=0.3)
    found = located(declared, shipped, make_estimator('bayes', declared, shipped))
    values = diagnosis_of(found, False)
    assert values['no_fix.cause'] == Blocked.reason
    assert float(values['probability.blocked']) == pytest.approx(0.3, abs=0.12)
    assert 'probability.outside' not in values
    assert diagnosis_of(found, True)['no_fix.cause'] in (diagnosis.LEVEL, diagnosis.SPREAD)


@pytest.mark.slow
def test_signals_of_the_model_have_no_cause(shipped, table1_estimator):
    assert diagnosis_of(located(Scenario(), shipped, table1_estimator), False) == {}


def test_few_residuals_leave_the_reason_as_the_cause():
    nothing = np.full(3, np.nan), np.full((3, 3), np.nan)
    estimate = Estimate(*nothing, 'residual energy: 9, expected at most 5', 9.0, 3.0)
    values = diagnosis.diagnose([estimate] * (diagnosis.MIN_RESIDUALS - 1), True)
    assert values['no_fix.cause'] == 'residual energy'
    assert diagnosis.diagnose([Estimate(np.zeros(3), np.eye(3))], True) == {}


def test_doubts_are_described_from_one_percent_on():
    place = np.zeros(3), np.eye(3)
    estimate = Estimate(*place, outside_probability=0.004, blocked_probability=0.12)
    assert describe_doubts(estimate) == 'blocked 12 %'
    assert describe_doubts(Estimate(*place)) == ''


@pytest.mark.parametrize('relative', [0.2, 1.0, 5.0])
def test_a_misfit_is_compared_with_positions_at_the_surveyed_level(relative):
    n, residual = 20, relative * 20
    exact, surveyed, shifted = (
        diagnosis.misfit_log_ratio(energy, n, level_db) for energy, level_db in (
            (residual, (0.0, 0.0)), (residual, (0.0, 4.0)), (residual / 100, (-20.0, 4.0))))
    # Where levels vary, positions explain residuals far from the nominal level, too.
    assert (surveyed < exact) == (relative != 1.0)
    assert shifted == pytest.approx(surveyed, abs=1e-9)
