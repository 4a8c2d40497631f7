"""``scripts/topic`` on a network in another process."""

import array
import os
import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import Point32, Polygon
from parts.topic import as_yaml, main, rate_text
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.ros import topics
from rhs_isac_ros.tools.command import ToolError

SCRIPT = Path(__file__).parents[2] / 'scripts' / 'topic'
ARRAY = ros.RealArray(shape=array.array('I', [2, 2]), data=array.array('d', [1.0, -2.5, 0.0, 4.0]))


def test_list_prints_every_topic(output_of):
    names = set(output_of(main, 'list').split())
    assert {f'/{name}' for name in topics.NAMES.values()} <= names
    typed = output_of(main, 'list', '-t').splitlines()
    assert '/capacity [rhs_isac_msgs/msg/Capacity]' in typed
    assert not any('/_' in line for line in typed)


def test_info_counts_publishers_and_subscriptions(output_of):
    text = output_of(main, 'info', 'received_signals')
    assert text == ('Type: rhs_isac_msgs/msg/ReceivedSignals\nPublisher count: 1\n'
                    'Subscription count: 1\n')
    verbose = output_of(main, 'info', '-v', '/codebook')
    assert 'Node name: optimizer\n' in verbose
    assert verbose.count('Endpoint type: SUBSCRIPTION') == 4


def test_echo_prints_documents(output_of):
    text = output_of(main, 'echo', '--once', 'capacity')
    assert text.endswith('\n---\n')
    (content,) = filter(None, yaml.safe_load_all(text))
    assert list(content)[:6] == [
        'header', 'cycle_id', 'sender', 'scenario_id', 'user', 'codebook_id']
    assert content['actual_bps'] > 0


def test_echo_receives_latched_messages(output_of):
    text = output_of(main, 'echo', '--once', 'codebook', '--full-length')
    assert len(yaml.safe_load(text.removesuffix('---\n'))['analog']['data']) == 216


def test_echo_receives_the_message_of_a_late_publisher_that_latches_it(
        shared_session, output_of):
    """The topic is known from a volatile subscription and publisher."""
    node = shared_session.node
    node.create_subscription(Header, 'late', lambda message: None, 1)
    node.create_publisher(Header, 'late', 1)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def appear():
        timer.cancel()
        publisher = node.create_publisher(Header, 'late', latched)
        publisher.publish(Header(frame_id='last'))
    timer = node.create_timer(0.5, appear)
    assert output_of(main, 'echo', '--once', '--field', 'frame_id', 'late', '--timeout', '30') == (
        'last\n---\n')


def test_a_message_that_several_subscriptions_receive_is_printed_once(
        shared_session, call, monkeypatch):
    node, printed, n_ticks, is_sent = shared_session.node, [], 0, False
    monkeypatch.setattr('parts.topic.print_now', printed.append)
    publishers = [node.create_publisher(Header, 'mixed', QoSProfile(depth=1, durability=one))
                  for one in (DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE)]

    def publish():
        nonlocal n_ticks, is_sent
        # The volatile subscription receives from both publishers.
        if not is_sent and [one.get_subscription_count() for one in publishers] == [2, 1]:
            is_sent = True
            for publisher in publishers:
                publisher.publish(Header(frame_id='both'))
        n_ticks += len(printed) >= 2
        if n_ticks > 5:
            raise ToolError('enough')
    timer = node.create_timer(0.1, publish)
    assert call(main, 'echo', '--field', 'frame_id', 'mixed', '--timeout', '60')[1:] == (
        'enough\n', 1)
    node.destroy_timer(timer)
    assert printed == 2 * ['both\n---']


def test_echo_of_a_field(output_of):
    point = yaml.safe_load(output_of(
        main, 'echo', '--once', '--field', 'position', 'ground_truth').removesuffix('---\n'))
    assert set(point) == {'x', 'y', 'z'}
    assert float(output_of(main, 'echo', '--once', '--field', 'position.x', 'ground_truth')
                 .removesuffix('---\n')) > 0


def test_echo_and_info_name_the_error(call):
    out, err, code = call(main, 'echo', 'nothing', '--spin-time', '0.1')
    assert code == 1
    assert out == 'WARNING: topic [nothing] does not appear to be published yet\n'
    assert err == 'Could not determine the type for the passed topic\n'
    _, err, code = call(main, 'echo', 'ground_truth', '--field', 'position.q')
    assert (code, err) == (
        1, "Invalid field 'position.q': 'Point' object has no attribute 'q'\n")
    assert call(main, 'echo', 'a//b')[2] == 1
    _, err, code = call(main, 'info', 'nothing', '--spin-time', '0.1')
    assert (code, err) == (1, "Unknown topic 'nothing'\n")


def test_echo_exits_after_its_timeout(call):
    assert call(main, 'echo', 'no_fix', '--timeout', '0.2')[2] == 0


def test_hz_reports_until_it_is_interrupted(built_scripts, shared_session):
    with subprocess.Popen([SCRIPT, 'hz', 'ground_truth'], stdout=subprocess.PIPE, text=True,
                          env=os.environ) as process:
        report = process.stdout.readline() + process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    found = re.fullmatch(r'average rate: ([\d.]+)\n\tmin: ([\d.]+)s max: ([\d.]+)s '
                         r'std dev: [\d.]+s window: \d+\n', report)
    # How long a cycle takes depends on the machine.
    rate_hz, shortest_s, longest_s = map(float, found.groups())
    assert rate_hz * shortest_s <= 1.01 and rate_hz * longest_s >= 0.99


def test_topic_exits_when_the_reader_closes_the_pipe(run_script):
    assert run_script('scripts/topic echo ground_truth | head -n 2') == 'header:\n  stamp:\n'


@pytest.mark.parametrize(('message', 'max_length', 'text'), [
    (ARRAY, None, 'shape:\n- 2\n- 2\ndata:\n- 1.0\n- -2.5\n- 0.0\n- 4.0\n'),
    (ARRAY, 2, "shape:\n- 2\n- 2\ndata:\n- 1.0\n- -2.5\n- '...'\n"),
    (ros.RealArray(), None, 'shape: []\ndata: []\n'),
    (Header(frame_id='somewhere'), 4, 'stamp:\n  sec: 0\n  nanosec: 0\nframe_id: some...\n'),
    (Polygon(points=[Point32(x=1.0), Point32(y=2.0)]), None,
     'points:\n- x: 1.0\n  y: 0.0\n  z: 0.0\n- x: 0.0\n  y: 2.0\n  z: 0.0\n')])
def test_messages_are_printed_as_yaml(message, max_length, text):
    assert as_yaml(message, max_length) == text


def test_arrays_of_numpy_are_lists():
    content = yaml.safe_load(as_yaml(ros.PositionEstimate(covariance_m2=np.arange(9.0))))
    assert content['covariance_m2'] == list(map(float, range(9)))


def test_a_rate_is_printed_as_by_ros2():
    assert rate_text([10**9, 1250 * 10**6, 1750 * 10**6]) == (
        'average rate: 2.667\n\tmin: 0.250s max: 0.500s std dev: 0.12500s window: 2')
    assert rate_text([5, 5]).startswith('average rate: 0.000')
