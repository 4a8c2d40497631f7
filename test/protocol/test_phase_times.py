"""Times at which the phases of a cycle begin."""

import math

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station_memory import Cycle


def test_times_count_from_the_beacon():
    cycle = Cycle(7, user=2)
    cycle.began_s[:2] = 20.0, 20.5
    state = cycle.report(m.Phase.POSITIONING, 20.5)
    assert (state.cycle_id, state.user, state.phase, state.outcome, state.elapsed_s) == (
        7, 2, m.Phase.POSITIONING, '', 0.5)
    np.testing.assert_array_equal(state.began_s, [0.0, 0.5, math.nan, math.nan])
    cycle.began_s[m.Phase.ESTIMATING] = 21.0
    end = cycle.report(m.Phase.BEACONING, 22.0, 'transmission_silent')
    assert (end.outcome, end.elapsed_s) == ('transmission_silent', 2.0)
    np.testing.assert_array_equal(end.began_s, [0.0, 0.5, 1.0, math.nan])
    # A message that was returned earlier does not change.
    assert np.isnan(state.began_s[2])


def test_a_cycle_reports_when_each_phase_began(network):
    net = network()
    net.run_cycles(1)
    states = net.sent(m.ProtocolState)
    assert [state.phase.name for state in states] == [
        'POSITIONING', 'ESTIMATING', 'TRANSMITTING', 'BEACONING']
    beacon_s = next(sent.time_s for sent in net.log if isinstance(sent.message, m.Beacon))
    sent_s = [sent.time_s - beacon_s for sent in net.log
              if isinstance(sent.message, m.ProtocolState)]
    np.testing.assert_allclose([state.elapsed_s for state in states], sent_s, atol=1e-12)
    np.testing.assert_allclose(states[-1].began_s, [0.0, *sent_s[:3]], atol=1e-12)
