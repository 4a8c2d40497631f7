"""Users who move otherwise than their scenario declares."""

import numpy as np
import pytest
from walking_users import WALKING, inside, system_of, users_of

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.positioning.estimate import Fit
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.movement import MovementTest

AT_REST = {'user_speed_std_mps': 0.0}
DECLARED = {
    'walking': {}, 'at rest': AT_REST,
    'at rest among still scatterers': AT_REST | {'max_user_speed_mps': 0.01},
    'at rest, impaired': AT_REST | {
        'timing_std_s': 1e-7, 'user_gain_std_db': 2.0, 'element_error_rms': 0.05}}


@pytest.fixture(scope='module')
def walking():
    system = system_of()
    return system, BayesEstimator(system)


@pytest.fixture(scope='module', params=[
    pytest.param(changes, id=name, marks=[] if name == 'walking' else pytest.mark.slow)
    for name, changes in DECLARED.items()])
def declared(request):
    if not request.param:
        return request.getfixturevalue('walking')
    system = system_of(**request.param)
    return system, BayesEstimator(system)


def located(system, estimator, speed_mps, n=16):
    """Whether users with speeds have fixes, errors and covariances of these, and reasons."""
    states = users_of(system.scenario, n, speed_mps, np.random.default_rng(5))
    estimate = estimator.estimate(system.sample(states, np.random.default_rng(6)))
    errors = (estimate.mean - states[:, :3])[estimate.fix, :2]
    return estimate.fix, errors, estimate.covariance[estimate.fix, :2, :2], estimate.reason


def test_users_as_declared_have_a_fix(declared):
    fix, errors, covariances, _ = located(*declared, declared[0].scenario.user_speed_std_mps)
    assert fix.mean() >= 0.9
    assert inside(errors, covariances, 2) >= 0.85


@pytest.mark.slow
def test_faster_users_have_no_fix_at_a_wrong_place(declared):
    system, estimator = declared
    times = np.repeat([[5], [30]], 8, axis=0)
    speed_mps = times * max(system.scenario.user_speed_std_mps, 0.03)
    fix, errors, covariances, reasons = located(system, estimator, speed_mps)
    wrong = np.count_nonzero(fix) * (1 - inside(errors, covariances, 2)) if fix.any() else 0
    assert wrong < 2.5
    assert all('user_speed_std_mps' in one or one.startswith('residual') for one in reasons if one)


def test_users_whose_direct_path_turns_by_one_more_turn_in_a_frame_have_no_fix(walking):
    system, estimator = walking
    scenario, rng = system.scenario, np.random.default_rng(12)
    states = users_of(scenario, 20, 0.5, rng)
    away = states[:, :3] / np.linalg.norm(states[:, :3], axis=1, keepdims=True)
    turn_mps = SPEED_OF_LIGHT_MPS / np.mean(scenario.center_frequencies_hz) / (
        scenario.frame_duration_s)
    states[1::2, 3:] += turn_mps * away[1::2]
    estimate = estimator.estimate(system.sample(states, rng)[[13, 15, 17]])
    assert all('moves otherwise' in reason for reason in estimate.reason)


def test_independent_frames_contain_what_failed_elements_do():
    """Their evidence is that of an intact surface, and the fit's that of the sets found."""
    systems = [system_of(failed_element_share=share) for share in (0.0, 0.01)]
    likelihoods = [Likelihood(one) for one in systems]
    received = system_of().sample(
        users_of(WALKING, 1, 1.0, np.random.default_rng(1)), np.random.default_rng(2))
    of_set, average = -50.0, -70.0
    fits = [Fit(np.zeros(6), np.eye(6), of_set, evidence, 40.0, 40.0, 0.0, None)
            for evidence in (of_set, average)]
    ratios = [MovementTest(system, one)._unsteady(
        fit, one.signals(received), np.zeros(len(one.nuisance)), 1.0) - one.log_det
        for system, one, fit in zip(systems, likelihoods, fits, strict=True)]
    assert ratios[0] == pytest.approx(ratios[1], abs=1e-6)


def test_a_residual_of_few_expected_measurements_varies_more():
    """Although there are many measurements, the fit may explain most of them by several modes."""
    system = system_of()
    test = MovementTest(system, Likelihood(system))
    fits = [Fit(np.zeros(6), np.eye(6), 0.0, 0.0, 3 * expected, expected, 0.0, None)
            for expected in (4.0, 40.0)]
    assert [bool(test._too_fast(one)) for one in fits] == [False, True]


def test_short_frames_need_no_test():
    short = system_of(frame_duration_s=4e-6, user_speed_std_mps=0.0)
    assert MovementTest.of(short, Likelihood(short)) is None


@pytest.mark.parametrize('changes', [{}, AT_REST])
def test_single_frames_need_no_test_unless_the_phases_of_the_bands_are_known(changes):
    """Otherwise, up to a fifth of the users as declared would have no fix."""
    single = system_of(n_frames=1, **changes)
    assert MovementTest.of(single, Likelihood(single)) is None
    known = system_of(n_frames=1, band_phase_std_rad=0.0, **AT_REST)
    assert MovementTest.of(known, Likelihood(known))
