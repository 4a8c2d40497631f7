"""Log messages about outages."""

import pytest

from rhs_isac_ros.protocol.base_station_memory import OutageLog
from rhs_isac_ros.protocol.events import LogMessage


def served(outages, cycle_id, user):
    """Return the messages of a served cycle other than the one that service begins."""
    return [message for message in outages.log_served_cycle(cycle_id, user, 'cb1', 2)
            if not message.text.startswith('serving: ')]


def test_the_beginning_of_service_is_logged_and_again_after_a_wait():
    outages = OutageLog()
    begins = [LogMessage('serving: codebook cb1, 2 users')]
    assert outages.log_served_cycle(1, 1, 'cb1', 2) == begins
    assert outages.log_served_cycle(2, 2, 'cb1', 2) == []
    outages.log_waiting(['channel'])
    assert outages.log_served_cycle(3, 1, 'cb2', 1) == [
        LogMessage('serving: codebook cb2, 1 user')]


def test_the_base_station_logs_that_it_serves(network, codebooks):
    net = network(2)
    net.run_cycles(3)
    serving = f'serving: codebook {codebooks[0].id}, 2 users'
    assert net.logged_texts('bs') == [serving]
    net.remove('channel')
    net.run(limit_s=5.0)
    net.add('channel')
    net.run_cycles(2)
    assert net.logged_texts('bs')[-1].startswith(f'serving: codebook {codebooks[0].id}, ')
    for role in ('rhs_controller', 'transmission'):
        assert net.logged_texts(role) == [f'serving: codebook {codebooks[0].id}']


def test_a_user_that_is_no_longer_allowed_is_logged_as_removed(network):
    net = network(2)
    net.run_cycles(2)
    net.change('bs', allowed_users='1')
    net.run_cycles(6)
    assert net.logged('bs') == [
        "settings applied: allowed_users '1'", "user 2 removed: not in allowed_users '1'"]
    assert net.served()[-5:] == [1] * 5


def test_a_reason_is_logged_once_until_a_cycle_is_served():
    outages = OutageLog()
    assert outages.log_lost_cycle(3, 1, 'rhs_silent') == [
        LogMessage('cycle 3 of user 1 given up: rhs_silent', warning=True)]
    assert outages.log_lost_cycle(4, 2, 'rhs_silent') == []
    assert len(outages.log_lost_cycle(5, 2, 'positioner_silent')) == 1
    assert served(outages, 6, 1) == [
        LogMessage('cycle 6: user 1 served again after: positioner_silent, rhs_silent')]
    assert served(outages, 7, 1) == []
    assert len(outages.log_lost_cycle(8, 1, 'rhs_silent')) == 1


@pytest.mark.parametrize('reason', ['user_gone', 'no_fix'])
def test_the_reasons_of_a_user_are_logged_once_until_that_user_is_served(reason):
    outages = OutageLog()
    assert len(outages.log_lost_cycle(1, 1, reason)) == 1
    assert len(outages.log_lost_cycle(2, 2, reason)) == 1
    assert served(outages, 3, 3) == []
    assert outages.log_lost_cycle(4, 1, reason) == []
    assert served(outages, 5, 1) == [
        LogMessage(f'cycle 5: user 1 served again after: {reason}')]
    assert len(outages.log_lost_cycle(6, 1, reason)) == 1
    assert outages.log_lost_cycle(7, 2, reason) == []


def test_the_outages_of_many_users_do_not_fill_the_memory():
    outages = OutageLog()
    for user in range(1, 6000):
        assert outages.log_lost_cycle(user, user, 'no_fix')
    assert len(outages._open) == 4096


@pytest.mark.parametrize(('users', 'text'), [
    ([4], 'user 4 no longer answers'), ([4, 9], 'users 4, 9 no longer answer'),
    (range(1, 12), 'users 1, 2, 3, 4, 5, 6, 7, 8 and 3 others no longer answer')])
def test_lost_users_are_logged_in_one_message(users, text):
    assert OutageLog().log_lost_users(users) == [LogMessage(text, warning=True)]


def test_no_message_is_logged_without_a_lost_user():
    assert OutageLog().log_lost_users([]) == []


def test_missing_roles_are_logged_once_until_a_cycle_begins():
    outages = OutageLog()
    assert outages.log_waiting(['channel', 'codebook']) == [
        LogMessage('waiting for channel, codebook', warning=True)]
    assert outages.log_waiting(['channel', 'codebook']) == []
    assert outages.log_waiting(['codebook']) == [
        LogMessage('waiting for codebook', warning=True)]
    outages.clear_waiting()
    assert len(outages.log_waiting(['codebook'])) == 1


def test_a_network_without_a_positioner_logs_the_outage_once(network):
    net = network()
    net.run_cycles(1)
    net.remove('positioner', noticed=False)
    net.run_cycles(5)
    assert net.logged('bs') == ['cycle 2 of user 1 given up: positioner_silent']
    net.add('positioner')
    net.run_cycles(2)
    assert net.logged('bs')[1:] == ['cycle 7: user 1 served again after: positioner_silent']
