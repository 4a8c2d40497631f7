"""Settings of roles, and their description."""

import dataclasses

import pytest

from rhs_isac_ros.protocol.settings import (
    BaseStationSettings,
    Impairments,
    PendingSettings,
    PositionerSettings,
    TransmissionSettings,
    shown,
)


@pytest.mark.parametrize(
    'kind', [BaseStationSettings, Impairments, PositionerSettings, TransmissionSettings])
def test_defaults_are_valid(kind):
    for field in dataclasses.fields(kind):
        assert field.metadata['declared'].problem(field.default) == '', field.name


def test_settings_in_use_and_pending_are_described():
    pending = PendingSettings(PositionerSettings('bayes', 'a'))
    pending.latest = PositionerSettings('neural', 'a')
    assert pending.describe() == {
        'parameter.estimator': 'bayes', 'parameter.model_file': 'a',
        'parameter.reject_outside': 'true', 'parameter.calibration_file': '',
        'parameter.prior': 'region', 'parameter.track_speed_mps': '1.0',
        'pending.estimator': 'neural'}


def test_values_are_written_as_in_ros():
    assert [shown(value) for value in (True, False, 3, 0.5, '')] == [
        'true', 'false', '3', '0.5', '']


@pytest.mark.parametrize('users', ['0', '3-1', 'all'])
def test_a_malformed_list_of_users_is_an_error(users):
    with pytest.raises(ValueError, match=f"allowed_users: '{users}', expected numbers"):
        BaseStationSettings(allowed_users=users)


@pytest.mark.parametrize('estimator', ['ml', 'neural', 'mine'])
def test_tracks_need_the_estimator_bayes(estimator):
    assert PositionerSettings(prior='track').estimator == 'bayes'
    expected = f"prior: 'track', expected 'region' with the estimator {estimator}; tracks need"
    with pytest.raises(ValueError, match=expected):
        PositionerSettings(estimator, prior='track')


def test_the_latest_settings_are_pending_until_they_are_applied():
    old, new = PositionerSettings(), PositionerSettings('ml')
    pending = PendingSettings(old)
    assert pending.apply() == ''
    pending.latest = PositionerSettings('neural')
    pending.latest = new
    assert pending.in_use == old
    assert pending.describe()['pending.estimator'] == 'ml'
    assert pending.apply() == "settings applied: estimator 'ml'"
    assert pending.in_use == new
    assert 'pending.estimator' not in pending.describe()
    assert pending.apply() == ''
