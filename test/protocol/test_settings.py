"""Settings of roles, and their description."""

import dataclasses

import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol.settings import (
    BaseStationSettings,
    FusionSettings,
    Impairments,
    PendingSettings,
    PositionerSettings,
    TransmissionSettings,
)


@pytest.mark.parametrize('kind', [
    BaseStationSettings, PositionerSettings, FusionSettings, TransmissionSettings, Impairments])
def test_defaults_are_valid(kind):
    assert not [field.name for field in dataclasses.fields(kind)
                if field.metadata['declared'].problem(field.default)]


def test_a_negative_impairment_is_that_of_the_scenario():
    scenario = Scenario(phase_std_rad=0.5, user_gain_std_db=2.0)
    applied = Impairments(phase_std_rad=0.0).applied_to(scenario)
    assert (applied.phase_std_rad, applied.user_gain_std_db) == (0.0, 2.0)


def test_a_malformed_list_of_users_is_an_error():
    with pytest.raises(ValueError, match="allowed_users: '3-1', expected numbers"):
        BaseStationSettings(allowed_users='1, 3-1')


def test_tracks_need_the_estimator_bayes():
    assert PositionerSettings(prior='track').estimator == 'bayes'
    expected = "prior: 'track', expected 'region' with the estimator ml; tracks need bayes"
    with pytest.raises(ValueError, match=expected):
        PositionerSettings('ml', prior='track')


def test_the_latest_settings_are_pending_until_they_are_applied():
    old, new = PositionerSettings(), PositionerSettings('ml')
    pending = PendingSettings(old)
    assert pending.apply() == ''
    pending.latest = PositionerSettings('neural')
    pending.latest = new
    assert pending.in_use == old
    assert pending.describe() == {
        'parameter.estimator': 'bayes', 'parameter.model_file': '',
        'parameter.reject_outside': 'true', 'parameter.calibration_file': '',
        'parameter.estimator_options': '', 'parameter.prior': 'region',
        'parameter.track_speed_mps': '1.0', 'pending.estimator': 'ml'}
    assert pending.apply() == "settings applied: estimator 'ml'"
    assert pending.in_use == new
    assert 'pending.estimator' not in pending.describe()
    assert pending.apply() == ''
