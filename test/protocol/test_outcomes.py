"""The kind of every counter."""

import pytest

from rhs_isac_ros.protocol.events import Kind, Outcome, kind_of

COUNTERS = {
    'retries': {'retry_rhs', 'retry_band', 'retry_position', 'retry_beam', 'retry_data',
                'asked_again'},
    'cycles': {'rhs_silent', 'user_gone', 'channel_silent', 'no_fix', 'positioner_silent',
               'transmission_silent', 'data_lost', 'incomplete', 'not_granted', 'abandoned',
               'bs_silent'},
    'beacons': {'unanswered', 'no_beacon', 'user_lost'},
    'dropped': {'wrong_cycle', 'wrong_user', 'wrong_instance', 'wrong_scenario', 'number_taken',
                'wrong_band', 'wrong_codebook', 'duplicate',
                'late_ack', 'not_allowed', 'too_often', 'stale_beacon', 'late_grant',
                'stale_command', 'stale', 'overflow', 'behind'},
}


@pytest.mark.parametrize('section', COUNTERS)
def test_outcomes_of_each_kind(section):
    assert {outcome.value for outcome in Outcome
            if outcome.kind is Kind(section)} == COUNTERS[section]
    assert {kind_of(counter) for counter in COUNTERS[section]} == {Kind(section)}


def test_every_kind_is_used():
    assert {kind.value for kind in Kind} == COUNTERS.keys()


@pytest.mark.parametrize('counter', [
    'malformed', 'emulated_loss', 'unexpected_estimate', 'unexpected_timeout', 'future_reason'])
def test_other_counters_count_dropped_messages(counter):
    assert kind_of(counter) is Kind.DROPPED
