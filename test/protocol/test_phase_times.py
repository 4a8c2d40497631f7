"""Times at which the phases of a cycle begin."""

import numpy as np

from rhs_isac_ros.protocol import messages as m


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
    # A message that was sent earlier does not change.
    assert np.isnan(states[0].began_s[2:]).all()


def test_a_lost_cycle_reports_the_phases_that_began(network):
    net = network()
    net.remove('transmission', noticed=False)
    net.run_cycles(1)
    *_, end = net.sent(m.ProtocolState)
    assert (end.phase, end.outcome) == (m.Phase.BEACONING, 'transmission_silent')
    assert np.isfinite(end.began_s[:3]).all()
    assert np.isnan(end.began_s[3])
    assert end.elapsed_s > 1.0
