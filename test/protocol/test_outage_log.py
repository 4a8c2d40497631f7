"""What the base station says of cycles that it gives up."""

from rhs_isac_ros.protocol.events import LogMessage
from rhs_isac_ros.protocol.outage_log import OutageLog


def test_a_reason_is_told_once_until_a_cycle_is_served():
    complaints = OutageLog()
    assert complaints.given_up(3, 1, 'rhs_silent') == [
        LogMessage('cycle 3: user 1 given up: rhs_silent', warning=True)]
    assert complaints.given_up(4, 2, 'rhs_silent') == []
    assert len(complaints.given_up(5, 2, 'positioner_silent')) == 1
    assert complaints.served(6, 1) == [
        LogMessage('cycle 6: user 1 served again after: positioner_silent, rhs_silent')]
    assert complaints.served(7, 1) == []
    assert len(complaints.given_up(8, 1, 'rhs_silent')) == 1


def test_that_a_user_is_gone_is_told_once_of_each_and_mended_by_that_user():
    complaints = OutageLog()
    assert len(complaints.given_up(1, 1, 'user_gone')) == 1
    assert len(complaints.given_up(2, 2, 'user_gone')) == 1
    assert complaints.served(3, 3) == []
    assert complaints.given_up(4, 1, 'user_gone') == []
    assert complaints.served(5, 1) == [LogMessage('cycle 5: user 1 served again after: user_gone')]
    assert len(complaints.given_up(6, 1, 'user_gone')) == 1
    assert complaints.given_up(7, 2, 'user_gone') == []


def test_a_network_without_a_positioner_says_so_once(network):
    net = network()
    net.run_cycles(1)
    net.remove('positioner', noticed=False)
    net.run_cycles(5)
    assert net.said('bs') == ['cycle 2: user 1 given up: positioner_silent']
    net.add('positioner')
    net.run_cycles(2)
    assert net.said('bs')[1:] == ['cycle 7: user 1 served again after: positioner_silent']


def test_what_is_waited_for_is_told_once_until_a_cycle_begins():
    complaints = OutageLog()
    assert complaints.waiting(['channel', 'codebook']) == [
        LogMessage('waiting for channel, codebook', warning=True)]
    assert complaints.waiting(['channel', 'codebook']) == []
    assert complaints.waiting(['codebook']) == [LogMessage('waiting for codebook', warning=True)]
    complaints.begun()
    assert len(complaints.waiting(['codebook'])) == 1
