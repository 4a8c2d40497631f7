"""``scripts/topic`` on a network in another process."""

import os
import re
import signal
import subprocess
from pathlib import Path

import yaml

from rhs_isac_ros.ros import topics
from rhs_isac_ros.tools.topic import main

SCRIPT = Path(__file__).parents[2] / 'scripts' / 'topic'


def test_list_prints_every_topic(output_of):
    names = set(output_of(main, 'list').split())
    assert {f'/{name}' for name in topics.NAMES.values()} <= names
    typed = output_of(main, 'list', '-t').splitlines()
    assert '/capacity [rhs_isac_msgs/msg/Capacity]' in typed
    assert int(output_of(main, 'list', '-c')) == len(typed)
    counted = output_of(main, 'list', '-v')
    published, subscribed = counted.split('Subscribed topics:')
    assert published.startswith('Published topics:\n * /ack [rhs_isac_msgs/msg/Ack] 2 publishers')
    assert ' * /ack [rhs_isac_msgs/msg/Ack] 1 subscriber\n' in subscribed
    assert '/capacity ' not in subscribed


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
    text = output_of(main, 'echo', '--once', 'codebook', '--no-arr')
    assert "data: '<sequence type: double, length: 216>'" in text


def test_echo_of_a_field_and_as_csv(output_of):
    point = yaml.safe_load(output_of(
        main, 'echo', '--once', '--field', 'position', 'ground_truth').removesuffix('---\n'))
    assert set(point) == {'x', 'y', 'z'}
    assert float(output_of(main, 'echo', '--once', '--field', 'position.x', 'ground_truth')
                 .removesuffix('---\n')) > 0
    line = output_of(
        main, 'echo', '--once', '--csv', 'ground_truth', 'rhs_isac_msgs/msg/GroundTruth')
    assert len(line.strip().split(',')) == 13


def test_echo_and_info_name_the_error(call):
    out, err, code = call(main, 'echo', 'nothing', '--spin-time', '0.1')
    assert code == 1
    assert out == 'WARNING: topic [nothing] does not appear to be published yet\n'
    assert err == 'Could not determine the type for the passed topic\n'
    _, err, code = call(main, 'echo', 'ground_truth', '--field', 'position.q')
    assert (code, err) == (
        1, "Invalid field 'position.q': 'Point' object has no attribute 'q'\n")
    for kind in ('std_msgs/String', 'std_msgs/msg/Nothing', 'none_msgs/msg/String'):
        _, err, code = call(main, 'echo', 'ground_truth', kind)
        assert (code, err) == (1, f"The message type '{kind}' is invalid\n")
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
    found = re.fullmatch(r'average rate: ([\d.]+)\n\tmin: [\d.]+s max: [\d.]+s '
                         r'std dev: [\d.]+s window: \d+\n', report)
    assert float(found[1]) > 1


def test_topic_exits_when_the_reader_closes_the_pipe(run_script):
    assert run_script('scripts/topic echo ground_truth | head -n 2') == 'header:\n  stamp:\n'
