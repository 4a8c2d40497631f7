"""The model of the live view, with messages of networks without ROS."""

import numpy as np
import pytest

from rhs_isac_ros.monitoring.cycle_log import RECEIVES
from rhs_isac_ros.monitoring.network_state import RESTING, Overview
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.protocol import messages as m


def ended(cycle_id, user, phase, outcome):
    return m.ProtocolState(
        cycle_id=cycle_id, user=user, phase=phase, outcome=outcome, began_s=np.zeros(4),
        elapsed_s=0.0)


def overview_of(net, until_s=np.inf):
    overview = Overview()
    for sent in net.log:
        if isinstance(sent.message, RECEIVES) and sent.time_s <= until_s:
            overview.add(sent.message, sent.time_s)
    return overview


def test_users_have_the_results_of_their_latest_cycle(network, codebooks):
    net = network(users=2, rest_s=0.5)
    net.run_cycles(4)
    overview = overview_of(net)
    assert {user: cycle.user for user, cycle in overview.users.items()} == {1: 1, 2: 2}
    assert {cycle.cycle_id for cycle in overview.users.values()} == {3, 4}
    for cycle in overview.users.values():
        assert cycle.error_m == np.linalg.norm(cycle.estimate.position - cycle.truth.position)
        assert cycle.sigma_m == pytest.approx(np.sqrt(np.trace(cycle.estimate.covariance_m2)))
    assert (overview.served, overview.given_up, overview.last_failure) == (4, 0, '')
    assert overview.codebook_id == codebooks[0].id
    assert (overview.phase, overview.cycle_id) == (RESTING, 4)


def test_the_numbers_of_users_and_nodes_are_bounded():
    overview = Overview(max_users=2, max_nodes=2)
    for number in (1, 2, 3):
        overview.add(m.GroundTruth(
            cycle_id=1, user=number, position=np.ones(3), velocity=np.zeros(3)), 0.0)
        overview.add_report(f'node_{number}', Report(False, '', {}), 0.0)
    assert (list(overview.users), list(overview.nodes)) == ([1, 2], ['node_1', 'node_2'])


def test_phases_follow_each_other_and_have_their_start_times(network):
    net = network(rest_s=0.5)
    net.run_cycles(2)
    seen = {}
    overview = Overview()
    for sent in net.log:
        if isinstance(sent.message, RECEIVES):
            overview.add(sent.message, sent.time_s)
            seen.setdefault((overview.cycle_id, overview.phase), overview.phase_began_s)
    names = ['beaconing', 'positioning', 'estimating', 'transmitting', RESTING]
    assert list(seen) == [(cycle, name) for cycle in (1, 2) for name in names]
    starts = {(sent.message.cycle_id, sent.message.phase.name.lower()): sent.time_s
              for sent in net.log if isinstance(sent.message, m.ProtocolState)
              and not sent.message.outcome}
    assert starts.items() <= seen.items()


def test_a_cycle_that_is_given_up_has_a_reason():
    overview = Overview()
    overview.add(m.Beacon(cycle_id=7, attempt=0), 1.0)
    overview.add(ended(7, 3, m.Phase.POSITIONING, ''), 1.1)
    overview.add(ended(7, 3, m.Phase.BEACONING, 'rhs_silent'), 2.1)
    assert (overview.served, overview.given_up) == (0, 1)
    assert overview.last_failure == 'cycle 7 of user 3: rhs_silent'
    assert overview.phase == RESTING


def test_the_rate_is_averaged_over_ten_seconds():
    overview = Overview()
    for cycle_id in range(1, 101):
        now_s = 0.5 * cycle_id
        overview.add(m.Beacon(cycle_id=cycle_id, attempt=0), now_s - 0.1)
        overview.add(ended(cycle_id, 1, m.Phase.BEACONING, 'served'), now_s)
        if cycle_id == 4:
            assert overview.rate_hz(2.4) == pytest.approx(4 / 2.0)
    assert overview.rate_hz(50.2) == pytest.approx(2.0)
    assert overview.rate_hz(58.2) == pytest.approx(0.4)
    assert overview.rate_hz(99.0) == 0


def test_the_overview_does_not_grow_with_the_cycles(network):
    net = network()
    net.run_cycles(30)
    overview = overview_of(net)
    assert overview.served == 30
    assert len(overview.users) == 1
    assert (overview._log.complete, overview._log.ended) == ([], [])
    overview.rate_hz(1e9)
    assert not overview._served_s


def test_nodes_have_counts_and_become_silent():
    overview = Overview()
    values = {'phase': 'resting', 'cycles.served': '9', 'cycles.no_fix': '2',
              'dropped.late_ack': '3', 'dropped.duplicate': '0', 'handling_ms.p50': '0.3'}
    overview.add_report('bs', Report(True, '1 dropped', values), 5.0)
    status = overview.nodes['bs']
    assert status.counts('dropped') == {'late_ack': 3}
    assert status.counts('cycles') == {'served': 9, 'no_fix': 2}
    assert not status.silent(6.1)
    assert status.silent(9.0)
