"""Well-formed messages with extreme values do not crash a node.

The executor raises the exceptions of callbacks in the test, so a node that would crash fails it.
The tests of a node share it where they can, each with cycles of its own.
"""

import dataclasses
import itertools

import numpy as np
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_messages import to_ros

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import simulate_received
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.nodes.channel import ChannelNode
from rhs_isac_ros.nodes.optimizer import OptimizerNode
from rhs_isac_ros.nodes.positioner import PositionerNode
from rhs_isac_ros.nodes.transmission import TransmissionNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.messages import check
from rhs_isac_ros.ros import topics

# Outside tests, warnings are only printed.
pytestmark = pytest.mark.filterwarnings('ignore::RuntimeWarning')

PLACE = np.array([10.0, 0.5, 0.2])
HUGE = (1e100, 1e200, 1e308)
# Of the scenario of `bench_files`.
N_FRAMES = 2


def add(bench, files, kind, **values):
    values['scenario_file'] = files / 'scenario.yaml'
    return bench.add(kind, parameter_overrides=[
        Parameter(name, value=str(value)) for name, value in values.items()])


class NodeUnderTest:
    """A node under test and publishers for the messages that it receives."""

    def __init__(self, bench, files, kind, inputs, answers):
        self.node = add(bench, files, kind)
        self._bench = bench
        probe = bench.add(Node, 'probe')
        self._publishers = {kind: bench.publisher(probe, kind) for kind in inputs}
        # Nodes subscribe to some documented topics only when they have discovered the publisher.
        bench.until(lambda: all(self.node.get_name() in {
            info.node_name for info in probe.get_subscriptions_info_by_topic(
                f'/{topics.NAMES[kind]}')} for kind in inputs), 'the subscriptions')
        self._cycles = itertools.count(1)
        self._dispatched, self._dispatch = 0, self.node.dispatch
        self.node.dispatch = self._count
        self.received = bench.collect(probe, answers)
        self.scenario = self.node.scenario
        self.codebook = Codebook.load(files / 'first.yaml')

    def _count(self, event):
        try:
            self._dispatch(event)
        finally:
            self._dispatched += 1

    @property
    def _handled(self):
        """Number of messages that the role has handled or the node has dropped."""
        return self._dispatched + self.node.role.counters['malformed']

    def new_cycle(self):
        """Return the number of a cycle that no message has named."""
        return next(self._cycles)

    def send(self, *messages):
        """Send messages, each once the previous one has been handled: topics share no order."""
        stamp = self.node.get_clock().now().to_msg()
        for message in messages:
            before = self._handled
            self._publishers[type(message)].publish(to_ros(message, stamp))
            self._bench.until(lambda before=before: self._handled > before, 'the handling')

    def until_answer(self, cycle_id):
        """Wait for the answer to a plausible message and check all answers."""
        self._bench.until(lambda: self.received and self.received[-1].cycle_id == cycle_id,
                          'the answer to a plausible message')
        for message in self.received:
            check(message, self.scenario.sizes)


@pytest.fixture(scope='module')
def channel(module_bench, bench_files):
    return NodeUnderTest(
        module_bench, bench_files, ChannelNode,
        (m.GroundTruth, m.RhsConfiguration, m.Pilot, m.Beam, m.Data), m.FeedSignals)


@pytest.fixture(scope='module')
def optimizer(module_bench, bench_files):
    return add(module_bench, bench_files, OptimizerNode, codebook_file=bench_files / 'first.yaml')


@pytest.fixture(scope='module')
def transmission(module_bench, optimizer, bench_files):
    return NodeUnderTest(
        module_bench, bench_files, TransmissionNode,
        (m.PositionEstimate, m.RhsConfiguration, m.GroundTruth), m.Beam)


@pytest.fixture(scope='module')
def positioner(module_bench, optimizer, bench_files):
    return NodeUnderTest(
        module_bench, bench_files, PositionerNode, (m.ReceivedSignals,), m.PositionEstimate)


def truth(cycle_id, place=PLACE):
    return m.GroundTruth(
        cycle_id=cycle_id, user=1, position=np.asarray(place, float), velocity=np.zeros(3))


def pilot(cycle_id, symbol=1.0):
    return m.Pilot(cycle_id=cycle_id, user=1, band=0, symbols=np.full(N_FRAMES, symbol + 0j))


def applied(scenario, cycle_id, mode=m.Mode.POSITIONING, rows=None):
    rows = rows or (scenario.n_frames if mode is m.Mode.POSITIONING else 1)
    return m.RhsConfiguration(
        cycle_id=cycle_id, mode=mode, band=0, codebook_id='',
        analog=np.full((rows, scenario.n_elements), 0.5))


def beam(scenario, cycle_id, amplitude=1e-3, expected_bps=1e6):
    digital = np.full((scenario.n_subbands, scenario.n_feeds), amplitude + 0j)
    return m.Beam(
        cycle_id=cycle_id, user=1, codebook_id='', band=0,
        analog=np.full(scenario.n_elements, 0.5), digital=digital, expected_bps=expected_bps)


def send_plausible_pilot(node):
    cycle = node.new_cycle()
    node.send(truth(cycle), applied(node.scenario, cycle), pilot(cycle))
    node.until_answer(cycle)


@pytest.mark.parametrize('rows', [1, 3, 5])
def test_channel_continues_after_configurations_for_another_number_of_frames(channel, rows):
    cycle = channel.new_cycle()
    channel.send(truth(cycle), applied(channel.scenario, cycle, rows=rows), pilot(cycle))
    send_plausible_pilot(channel)


@pytest.mark.parametrize('place', [
    (0, 0, 0), 'on an element', (-10, 0, 0), *((number, 0, 0) for number in HUGE)])
def test_channel_continues_after_positions_outside_the_model(channel, place):
    scenario, cycle = channel.scenario, channel.new_cycle()
    place = element_positions(scenario)[1] if place == 'on an element' else place
    channel.send(truth(cycle, place), applied(scenario, cycle), pilot(cycle),
                 applied(scenario, cycle, m.Mode.TRANSMISSION), beam(scenario, cycle),
                 m.Data(cycle_id=cycle, user=1, direction=m.Direction.DOWNLINK,
                     stage=m.Stage.OFFERED, duration_s=1.0, bits=1.0))
    send_plausible_pilot(channel)


@pytest.mark.parametrize('number', HUGE)
def test_channel_continues_after_huge_numbers(channel, number):
    scenario, first, second = channel.scenario, channel.new_cycle(), channel.new_cycle()
    channel.send(
        truth(first), applied(scenario, first), pilot(first, number),
        applied(scenario, first, m.Mode.TRANSMISSION), beam(scenario, first),
        m.Data(
            cycle_id=first, user=1, direction=m.Direction.DOWNLINK, stage=m.Stage.OFFERED,
            duration_s=number, bits=number),
        truth(second), applied(scenario, second, m.Mode.TRANSMISSION),
        beam(scenario, second, number),
        m.Data(cycle_id=second, user=1, direction=m.Direction.DOWNLINK, stage=m.Stage.OFFERED,
            duration_s=1.0, bits=1.0))
    send_plausible_pilot(channel)


def test_channel_continues_after_messages_with_unknown_cycles(channel):
    last = 2**64 - 1
    for cycle_id in (0, last):
        channel.send(pilot(cycle_id), applied(channel.scenario, cycle_id), truth(cycle_id),
                     m.Data(cycle_id=cycle_id, user=0, direction=m.Direction.UPLINK,
                         stage=m.Stage.DELIVERED, duration_s=-1.0, bits=-1.0))
    send_plausible_pilot(channel)


def estimate(node, cycle_id, place=PLACE):
    return m.PositionEstimate(
        cycle_id=cycle_id, user=1, codebook_id=node.codebook.id,
        position=np.asarray(place, float), covariance_m2=np.eye(3), crlb_m2=0.1, estimator='rogue',
        latency_s=0.1)


@pytest.mark.parametrize('place', [
    (0, 0, 0), 'on an element', (-10, 0, 0), *((number, 0, 0) for number in HUGE)])
@pytest.mark.parametrize('what', ['estimate', 'truth'])
def test_transmission_continues_after_positions_outside_the_model(transmission, place, what):
    node, scenario = transmission, transmission.scenario
    first, second = node.new_cycle(), node.new_cycle()
    place = element_positions(scenario)[1] if place == 'on an element' else place
    places = {'estimate': PLACE, 'truth': PLACE, what: place}
    node.send(truth(first, places['truth']), estimate(node, first, places['estimate']),
              applied(scenario, first, m.Mode.TRANSMISSION), estimate(node, second))
    node.until_answer(second)


@pytest.mark.parametrize('number', HUGE)
def test_positioner_continues_after_huge_signals(positioner, number):
    node, first, second = positioner, positioner.new_cycle(), positioner.new_cycle()
    scenario, codebook = node.scenario, node.codebook
    shape = codebook.digital.shape[:3]
    plausible = simulate_received(scenario, codebook, PLACE[None], np.random.default_rng(0))[0]
    received = m.ReceivedSignals(cycle_id=first, user=1, codebook_id=codebook.id,
        signals=np.full(shape, number * (1 + 1j)))
    node.send(received)
    node.send(dataclasses.replace(received, cycle_id=second, signals=plausible.reshape(shape)))
    node.until_answer(second)
