"""The optimizer as a command, which optimises and holds a codebook or pushes it to a network."""

import pytest

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.nodes.optimizer import PushError, push
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import LATCHED
from rhs_isac_ros.ros.session import Session


@pytest.fixture(scope='module')
def output(tmp_path_factory):
    return tmp_path_factory.mktemp('optimised') / 'first.yaml'


@pytest.fixture(scope='module')
def network(make_watch, module_processes, small_files, output):
    """A command that has optimised a codebook, its observer and the ids of its codebooks."""
    process = module_processes.start('optimizer', namespace='/push', options=(
        '--method', 'directional', '--positions', '8', '--quiet', '--output', output,
        '--scenario', small_files / 'scenario.yaml'))
    watch, ids, frames = make_watch('/push'), [], []

    def receive(message):
        ids.append(message.codebook_id)
        frames.append(message.header.frame_id)
    watch.node.create_subscription(ros.Codebook, topics.CODEBOOK, receive, LATCHED)
    watch.until(lambda: ids, 'the codebook', [process])
    assert frames[0] == 'push/rhs_link'
    return process, watch, ids


def call(processes, network, *options):
    process = processes.start('optimizer', namespace='/push', options=options)
    network[1].until(lambda: not process.running, 'the end of the command', [network[0]])
    return process.wait(), process.log


def test_with_options_the_command_optimises_writes_and_holds(network, output):
    assert network[2][0] == Codebook.load(output).id


def test_a_file_is_pushed_to_a_running_network(processes, network, small_files):
    _, watch, ids = network
    wanted = Codebook.load(small_files / 'second.yaml').id
    code, log = call(processes, network, '--push-file', small_files / 'second.yaml')
    assert code == 0, log
    assert f'codebook {wanted} is set' in log
    watch.until(lambda: ids[-1] == wanted, 'the new codebook')


def test_an_optimised_codebook_is_pushed_and_the_command_ends(
        processes, network, small_files, tmp_path):
    _, watch, ids = network
    output = tmp_path / 'new.yaml'
    code, log = call(processes, network, '--push', '--method', 'lbfgs', '--steps', '3', '--quiet',
                     '--positions', '16', '--scenario', small_files / 'scenario.yaml',
                     '--output', output)
    assert code == 0, log
    watch.until(lambda: ids[-1] == Codebook.load(output).id, 'the new codebook')


def test_a_codebook_of_another_scenario_is_rejected(
        processes, network, table1, tmp_path):
    process, _, ids = network
    before = ids[-1]
    table1.codebook.save(tmp_path / 'large.yaml')
    code, log = call(processes, network, '--push-file', tmp_path / 'large.yaml')
    assert code == 1, log
    assert 'optimizer: error: /push/optimizer: codebook rejected: analog: shape' in log
    assert ids[-1] == before
    assert process.running


def test_the_error_names_a_missing_optimizer(small_files):
    with Session(['', '--ros-args', '-r', '__ns:=/nobody']) as session, pytest.raises(
            PushError, match='^/nobody/optimizer: not found within 0.2 s'):
        push(session, Codebook.load(small_files / 'first.yaml'), timeout_s=0.2)
