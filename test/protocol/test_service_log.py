"""Log messages about service and outages."""

import pytest

from rhs_isac_ros.protocol.events import LogMessage, Outcome
from rhs_isac_ros.protocol.service_log import ServiceLog


class Service(ServiceLog):
    """All methods return the messages of the log but those that begin with ``serving``."""

    def lose(self, user, outcome):
        return [*self.gives_up(1, user, 7, outcome)]

    def serve(self, user):
        return [message for message in self.serves(1, user, 'codebook x')
                if not message.text.startswith('serving: ')]


@pytest.fixture
def service():
    return Service()


def test_the_base_station_logs_what_it_serves_with_and_what_it_waits_for(network, codebooks):
    net = network(2)
    net.run_cycles(3)
    serving = f'serving: codebook {codebooks[0].id}, 2 users'
    assert net.logged_texts('bs') == [serving]
    net.remove('channel')
    net.run(limit_s=5.0)
    net.add('channel')
    net.run_cycles(2)
    assert net.logged_texts('bs')[1:] == ['waiting for channel', serving]
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


def test_a_reason_is_logged_once_until_a_cycle_is_served(service):
    assert service.lose(1, Outcome.RHS_SILENT) == [
        LogMessage('cycle 1 of user 1 given up: rhs_silent', True, 'outage', True)]
    assert service.lose(2, Outcome.RHS_SILENT) == []
    assert len(service.lose(2, Outcome.POSITIONER_SILENT)) == 1
    assert service.serve(1) == [LogMessage(
        'cycle 1: user 1 served again after: positioner_silent, rhs_silent', False, 'outage',
        False)]
    assert service.serve(1) == []
    assert len(service.lose(1, Outcome.RHS_SILENT)) == 1


@pytest.mark.parametrize('reason', [Outcome.USER_GONE, Outcome.NO_FIX])
def test_the_reasons_of_a_user_are_logged_once_until_that_user_is_served(service, reason):
    assert service.lose(1, reason) == [LogMessage(
        f'cycle 1 of user 1 given up: {reason.value}', True, 'outage of user 1 7', True)]
    assert len(service.lose(2, reason)) == 1
    assert service.serve(3) == []
    assert service.lose(1, reason) == []
    assert service.serve(1) == [LogMessage(
        f'cycle 1: user 1 served again after: {reason.value}', False, 'outage of user 1 7',
        False)]
    assert len(service.lose(1, reason)) == 1
    assert service.lose(2, reason) == []


def test_the_outages_of_many_users_do_not_fill_the_memory(service):
    for user in range(1, 6000):
        assert service.lose(user, Outcome.NO_FIX)
    assert len(service._outages) == 4096


def test_missing_roles_are_logged_once_until_a_cycle_begins(service):
    def waits(*lacking):
        return [(message.text, message.warning) for message in service.waits(lacking)]

    # A warning only after service: before, the other nodes may be about to start.
    assert waits('channel', 'codebook') == [('waiting for channel, codebook', False)]
    assert waits('channel', 'codebook') == []
    assert waits('codebook') == [('waiting for codebook', False)]
    service.begins()
    assert waits('codebook') == [('waiting for codebook', False)]
    list(service.serves(1, 1, 'codebook 1'))
    assert waits('codebook') == []
    service.begins()
    assert waits('codebook') == [('waiting for codebook', True)]


def test_lost_users_are_logged_in_one_message(network):
    net = network(4)
    net.run_cycles(5)
    for users in ((4,), (2, 3)):
        for user in users:
            net.remove(f'user{user}')
        net.run_cycles(6)
    assert net.logged('bs') == ['user 4 no longer answers', 'users 2, 3 no longer answer']
