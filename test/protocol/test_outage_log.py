"""Log messages about outages."""

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.outage_log import OutageLog


def test_a_reason_is_logged_once_until_a_cycle_is_served():
    outages = OutageLog()
    assert outages.log_lost_cycle(3, 1, 'rhs_silent') == [
        LogMessage('cycle 3 of user 1 given up: rhs_silent', warning=True)]
    assert outages.log_lost_cycle(4, 2, 'rhs_silent') == []
    assert len(outages.log_lost_cycle(5, 2, 'positioner_silent')) == 1
    assert outages.log_served_cycle(6, 1) == [
        LogMessage('cycle 6: user 1 served again after: positioner_silent, rhs_silent')]
    assert outages.log_served_cycle(7, 1) == []
    assert len(outages.log_lost_cycle(8, 1, 'rhs_silent')) == 1


def test_user_gone_is_logged_once_per_user_until_that_user_is_served():
    outages = OutageLog()
    assert len(outages.log_lost_cycle(1, 1, 'user_gone')) == 1
    assert len(outages.log_lost_cycle(2, 2, 'user_gone')) == 1
    assert outages.log_served_cycle(3, 3) == []
    assert outages.log_lost_cycle(4, 1, 'user_gone') == []
    assert outages.log_served_cycle(5, 1) == [
        LogMessage('cycle 5: user 1 served again after: user_gone')]
    assert len(outages.log_lost_cycle(6, 1, 'user_gone')) == 1
    assert outages.log_lost_cycle(7, 2, 'user_gone') == []


def test_each_lost_user_is_logged():
    assert OutageLog().log_lost_users([4, 9]) == [
        LogMessage('user 4 no longer answers', warning=True),
        LogMessage('user 9 no longer answers', warning=True)]


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
