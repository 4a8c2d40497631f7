"""Messages of different topics may be reordered; no cycle is lost by that alone."""

import pytest
from in_memory_network import Fault, Noisy, faults

from rhs_isac_ros.protocol import messages as m


def test_no_cycle_is_lost_by_reordering_alone(network):
    for seed in range(3):
        net = network(2, transport=Noisy(seed, jitter_s=0.02))
        net.run_cycles(20)
        assert set(net.ends()) == {'served'}
        net.verify()


def test_data_wait_for_both_the_beam_and_the_surface_in_every_cycle(network):
    """They arrive in either order, and nothing is kept from cycle to cycle."""
    beam_late, surface_late = Fault(m.Beam, 'bs', 0.05), Fault(
        m.RhsConfiguration, 'bs', 0.05, mode=m.Mode.TRANSMISSION)
    net = network(transport=beam_late)
    for transport in (beam_late, beam_late, surface_late, surface_late, beam_late):
        net.transport = transport
        net.run_cycles(1)
        cycle_id = len(net.outcomes())
        sent_s = [s.time_s for s in net.log if s.message.cycle_id == cycle_id
                  and isinstance(s.message, transport.kind)][-1]
        data_s = [s.time_s for s in net.log if s.message.cycle_id == cycle_id
                  and isinstance(s.message, m.Data)][0]
        assert data_s == pytest.approx(sent_s + 0.05)
    assert net.served() == [1] * 5
    assert net.counters() == {}


def test_the_surface_may_be_ready_before_the_base_station_has_estimate_and_beam(network):
    net = network(transport=faults(
        Fault(m.PositionEstimate, 'bs', 0.06), Fault(m.Beam, 'bs', 0.05)))
    net.run_cycles(2)
    assert net.served() == [1, 1]
    net.run(limit_s=0.09)
    # The estimate arrives after the data were sent.
    assert net.counters() == {'bs': {'unexpected_estimate': 2}}


@pytest.mark.parametrize('slow', [
    ((m.ReceivedSignals, 'positioner'), (m.PositionEstimate, 'transmission')),
    ((m.Pilot, 'channel'), (m.RhsConfiguration, 'bs')),
    ((m.FeedSignals, 'bs'), (m.PositionEstimate, 'transmission')),
], ids=['positioner and transmission', 'channel and surface', 'channel and transmission'])
def test_slow_steps_within_their_timeouts_lose_no_cycle(network, slow):
    """Each step has its own timeout; two steps at 60 % of it must not lose the user."""
    net = network(transport=faults(*(Fault(*pair, 0.6) for pair in slow)))
    net.run_cycles(2)
    assert net.served() == [1, 1]


def test_a_duplicate_true_position_changes_nothing(network):
    net = network(transport=Fault(m.GroundTruth, 'channel', 1e-3, 2.5e-3))
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert net.counters() == {'channel': {'duplicate': 2}}
    net.verify()
