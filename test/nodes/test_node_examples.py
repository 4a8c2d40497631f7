"""The examples of other nodes, which know only the documented interfaces."""

import importlib.util
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.multipath import complex_normal
from rhs_isac_ros.model.surface import combine, element_signals, feed_signals
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Send
from rhs_isac_ros.protocol.user import UserState
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, LATCHED
from rhs_isac_ros.ros.roster import ROSTER

EXAMPLES = Path(__file__).parents[2] / 'docs' / 'examples'
PLACE = [9.0, 1.0, 0.0]
# Topics that a role receives.
TOPICS = sorted({f'/{topic}' for member in ROSTER.values() for topic in member.received})


def module_of(name):
    """Return an example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def example():
    return module_of('radio_node')


class Hardware:
    """Surface, user and noisy receivers, without scattering."""

    def __init__(self, scenario):
        self._scenario, self._rng = scenario, np.random.default_rng(8)
        self.measured, self.carried = {}, []

    def measure(self, band, configurations, pilot):
        direct = los_gain(self._scenario, np.array([PLACE]), band)[0]
        feeds = np.array([
            feed_signals(self._scenario, band, configuration, element_signals(
                direct, np.zeros(1), symbol))
            for configuration, symbol in zip(configurations, pilot.symbols, strict=True)])
        feeds += 1e-9 * complex_normal(feeds.shape, self._rng)
        self.measured[pilot.cycle_id, band] = feeds
        return feeds

    def carry(self, data):
        self.carried.append(data.direction)
        return data.bits // 2


def test_a_network_with_the_radio_serves_the_user_without_repetitions(
        bench, example, bench_files):
    file, codebook_file = bench_files / 'scenario.yaml', bench_files / 'first.yaml'
    scenario, codebook = Scenario.from_yaml(file), Codebook.load(codebook_file)
    hardware = Hardware(scenario)
    for role, values in {
            'optimizer': {'codebook_file': codebook_file}, 'rhs_controller': {},
            'positioner': {'table_folder': ''}, 'transmission': {},
            # A step is repeated only if a message is lost, also on a busy machine.
            'bs': {'receiver_noise': False, 'rest_s': 0.1, 'step_timeout_s': 10.0,
                   'retries': 1}}.items():
        bench.add_role(role, values={'scenario_file': file, **values})
    bench.add(example.RadioNode, hardware.measure, hardware.carry, values={'scenario_file': file})
    receiver, posteriors = bench.add(Node, 'receiver'), []
    states, received, requests, estimates = (bench.collect(receiver, kind) for kind in (
        m.ProtocolState, m.ReceivedSignals, m.PilotRequest, m.PositionEstimate))
    receiver.create_subscription(ros.Posterior, 'posterior', posteriors.append, EXCHANGE)
    with subprocess.Popen([sys.executable, EXAMPLES / 'user_node.py']) as user:
        try:
            bench.until(lambda: next(incomplete(receiver), None) is None, 'all endpoints')

            def served():
                """Return cycles that were served with one request, which may be repeated."""
                asked = [request.cycle_id for request in requests]
                return [state.cycle_id for state in states
                        if state.outcome == 'served' and asked.count(state.cycle_id) == 1]
            cycle_id = bench.until(served, 'a served cycle')[-1]
            check_endpoints(receiver)
            posterior, estimate = bench.until(
                lambda: both(posteriors, estimates), 'a posterior and its estimate')[0]
        finally:
            user.terminate()
            try:
                user.wait(60)
            except subprocess.TimeoutExpired:
                user.kill()
    # Rarely, Fast DDS 2.14 never destroys a publisher; see `run.run`.
    assert user.returncode in (0, -signal.SIGKILL)
    assert {state.user for state in states if state.user} == {7}
    signals = next(one.signals for one in received if one.cycle_id == cycle_id)
    # The base station combined the measured signals and added nothing.
    feeds = np.array([hardware.measured[cycle_id, band] for band in range(scenario.n_bands)])
    np.testing.assert_array_equal(
        signals, combine(codebook.digital, np.swapaxes(feeds, 1, 2), 0.0))
    assert hardware.carried[:2] == [m.Direction.DOWNLINK, m.Direction.UPLINK]
    mean, covariance = module_of('read_posterior').estimate(posterior)
    np.testing.assert_allclose(mean, estimate.position, rtol=0, atol=1e-6)
    np.testing.assert_allclose(covariance, estimate.covariance_m2, rtol=1e-6)


def both(posteriors, estimates):
    """Return pairs of messages of the same cycle."""
    return [(one, other) for one in posteriors for other in estimates
            if one.cycle_id == other.cycle_id]


def test_the_reader_of_posteriors_imports_nothing_of_this_package():
    done = subprocess.run(
        [sys.executable, '-c', "import runpy, sys; runpy.run_path(sys.argv[1]); "
         "assert not [name for name in sys.modules if name.startswith('rhs_isac_ros')]",
         EXAMPLES / 'read_posterior.py'], timeout=240, check=False)
    assert done.returncode == 0


def incomplete(node):
    """Yield the topics between roles without a publisher or without a subscriber."""
    for topic in TOPICS:
        for infos in (node.get_publishers_info_by_topic(topic),
                      node.get_subscriptions_info_by_topic(topic)):
            if not {info.node_name for info in infos} - {node.get_name()}:
                yield topic


def check_endpoints(node):
    """Check that publishers and subscribers are compatible, and that no topic is hidden."""
    for topic in TOPICS:
        for publisher in node.get_publishers_info_by_topic(topic):
            for subscriber in node.get_subscriptions_info_by_topic(topic):
                assert qos_check_compatible(publisher.qos_profile, subscriber.qos_profile)[0] != (
                    QoSCompatibility.ERROR), topic
    # Those of an action are hidden by the convention of ROS.
    assert not [name for name, _ in node.get_topic_names_and_types()
                if any(part.startswith('_') and part != '_action' for part in name.split('/'))]


def test_one_message_by_hand_is_answered(bench, probe):
    """As ``ros2 topic pub --once`` sends it: when there is a subscriber, and once."""
    user = bench.add_role('user', values={'user_id': 4})
    bench.add_role('channel')
    answers = bench.collect(probe, m.Ack)
    # A node by hand announces its role, as ``ros2 topic pub presence`` does.
    presence = probe.create_publisher(ros.Presence, topics.PRESENCE, LATCHED)
    probe.create_timer(0.4, lambda: presence.publish(
        ros.Presence(sender=1, role='bs', node='/bs', scenario='{}')))
    bench.until(lambda: user.role.state is not UserState.DISCONNECTED, 'the presence of all roles')
    bench.publisher(probe, m.Beacon).publish(
        ros.Beacon(cycle_id=5, first_user=1, last_user=9))
    bench.until(lambda: answers, 'the answer')
    assert [(ack.cycle_id, ack.user) for ack in answers] == [(5, 4)]


@pytest.fixture
def radio(example):
    return example.Radio(lambda band, configurations, pilot: configurations * (1 + 0j),
                         lambda data: 3.0)


def configuration(cycle_id, band=0):
    return m.RhsConfiguration(
        cycle_id=cycle_id, mode=m.Mode.POSITIONING, band=band, codebook_id='c',
        analog=np.array([[0.1, 0.2], [0.3, 0.4]]))


def pilot(cycle_id, band=0, symbols=(1, 1)):
    return m.Pilot(cycle_id=cycle_id, user=1, band=band, symbols=np.array(symbols, complex))


def answers(radio, event):
    actions = radio.handle(event, 0.0)
    assert all(isinstance(action, Send) for action in actions)
    return [action.message for action in actions]


def test_pilots_that_arrive_before_their_configuration_wait_for_it(radio):
    assert answers(radio, pilot(5)) == []
    sent, = answers(radio, configuration(5))
    assert (sent.cycle_id, sent.band) == (5, 0)
    np.testing.assert_array_equal(sent.signals, [[0.1, 0.2], [0.3, 0.4]])
    assert answers(radio, pilot(5, band=1)) == []
    assert len(answers(radio, configuration(5, 1))) == 1


def test_signals_are_divided_by_the_symbols(radio):
    answers(radio, configuration(5))
    sent, = answers(radio, pilot(5, symbols=(1j, -1)))
    np.testing.assert_allclose(sent.signals, [[-0.1j, -0.2j], [-0.3, -0.4]])


def test_a_delayed_configuration_of_an_older_cycle_changes_nothing(radio):
    answers(radio, configuration(6))
    answers(radio, configuration(5, 1))
    assert [s.cycle_id for s in answers(radio, pilot(6))] == [6]
    assert answers(radio, pilot(6, band=1)) == []


def test_the_oldest_unanswered_pilots_are_discarded(radio):
    for _ in range(1000):
        answers(radio, pilot(7))
    assert len(radio._waiting) == 256
