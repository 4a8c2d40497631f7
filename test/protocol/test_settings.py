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
    ReceiverSettings,
    TransmissionSettings,
    shown,
)

# Defaults and ranges of all numbers: files of parameters may depend on them.
NUMBERS = {
    BaseStationSettings: {
        'ack_timeout_s': (0.1, 0.001, 60.0), 'step_timeout_s': (1.0, 0.01, 60.0),
        'retries': (3, 0, 100), 'rest_s': (0.1, 0.0, 3600.0),
        'data_duration_s': (0.001, 1e-6, 10.0), 'handover_ratio': (1.02, 1.0, 1e3),
        'max_users': (4096, 1, 4096),
        'ack_rate_hz': (200.0, 1.0, 1e6)},
    PositionerSettings: {'track_speed_mps': (1.0, 0.01, 1000.0)},
    TransmissionSettings: {'band': (-1, -1, 4095)},
    Impairments: {
        'loss_probability': (0.0, 0.0, 1.0), 'double_probability': (0.0, 0.0, 1.0),
        'delay_s': (0.0, 0.0, 10.0), 'jitter_s': (0.0, 0.0, 10.0),
        **{name: (-1.0, -1.0, Scenario.__dataclass_fields__[name].metadata['declared'].high)
           for name in (
               'user_gain_std_db', 'phase_std_rad', 'band_phase_std_rad', 'timing_std_s',
               'carrier_offset_std_hz', 'element_error_rms', 'blocked_probability',
               'failed_element_share')},
        'surface_shift_m': (0.0, -10.0, 10.0), 'surface_turn_deg': (0.0, -90.0, 90.0)},
    FusionSettings: {'wait_s': (0.2, 0.0, 60.0), 'track_speed_mps': (1.0, 0.01, 1e3)},
    ReceiverSettings: {},
}


@pytest.mark.parametrize('kind', NUMBERS)
def test_settings_have_their_defaults_and_ranges(kind):
    declared = {field.name: (field.default, field.metadata['declared'])
                for field in dataclasses.fields(kind)}
    assert not [name for name, (default, field) in declared.items() if field.problem(default)]
    assert {name: (default, field.low, field.high) for name, (default, field) in declared.items()
            if field.kind in (int, float)} == NUMBERS[kind]
    assert {name: default for name, (default, field) in declared.items()
            if field.kind is bool}.items() <= {
        'receiver_noise': True, 'reject_outside': True, 'multipath_memory': True}.items()


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
