"""Log messages about outages."""

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station import BaseStation, State
from rhs_isac_ros.protocol.events import LogMessage, PeersChanged, Timeout
from rhs_isac_ros.protocol.settings import BaseStationSettings

# The state in which a timeout ends the cycle for a reason.
SILENT = {'rhs_silent': State.CONFIGURING, 'user_gone': State.SOUNDING,
          'positioner_silent': State.ESTIMATING}


@pytest.fixture
def outages(scenario):
    return Outages(BaseStation(
        scenario, BaseStationSettings(retries=0), np.random.default_rng(0), None))


class Outages:
    """A base station whose cycles end as requested; all methods return the texts that it logs.

    `logged` contains the latest ones with the states that begin or end.
    """

    def __init__(self, station):
        self.station = station

    def end(self, user, state, event):
        self.station._cycle.user, self.station.state = user, state
        self.station._cycle.cycle_id = event.cycle_id if isinstance(event, m.Message) else 1
        self.logged = [action for action in self.station.handle(event, 0.0)
                       if isinstance(action, LogMessage)]
        return [LogMessage(message.text, message.warning) for message in self.logged]

    def lose(self, user, reason):
        event = m.NoFix(cycle_id=1, user=user, codebook_id='', reason='')
        return self.end(user, SILENT.get(reason, State.ESTIMATING),
                        event if reason == 'no_fix' else Timeout())

    def serve(self, user):
        """Return all messages but the one that service begins."""
        data = m.Data(cycle_id=1, user=user, direction=m.Direction.UPLINK,
                      stage=m.Stage.DELIVERED, duration_s=1e-3, bits=1.0)
        return [message for message in self.end(user, State.TRANSMITTING, data)
                if not message.text.startswith('serving: ')]


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


def test_a_reason_is_logged_once_until_a_cycle_is_served(outages):
    assert outages.lose(1, 'rhs_silent') == [
        LogMessage('cycle 1 of user 1 given up: rhs_silent', warning=True)]
    assert outages.lose(2, 'rhs_silent') == []
    assert len(outages.lose(2, 'positioner_silent')) == 1
    assert outages.serve(1) == [
        LogMessage('cycle 1: user 1 served again after: positioner_silent, rhs_silent')]
    assert outages.serve(1) == []
    assert len(outages.lose(1, 'rhs_silent')) == 1


@pytest.mark.parametrize('reason', ['user_gone', 'no_fix'])
def test_the_reasons_of_a_user_are_logged_once_until_that_user_is_served(outages, reason):
    assert len(outages.lose(1, reason)) == 1
    assert len(outages.lose(2, reason)) == 1
    assert outages.serve(3) == []
    assert outages.lose(1, reason) == []
    assert outages.serve(1) == [LogMessage(f'cycle 1: user 1 served again after: {reason}')]
    assert len(outages.lose(1, reason)) == 1
    assert outages.lose(2, reason) == []


def test_the_outages_of_many_users_do_not_fill_the_memory(outages):
    for user in range(1, 6000):
        assert outages.lose(user, 'no_fix')
    assert len(outages.station._service._outages) == 4096


@pytest.mark.parametrize(('users', 'text'), [
    ([4], 'user 4 no longer answers'), ([4, 9], 'users 4, 9 no longer answer'),
    (range(1, 12), 'users 1, 2, 3, 4, 5, 6, 7, 8 and 3 others no longer answer')])
def test_lost_users_are_logged_in_one_message(outages, users, text):
    station = outages.station
    for user in (*users, 50):
        station._users.register(user)
    logged = []
    for _ in range(3):
        station._users.invite(1)
        station._users.add_answer(50)
        logged += outages.end(0, State.BEACONING, Timeout())
    assert logged == [LogMessage(text, warning=True)]


def test_an_outage_is_a_state_of_its_user_or_of_all(outages):
    outages.lose(1, 'no_fix')
    (begin,) = outages.logged
    outages.serve(1)
    assert {(message.key, message.holds) for message in outages.logged} == {
        ('service', False), (begin.key, False)}
    assert (begin.key, begin.holds) == ('outage of user 1 0', True)
    outages.lose(1, 'rhs_silent')
    assert [(message.key, message.holds) for message in outages.logged] == [('outage', True)]


def test_missing_roles_are_logged_once_until_a_cycle_begins(outages):
    def report(*missing):
        return outages.station.handle(PeersChanged(missing), 0.0)

    def waiting(text):
        return LogMessage(text, warning=True, key='service', holds=True)

    assert report('channel') == [waiting('waiting for channel, codebook')]
    assert report('channel') == []
    assert report() == [waiting('waiting for codebook')]
    assert report() == []
