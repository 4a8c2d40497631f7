"""Parameters of running nodes change between cycles without the loss of a cycle."""

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_srvs.srv import Trigger

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Network
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import EXCHANGE

NAMESPACE = 'dynamic'


class Running:
    """A running network: its diagnostics, and the parameters of its nodes."""

    def __init__(self, process, watch):
        self.process, self.watch = process, watch
        self.diagnostics = {}
        self._clients = {}
        watch.node.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS, self._store, EXCHANGE)

    def _store(self, message):
        for status in message.status:
            self.diagnostics[status.name.removeprefix(f'{NAMESPACE}/')] = {
                pair.key: pair.value for pair in status.values}

    def set(self, node, **values):
        """Set parameters together and return the result."""
        if node not in self._clients:
            self._clients[node] = AsyncParameterClient(self.watch.node, node)
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        return self.watch.call(
            self._clients[node],
            lambda client: client.set_parameters_atomically(parameters)).result

    def get(self, node, name):
        (value,) = self.watch.call(
            self._clients[node], lambda client: client.get_parameters([name])).values
        return value.string_value

    def until_reported(self, *nodes, **values):
        """Wait until new diagnostics of nodes have the given values; None: no value."""
        wanted = {name.replace('__', '.'): value for name, value in values.items()}
        self.diagnostics.clear()
        self.watch.until(
            lambda: all(node in self.diagnostics and all(
                self.diagnostics[node].get(name) == value for name, value in wanted.items())
                for node in nodes),
            f'{wanted} of {nodes}', [self.process])

    def next_estimators(self):
        """Return the estimators, by cycle, of the cycles until two more are served."""
        before = len(self.watch.received[m.PositionEstimate])
        self.watch.until_served(2, processes=[self.process])
        return {e.cycle_id: e.estimator for e in self.watch.received[m.PositionEstimate][before:]}


@pytest.fixture(scope='module')
def running(make_watch, module_processes, small_files):
    # Without a pause, cycles are faster than the observer.
    process = module_processes.start(
        'network', namespace=f'/{NAMESPACE}', users=2, rest_s=0.02,
        scenario_file=small_files / 'scenario.yaml',
        codebook_file=small_files / 'first.yaml')
    running = Running(process, make_watch(f'/{NAMESPACE}'))
    running.watch.until_served(2, processes=[process])
    return running


@pytest.fixture
def model(small_files, tmp_path):
    """Return a function that writes a model for a codebook and returns its file."""
    def write(name):
        fields = yaml.safe_load((small_files / 'scenario.yaml').read_text(encoding='utf-8'))
        codebook = Codebook.load(small_files / f'{name}.yaml')
        n_parts = 2 * codebook.digital[..., 0].size
        file = tmp_path / f'{name}.npz'
        Network(
            np.zeros(n_parts), np.ones(n_parts), np.zeros((n_parts, 1)), np.ones(1),
            np.array([[1.0, 0.5, 0.25]]), np.zeros(3), np.array([8.0, 0.0, 0.0]),
            2 * np.eye(3), 1e4,
            {'codebook': codebook.id, 'scenario': Scenario(**fields).changes()}).save(file)
        return str(file)
    return write


def test_changes_of_policy_and_noise_are_reported(running):
    before = len(running.watch.given_up)
    assert running.set('bs', policy='first', receiver_noise=False).successful
    running.until_reported('bs', parameter__policy='first', parameter__receiver_noise='false',
                       pending__policy=None, pending__receiver_noise=None)
    assert running.set('bs', policy='round_robin', receiver_noise=True).successful
    running.watch.until_served(2, processes=[running.process])
    assert len(running.watch.given_up) == before
    assert "settings applied: policy 'first', receiver_noise 'false'" in running.process.log


def test_an_invalid_value_is_rejected_with_the_reason(running):
    result = running.set('bs', rest_s=1)
    assert not result.successful
    assert result.reason.startswith('rest_s: 1, expected a number with a decimal point, 0 to')


def test_the_estimator_changes_without_the_loss_of_a_cycle(running):
    watch, before = running.watch, len(running.watch.given_up)
    for name in ('ml', 'bayes'):
        assert running.set('positioner', estimator=name).successful
        running.until_reported('positioner', parameter__estimator=name, pending__estimator=None)
        assert set(running.next_estimators().values()) == {name}
    names = {}
    for estimate in watch.received[m.PositionEstimate]:
        assert names.setdefault(estimate.cycle_id, estimate.estimator) == estimate.estimator
    # One change to the other estimator and one back.
    order = [names[cycle_id] for cycle_id in sorted(names)]
    assert sum(a != b for a, b in zip(order, order[1:], strict=False)) == 2
    assert len(watch.given_up) == before


def test_users_are_tracked_on_request(running):
    """Odometry of both users has the positions of their estimates; it ends with the prior."""
    watch, before, tracks = running.watch, len(running.watch.given_up), []
    for user in (1, 2):
        watch.node.create_subscription(
            Odometry, topics.ODOMETRY.format(user=user), tracks.append, EXCHANGE)
    assert running.set('positioner', prior='track').successful
    running.until_reported('positioner', parameter__prior='track', pending__prior=None)

    def published():
        return {track.child_frame_id: track for track in tracks}
    watch.until(lambda: set(published()) == {'dynamic/user_1', 'dynamic/user_2'}, 'odometry',
                [running.process])
    place = published()['dynamic/user_1'].pose.pose.position
    watch.until(lambda: any(
        tuple(estimate.position) == (place.x, place.y, place.z)
        for estimate in watch.received[m.PositionEstimate] if estimate.user == 1),
        'the estimate', [running.process])
    assert running.set('positioner', prior='region').successful
    running.until_reported('positioner', parameter__prior='region', pending__prior=None)
    assert len(watch.given_up) == before


def test_a_model_for_another_codebook_keeps_the_old_estimator(running, model):
    before = len(running.watch.given_up)
    assert running.set('positioner', estimator='neural', model_file=model('second')).successful
    running.until_reported('positioner', parameter__estimator='bayes', pending__estimator=None)
    assert 'trained for codebook' in running.diagnostics['positioner']['failed.estimator']
    assert set(running.next_estimators().values()) == {'bayes'}
    assert running.get('positioner', 'estimator') == 'bayes'
    assert running.process.log.count('cannot build estimator neural, keeping bayes') == 1
    # Set separately, the model comes first.
    assert running.set('positioner', model_file=model('first')).successful
    assert running.set('positioner', estimator='neural').successful
    running.until_reported('positioner', parameter__estimator='neural', failed__estimator=None)
    assert set(running.next_estimators().values()) == {'neural'}
    assert not running.set('positioner', model_file='').successful
    assert running.set('positioner', estimator='bayes', model_file='').successful
    assert len(running.watch.given_up) == before


def test_band_and_impairments_change(running):
    for band in (0, 1):
        assert running.set('transmission', band=band).successful
        # The beam of the current cycle may arrive after the response.
        running.watch.until_served(1, processes=[running.process])
        before = len(running.watch.received[m.Beam])
        running.watch.until_served(2, processes=[running.process])
        assert {beam.band for beam in running.watch.received[m.Beam][before:]} == {band}
    assert running.set('transmission', band=-1).successful
    assert running.set('channel', double_probability=1.0, delay_s=0.001).successful
    running.watch.until_served(2, processes=[running.process])
    running.until_reported('channel', parameter__double_probability='1.0',
                       parameter__delay_s='0.001', pending__delay_s=None)
    assert int(running.diagnostics['channel']['dropped.emulated_double']) > 0
    assert running.set('channel', double_probability=0.0, delay_s=0.0).successful


def frame_change(running):
    """Largest relative change of the feed signals between the first two frames of a band."""
    latest = running.watch.received[m.FeedSignals][-1].signals
    return np.abs(latest[1] - latest[0]).max() / np.abs(latest[0]).max()


def test_failed_elements_are_switched_on_and_off(running):
    """If all elements are stuck, the configurations of the frames have no effect."""
    assert running.set('channel', failed_element_share=1.0).successful
    running.until_reported('channel', parameter__failed_element_share='1.0',
                           pending__failed_element_share=None)
    n_before = len(running.watch.received[m.FeedSignals])
    running.watch.until(lambda: len(running.watch.received[m.FeedSignals]) > n_before + 5,
                        'feed signals', [running.process])
    # Doppler changes the multipath by about 1e-3 from frame to frame.
    assert frame_change(running) < 5e-3
    assert running.set('channel', failed_element_share=-1.0).successful
    running.until_reported('channel', parameter__failed_element_share='-1.0',
                           pending__failed_element_share=None)
    running.watch.until_served(3, processes=[running.process])
    assert frame_change(running) > 1e-2


def test_the_codebook_in_use_is_reported(running, small_files):
    second = Codebook.load(small_files / 'second.yaml')
    assert running.set('optimizer', **second.to_parameters()).successful
    running.until_reported('optimizer', 'bs', 'rhs_controller', 'positioner', 'transmission',
                       codebook_id=second.id, pending__codebook_id=None)


def test_the_base_station_can_be_paused_stepped_and_resumed(running):
    watch = running.watch
    clients = {name: watch.node.create_client(Trigger, f'bs/{name}')
               for name in ('pause', 'resume', 'step')}

    def request(name):
        response = watch.call(clients[name], lambda client: client.call_async(Trigger.Request()))
        return response.success, response.message
    assert request('step') == (False, 'not paused; a step requires a pause')
    success, message = request('pause')
    assert success
    assert message == 'paused' or message.startswith('the pause begins after cycle ')
    running.until_reported('bs', phase='paused')
    assert request('pause') == (True, 'already paused')
    served = len(watch.served)
    success, message = request('step')
    assert success
    watch.until(lambda: len(watch.served) > served, 'the cycle', [running.process])
    running.until_reported('bs', phase='paused')
    assert len(watch.served) == served + 1
    assert request('resume') == (True, 'resumed')
    watch.until_served(2, processes=[running.process])
