"""The node of the positioner: estimators made in the background."""

import threading

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rclpy.node import Node
from ros_messages import to_ros

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import simulate_received
from rhs_isac_ros.nodes.positioner import PositionerNode
from rhs_isac_ros.positioning import EstimatorKind, Network, make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import CodebookOffered
from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.endpoints import EXCHANGE
from rhs_isac_ros.support import plugins

PLACE = np.array([10.0, 0.5, 0.2])


@pytest.fixture
def codebooks(bench_files):
    return [Codebook.load(bench_files / f'{name}.yaml') for name in ('first', 'second')]


@pytest.fixture
def values():
    """Additional parameters."""
    return {}


@pytest.fixture
def node(bench, bench_files, tmp_path, values):
    return bench.add(PositionerNode, values={
        'scenario_file': bench_files / 'scenario.yaml', 'table_folder': tmp_path / 'tables',
        **values})


def test_what_a_scenario_leaves_out_is_named(bench, tmp_path, capfd):
    """Long frames without a velocity, and users outside who are to be rejected."""
    path = tmp_path / 'slow.yaml'
    path.write_text('{frame_duration_s: 0.015, outside_probability: 0}')
    bench.add(PositionerNode, values={'scenario_file': path})
    text = capfd.readouterr().err
    assert text.count('user_speed_std_mps: 0, but users of max_user') == 1
    assert text.count('outside_probability: 0 in the scenario') == 1


@pytest.fixture
def send(bench, node, codebooks):
    """Return a function that sends valid signals of a cycle and returns them."""
    publishers = []

    def send(cycle_id, number=0, factor=1.0):
        if not publishers:
            probe = bench.add(Node, 'probe')
            publishers.append(bench.publisher(probe, m.ReceivedSignals))
        codebook = codebooks[number]
        rng = np.random.default_rng(cycle_id)
        signals = factor * simulate_received(node.scenario, codebook, PLACE[None], rng)[0]
        message = m.ReceivedSignals(
            cycle_id=cycle_id, user=1, codebook_id=codebook.id,
                signals=signals.reshape(codebook.digital.shape[:3]))
        publishers[0].publish(to_ros(message, node.get_clock().now().to_msg()))
        return signals
    return send


def test_the_estimate_equals_that_of_the_library(bench, node, send, codebooks, tmp_path):
    estimates = bench.collect(bench.add(Node, 'receiver'), m.PositionEstimate)
    node.dispatch(CodebookOffered(codebooks[0]))
    signals = send(8)
    (estimate,) = bench.until(lambda: estimates)
    expected = make_estimator(
        'bayes', node.scenario, codebooks[0], reject_outside=True).estimate(signals).to_site(
            node.scenario.pose)
    np.testing.assert_array_equal(estimate.position, expected.mean)
    np.testing.assert_array_equal(estimate.covariance_m2, expected.covariance)
    assert len(list((tmp_path / 'tables').iterdir())) == 2


def test_the_diagnostics_contain_the_progress_of_a_table(bench, node, codebooks, monkeypatch):
    released, original = threading.Event(), EstimatorKind.create

    def half(kind, system, *, progress, **options):
        progress(0.5)
        released.wait(30)
        return original(kind, system, progress=progress, **options)

    monkeypatch.setattr(EstimatorKind, 'create', half)
    node.dispatch(CodebookOffered(codebooks[0]))
    bench.until(lambda: node.report().details.get('table.progress') == '50 %', 'the progress')
    released.set()
    bench.until(lambda: 'table.progress' not in node.report().details, 'the end')


def test_signals_are_answered_while_another_estimator_is_built(
        bench, node, send, codebooks, monkeypatch):
    released, begun, original = threading.Event(), threading.Event(), EstimatorKind.create

    def slowly(kind, system, **options):
        if system.codebook.id == codebooks[1].id:
            begun.set()
            released.wait()
        return original(kind, system, **options)
    monkeypatch.setattr(EstimatorKind, 'create', slowly)
    estimates = bench.collect(bench.add(Node, 'receiver'), m.PositionEstimate)
    node.dispatch(CodebookOffered(codebooks[0]))
    send(6)
    bench.until(lambda: len(estimates) == 1)
    node.dispatch(CodebookOffered(codebooks[1]))
    bench.until(begun.is_set)
    send(7, 1)
    send(8)
    bench.until(lambda: len(estimates) == 2)
    released.set()
    bench.until(lambda: len(estimates) == 3)
    assert [(e.cycle_id, e.codebook_id) for e in estimates] == [
        (6, codebooks[0].id), (8, codebooks[0].id), (7, codebooks[1].id)]


class TestTrack:
    """A node whose prior is the track of the user."""

    @pytest.fixture
    def values(self):
        return {'prior': 'track'}

    def test_each_user_has_odometry(self, bench, node, send, codebooks):
        receiver, tracks = bench.add(Node, 'receiver'), []
        estimates = bench.collect(receiver, m.PositionEstimate)
        subscription = receiver.create_subscription(
            Odometry, 'users/user_1/odometry', tracks.append, EXCHANGE)
        node.dispatch(CodebookOffered(codebooks[0]))
        # The first estimate creates the topic.
        send(6)
        bench.until(subscription.get_publisher_count, 'the topic')
        send(8)
        last = bench.until(lambda: estimates[1:], 'the second estimate')[0]
        bench.until(lambda: tracks and tracks[-1].pose.pose.position.x == last.position[0],
                    'its odometry')
        track = tracks[-1]
        assert (track.header.frame_id, track.child_frame_id) == ('map', 'user_1')
        covariance = np.reshape(track.pose.covariance, (6, 6))
        np.testing.assert_array_equal(covariance[:3, :3], last.covariance_m2)
        velocity = track.twist.twist.linear
        assert np.linalg.norm([velocity.x, velocity.y, velocity.z]) > 0
        assert np.linalg.eigvalsh(np.reshape(track.twist.covariance, (6, 6))).min() > 0


class TestNeural:
    """A node with a model of the first codebook."""

    @pytest.fixture
    def model(self, small, codebooks):
        n_parts = 2 * codebooks[0].digital[..., 0].size
        return Network(
            np.zeros(n_parts), np.ones(n_parts), np.zeros((n_parts, 1)), np.ones(1),
            np.array([[1.0, 0.5, 0.25]]), np.zeros(3), np.array([8.0, 0.0, 0.0]),
            2 * np.eye(3), 1e4,
            {'codebook': codebooks[0].id, 'scenario': small.scenario.changes()})

    @pytest.fixture
    def values(self, tmp_path, model):
        model.save(tmp_path / 'model.npz')
        return {'estimator': 'neural', 'model_file': str(tmp_path / 'model.npz')}

    def test_its_model_is_used_for_one_codebook_and_rejected_for_another(
            self, bench, node, send, codebooks, monkeypatch):
        logged = []
        monkeypatch.setattr(endpoints, 'log', lambda node, text, *_: logged.append(text))
        estimates = bench.collect(bench.add(Node, 'receiver'), m.PositionEstimate)
        node.dispatch(CodebookOffered(codebooks[0]))
        send(1)
        bench.until(lambda: len(estimates) == 1)
        node.dispatch(CodebookOffered(codebooks[1]))
        line = bench.until(lambda: next((text for text in logged if text.startswith(
            f'no estimator for codebook {codebooks[1].id}: ')), None))
        assert f'model.npz: trained for codebook {codebooks[0].id}, expected' in line
        send(2, 1)
        send(3)
        bench.until(lambda: len(estimates) == 2)
        assert [(e.cycle_id, e.estimator) for e in estimates] == [(1, 'neural'), (3, 'neural')]
        np.testing.assert_array_equal(estimates[1].position, [9.0, 0.5, 0.25])
        np.testing.assert_allclose(
            estimates[1].covariance_m2,
            2 * np.eye(3) + node.scenario.pose.scatter(np.array([9.0, 0.5, 0.25])))


class TestPlugin:
    """A node with an estimator of another package."""

    CODE = '''
from rhs_isac_ros.positioning import BayesEstimator

class Mine(BayesEstimator):
    name = 'mine'
'''

    @pytest.fixture
    def values(self, install):
        install('guesses', self.CODE, {plugins.ESTIMATORS: {'mine': 'Mine'}})
        return {'estimator': 'mine'}

    def test_the_plug_in_estimates(self, bench, node, send, codebooks):
        estimates = bench.collect(bench.add(Node, 'receiver'), m.PositionEstimate)
        node.dispatch(CodebookOffered(codebooks[0]))
        send(8)
        (estimate,) = bench.until(lambda: estimates)
        assert estimate.estimator == 'mine'
