"""Messages of different topics may be reordered; no cycle is lost by that alone."""

import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user import State

pytestmark = pytest.mark.usefixtures('plain_beams')


class Delays:
    """Delays messages of a class to one recipient."""

    def __init__(self, kind, recipient, delay_s, **fields):
        self.kind, self.recipient, self.delay_s, self.fields = kind, recipient, delay_s, fields

    def __call__(self, message, recipient):
        late = recipient == self.recipient and isinstance(message, self.kind) and all(
            getattr(message, name) == value for name, value in self.fields.items())
        return [(self.delay_s if late else 1e-3, message)]


POSITIONING, TRANSMISSION = {'mode': m.Mode.POSITIONING}, {'mode': m.Mode.TRANSMISSION}


@pytest.mark.parametrize(('kind', 'recipient', 'fields'), [
    (m.GroundTruth, 'channel', {}),
    (m.GroundTruth, 'transmission', {}),
    (m.RhsConfiguration, 'channel', POSITIONING),
    (m.RhsConfiguration, 'channel', TRANSMISSION),
    (m.RhsConfiguration, 'bs', POSITIONING),
    (m.RhsConfiguration, 'bs', TRANSMISSION),
    (m.Pilot, 'channel', {}),
    (m.FeedSignals, 'bs', {}),
    (m.ReceivedSignals, 'positioner', {}),
    (m.PositionEstimate, 'bs', {}),
    (m.PositionEstimate, 'transmission', {}),
    (m.Beam, 'bs', {}),
    (m.Beam, 'rhs_controller', {}),
    (m.Beam, 'channel', {}),
    (m.Grant, 'user1', {}),
    (m.PilotRequest, 'user1', {}),
    (m.Data, 'bs', {}),
    (m.Data, 'channel', {}),
    (m.Data, 'user1', {}),
], ids=lambda value: getattr(value, '__name__', None))
def test_a_message_may_be_late(network, kind, recipient, fields):
    net = network(transport=Delays(kind, recipient, 0.05, **fields))
    net.run_cycles(3)
    assert net.served() == [1, 1, 1]
    net.verify()


def test_no_cycle_is_lost_by_reordering_alone(network, noisy):
    for seed in range(5):
        net = network(2, transport=noisy(seed, jitter_s=0.02))
        net.run_cycles(20)
        assert {outcome for _, _, outcome in net.outcomes()} == {'served'}
        net.verify()


def test_data_wait_for_both_the_beam_and_the_surface_in_every_cycle(network):
    """They arrive in either order, and nothing is kept from cycle to cycle."""
    beam_late, surface_late = Delays(m.Beam, 'bs', 0.05), Delays(
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


def test_an_estimate_that_arrives_after_its_beam_is_not_a_fault(network):
    net = network(transport=Delays(m.PositionEstimate, 'bs', 2.5e-3))
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert net.counters() == {}


def test_the_surface_may_be_ready_before_the_base_station_has_estimate_and_beam(network):
    delays = Delays(m.PositionEstimate, 'bs', 0.06), Delays(m.Beam, 'bs', 0.05)
    net = network(transport=lambda message, recipient: max(
        (delay(message, recipient) for delay in delays), key=lambda arriving: arriving[0][0]))
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
    transports = [Delays(kind, recipient, 0.6) for kind, recipient in slow]
    net = network(transport=lambda message, recipient: max(
        (t(message, recipient) for t in transports), key=lambda arriving: arriving[0][0]))
    net.run_cycles(2)
    assert net.served() == [1, 1]


def test_data_of_another_user_in_an_older_cycle_are_ignored(network):
    user = network()['user1']
    user.handle(m.Beacon(cycle_id=8, attempt=0), 0.0)
    user.handle(m.Data(
        cycle_id=7, user=2, direction=m.Direction.DOWNLINK, stage=m.Stage.DELIVERED,
        duration_s=1e-3, bits=1e3), 0.1)
    assert user.state is State.ACKNOWLEDGED
    (send,) = user.handle(m.Grant(cycle_id=8, user=1), 0.2)
    assert isinstance(send.message, m.GroundTruth)


def test_a_duplicate_true_position_changes_nothing(network):
    def doubles(message, recipient):
        again = [(2.5e-3, message)] if isinstance(message, m.GroundTruth) else []
        return [(1e-3, message), *again]

    net = network(transport=doubles)
    net.run_cycles(2)
    assert net.served() == [1, 1]
    assert net.counters() == {'channel': {'duplicate': 2}}
    net.verify()
