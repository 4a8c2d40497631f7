"""The residuals of all users and of each user."""

import types

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning import Estimate, make_estimator
from rhs_isac_ros.positioning.diagnosis import MIN_RESIDUALS, MIN_RETURN, WINDOW
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.positioner import ResidualWatch

EXPECTED = 62.5
PLACE = np.array([10.0, 0.0, 0.0])


def estimate(factor, expected=EXPECTED):
    return Estimate(PLACE, np.eye(3), '', factor * EXPECTED, expected)


def add(watch, user, n, factor):
    """Return text and severity of the messages about n residuals of a user."""
    return [message for _ in range(n) if (message := watch.add(
        user, estimate(factor))) != ('', False)]


def test_a_deviation_is_logged_when_it_begins_and_when_it_ends():
    watch = ResidualWatch()
    assert add(watch, 1, 2 * WINDOW, 1.0) == []
    assert watch.status() == {'residual.ratio': '1.000', 'residual.spread': '0.000',
                              'residual.fixes': str(WINDOW)}
    watch.clear()
    (begin,) = add(watch, 1, WINDOW, 2.0)
    text, is_warning = begin
    assert is_warning
    assert text.startswith('the signals do not match the scenario: residuals 1.76 times')
    assert watch.status()['warning.residual'].startswith('the signals do not match')
    (end,) = add(watch, 1, MIN_RETURN, 1.0)
    assert end == ('the residuals match the scenario again', False)
    assert 'warning.residual' not in watch.status()


def test_one_user_does_not_hide_among_many():
    watch, logged = ResidualWatch(), []
    for _ in range(2 * MIN_RESIDUALS):
        for user in range(1, 65):
            logged.append(watch.add(user, estimate(1.3 if user == 7 else 1.0))[0])
    (text,) = filter(None, logged)
    assert 'scenario: user 7: residuals 1.3 times' in text
    assert float(watch.status()['residual.ratio']) < 1.01


def test_many_deviating_users_make_one_line_of_bounded_length():
    watch = ResidualWatch()
    logged = [line for user in range(1, 20) for line in add(watch, user, MIN_RESIDUALS, 3.0)]
    assert len(logged) == 1
    text = watch.status()['warning.residual']
    assert 'user 8: ' in text
    assert text.endswith('; 11 more users')


@pytest.mark.parametrize('n_places', [1, 60])
def test_the_shipped_hall_causes_no_warning(pytestconfig, shipped, n_places):
    scenario = Scenario.from_yaml(pytestconfig.rootpath / 'config' / 'hall.yaml')
    positions = scenario.sample_positions(n_places, np.random.default_rng(n_places))
    found = make_estimator('bayes', scenario, shipped).estimate(simulate_received(
        scenario, shipped, np.resize(positions, (60, 3)), np.random.default_rng(1)))
    watch, unaware = ResidualWatch(scenario.multipath.level_db), ResidualWatch()
    for one in zip(found.mean, found.covariance, found.reason, found.residual,
                   found.expected_residual, strict=True):
        assert watch.add(1, Estimate(*one)) == ('', False)
        unaware.add(1, Estimate(*one))
    assert 'warning.residual' in unaware.status()
    assert 0.7 < float(watch.status()['residual.ratio']) < 1.5


def test_users_who_may_be_outside_are_not_compared():
    watch = ResidualWatch()
    for _ in range(WINDOW):
        assert watch.add(1, estimate(9.0, expected=np.nan)) == ('', False)
    assert watch.status() == {}


@pytest.fixture
def net(network):
    """A network whose positioner finds the estimate `result`."""
    net = network(rest_s=0.0, make=lambda codebook: types.SimpleNamespace(
        name='residuals', estimate=lambda received: net.result))
    net.result = estimate(1.0)
    return net


def warnings(net):
    return net['positioner'].status().get('warning.residual', '')


def texts(net):
    return [text for text in net.logged('positioner') if 'ready for codebook' not in text]


def test_a_prediction_through_a_blockage_is_logged_once_with_its_probability(net):
    net.run_cycles(1)
    net.result = Estimate(
        PLACE, np.eye(3), blocked_probability=0.97, velocity=np.zeros(3),
        velocity_covariance=np.eye(3), n_phases=1, is_predicted=True)
    net.run_cycles(3)
    assert net['positioner'].status()['probability.blocked'] == '0.970'
    net.result = estimate(1.0)
    net.run_cycles(2)
    assert texts(net) == [
        'cycle 2: the track of user 1 predicts its position: blocked 97 %',
        'cycle 5: user 1 is in sight again']
    assert {message.blocked_probability for message in net.sent(m.PositionEstimate)} == {0, 0.97}


def test_the_diagnostics_name_the_likely_cause_of_missing_fixes(net):
    net.run_cycles(2)
    assert 'no_fix.cause' not in net['positioner'].status()
    net.result = Estimate(np.full(3, np.nan), np.full((3, 3), np.nan),
                          'blocked: probability 0.9, expected at most 0.5', 9.0, np.nan)
    net.run_cycles(3)
    values = net['positioner'].status()
    assert values['no_fix.cause'] == 'blocked'
    assert values['no_fix.share'] == '3 of 5'


def test_the_positioner_warns_until_a_new_codebook_or_new_settings_are_used(net, codebooks):
    def new_settings():
        net.change('positioner', reject_outside=False)

    net.result = estimate(3.0)
    for number, replace in enumerate((lambda: net.offer(codebooks[1]), new_settings), start=1):
        net.run_cycles(MIN_RESIDUALS)
        assert warnings(net) != ''
        assert len(texts(net)) == number
        replace()
        assert warnings(net) == ''
    assert texts(net)[0].startswith('the signals do not match the scenario')
