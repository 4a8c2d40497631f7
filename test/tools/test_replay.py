"""``scripts/record`` and ``scripts/replay`` on a network in another process."""

import dataclasses
import itertools
import os
import re
import runpy
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rclpy.node import Node
from ros_messages import from_ros

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.library import Library, Plan
from rhs_isac_ros.model import Pose, Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import EXCHANGE, OBSERVATION
from rhs_isac_ros.ros.recording import read
from rhs_isac_ros.support import plugins
from rhs_isac_ros.tools import republish
from rhs_isac_ros.tools.replay import alone, load, locate, main, tracked

pytest.importorskip('mcap', reason='mcap is not installed')
CONFIG = Path(__file__).parents[2] / 'config'
SCRIPTS = CONFIG.parent / 'scripts'
SCENARIO = Scenario.from_yaml(CONFIG / 'quick.yaml')
N_MANY = EXCHANGE.depth + 22


def rows(text):
    """Return median, root mean square and number of missing fixes by row."""
    number, _, *lines = text.splitlines()
    assert number.endswith(' cycles')
    pairs = (re.split('  +', line, maxsplit=1) for line in lines)
    return {name: cells.split() for name, cells in pairs}


def test_the_recording_contains_the_cycles_observed_live(run):
    """And perhaps one that the observer did not see whole."""
    recording = load(run.path)
    errors_m = dict(zip(
        recording.truths, recording.errors_m(recording.live()).tolist(), strict=True))
    assert {(cycle.cycle_id, cycle.user): cycle.error_m for cycle in run.cycles}.items() <= (
        errors_m.items())
    assert recording.scenarios == {'': Scenario.from_yaml(CONFIG / 'quick.yaml')}
    shipped = Codebook.load(CONFIG / 'codebook_quick.yaml')
    codebooks = recording.logs[''].codebooks
    assert list(codebooks) == [shipped.id] == [codebook.id for codebook in codebooks.values()]


def filtered(path, keep, namespaces=('',), time_of=lambda time_ns: time_ns,
             content=lambda topic, data: data):
    """Copy the messages of a recording that a function of topic and content selects.

    The copy contains them once for each namespace, one after the other, at other times.
    """
    from mcap.reader import make_reader
    from mcap.writer import Writer
    copy, channels = path.with_name('filtered.mcap'), {}
    with path.open('rb') as source, copy.open('wb') as target:
        writer = Writer(target)
        writer.start()
        for namespace, (about, channel, message) in itertools.product(
                namespaces, make_reader(source).iter_messages()):
            topic = f'{namespace}{channel.topic}'
            if keep(topic, message.data):
                if topic not in channels:
                    channels[topic] = writer.register_channel(
                        topic, 'cdr', writer.register_schema(about.name, '', b''))
                writer.add_message(
                    channels[topic], time_of(message.log_time), content(topic, message.data), 0)
        writer.finish()
    return copy


@pytest.mark.parametrize('copy', ['converted', 'merged'])
def test_a_copy_by_another_program_has_the_same_table(run, capsys, tmp_path, copy):
    """With definitions in other words, and no scenario; or with messages of two networks."""
    if copy == 'converted':
        pytest.importorskip('rosbags', reason='there is no rosbags here')
        subprocess.run(
            [Path(sys.executable).with_name('rosbags-convert'), '--src', run.path, '--dst',
             tmp_path / 'copy', '--dst-storage', 'mcap'], check=True, timeout=240)
        path = tmp_path / 'copy' / 'copy.mcap'
    else:
        path = filtered(run.path, lambda *_: True, ('', '/other'))
    tables = []
    for arguments in ([run.path], [path, '--config', CONFIG / 'quick.yaml'],
                      [path, '--config', CONFIG / 'quick.yaml', '--namespace', '/other']):
        if copy == 'merged' or '--namespace' not in arguments:
            assert main([*map(str, arguments)]) == 0
            tables.append(capsys.readouterr().out)
    assert len({*tables}) == 1


def test_codebooks_of_a_library_are_read_from_its_file(run, capsys, tmp_path):
    scenario = Scenario.from_yaml(CONFIG / 'quick.yaml')
    codebook = Codebook.load(CONFIG / 'codebook_quick.yaml', scenario)
    plan = Plan(scenario.unplaced.id, codebook.id, 'error', (1.0,), (100.0,))
    Library.of(plan, plan.cells(scenario), [codebook]).save(tmp_path / 'library.npz')
    path = filtered(run.path, lambda topic, _: topic != '/codebook')
    arguments = [str(path), '--config', str(CONFIG / 'quick.yaml')]
    assert main(arguments) == 2
    assert 'not in the recording; give its file' in capsys.readouterr().err
    tables = []
    for more in ([str(run.path)], [*arguments, '--library', str(tmp_path / 'library.npz')]):
        assert main(more) == 0
        tables.append(capsys.readouterr().out)
    assert tables[0] == tables[1]


@pytest.mark.parametrize('time_of', [
    lambda time_ns, middle_ns: time_ns - 10**12 * (time_ns > middle_ns), min],
    ids=['goes back', 'stands still'])
def test_the_clock_of_a_recording_does_not_matter(run, capsys, time_of):
    times_ns = [int(1e9 * time_s) for *_, time_s in read(run.path, ['/received_signals'])]
    path = filtered(run.path, lambda *_: True, time_of=lambda time_ns: time_of(
        time_ns, times_ns[len(times_ns) // 2]))
    tables = []
    for file in (run.path, path):
        assert main([str(file), '--config', str(CONFIG / 'quick.yaml'), '--track']) == 0
        tables.append(capsys.readouterr().out)
    assert tables[0] == tables[1]


def test_cycles_that_had_no_fix_live_count_for_every_estimator(run, capsys):
    """All but the first, here; the last one has not ended if the base station reports no end.

    The recorder has missed the answer to a first one that was served without an estimate.
    """
    outcomes = {(state.cycle_id, state.user) for state in (
        convert.from_bytes(m.ProtocolState, data) for _, data, _ in read(
            run.path, ['/protocol_state'])) if state.outcome}
    # A busy recorder also misses the ends of the first cycles, which have estimates.
    first, *lost = ended = [key for key in load(run.path).truths if key in outcomes]
    kinds = {f'/{topics.NAMES[kind]}': kind
             for kind in (m.ReceivedSignals, m.PositionEstimate, m.ProtocolState)}

    def keep(topic, data):
        if topic not in kinds:
            return topic != '/capacity'
        message = convert.from_bytes(kinds[topic], data)
        # The network may have been stopped in a further cycle.
        return isinstance(message, m.ProtocolState) or (message.cycle_id, message.user) in (
            [first] if isinstance(message, m.PositionEstimate) else ended)

    def failed(topic, data):
        if topic != '/protocol_state':
            return data
        message = convert.from_bytes(m.ProtocolState, data)
        is_lost = message.outcome and (message.cycle_id, message.user) in lost[1:]
        return convert.to_bytes(
            dataclasses.replace(message, outcome='no_fix'), message.stamp_ns) if is_lost else data
    for dropped, located, n_cycles in (
            ((), 1, 1 + len(lost)), (('/protocol_state',), 1, len(lost)),
            (('/position_estimate',), 0, len(lost) - 1)):
        path = filtered(run.path, lambda topic, data, dropped=dropped: (
            keep(topic, data) and topic not in dropped), content=failed)
        assert main([str(path), '--config', str(CONFIG / 'quick.yaml')]) == 0
        number, _, live, bayes = capsys.readouterr().out.splitlines()
        assert number == f'{n_cycles} cycles'
        assert (live.split()[-1], bayes.split()[-1]) == (str(n_cycles - located), '0')


@pytest.fixture
def replayed(run, capsys):
    """Function that replays the recording with arguments, and returns the rows and the errors."""
    def call(*arguments):
        assert main([str(run.path), *map(str, arguments)]) == 0
        out, err = capsys.readouterr()
        return rows(out), err
    return call


def test_the_same_estimator_has_the_same_errors(run, replayed):
    """All printed digits agree; those of another estimator differ."""
    found, _ = replayed('--estimator', 'bayes', '--estimator', 'ml')
    recording = load(run.path)
    live = recording.errors_m(recording.live())
    assert found['bayes'] == found['live bayes'] != found['ml']
    assert found['live bayes'] == [
        f'{np.median(live):.6f}', 'm', f'{np.sqrt(np.mean(live**2)):.6f}', 'm', '0']


def test_an_example_reads_a_recording_without_messages_of_ros(run, monkeypatch, capsys):
    pytest.importorskip('mcap_ros2.decoder', reason='there is no mcap_ros2 here')
    log = load(run.path).logs['']
    estimator = make_estimator('ml', SCENARIO, *log.codebooks.values())
    errors_m = [np.linalg.norm(estimator.estimate(signals.stacked).mean - truth.position)
                for signals in log.signals.values() if (truth := log.truths.of(signals))]
    monkeypatch.setattr(sys, 'argv', ['', str(run.path), 'ml'])
    runpy.run_path(str(CONFIG.parent / 'docs' / 'examples' / 'read_recording.py'))
    assert capsys.readouterr().out == (
        f'{len(errors_m)} cycles, median error {np.median(errors_m):.6f} m\n')


def test_errors_do_not_depend_on_the_pose_of_the_surface(run):
    recording = load(run.path)
    errors_m = []
    for pose in (Pose(), Pose((1, 2, 3), (0, 0, 1, 1))):
        placed = dataclasses.replace(recording.scenarios[''], pose=pose)
        recording.scenarios = {'': placed}
        found = locate(recording, alone({
            key: make_estimator('ml', placed, codebook).estimate
            for key, codebook in recording.logs[''].codebooks.items()}))
        errors_m.append([np.linalg.norm(found[key] - pose.to_site(truth))
                         for key, truth in recording.truths.items()])
    np.testing.assert_allclose(*errors_m, rtol=1e-9)


def test_users_are_tracked_beside_single_cycles(run, replayed):
    """The first estimate of each user is that of a single cycle; later ones differ."""
    recording = load(run.path)
    estimators = {key: make_estimator('bayes', recording.scenarios[''], codebook)
                  for key, codebook in recording.logs[''].codebooks.items()}
    single = locate(recording, alone({key: one.estimate for key, one in estimators.items()}))
    states = locate(recording, tracked(estimators, 1.0))
    single_m, errors_m, velocities = recording.errors_m(single), recording.errors_m(
        states), recording.velocity_errors_mps(states)
    # Single cycles have no velocity.
    assert len(velocities) == np.isfinite(errors_m).sum()
    assert not recording.velocity_errors_mps(single).size
    users = [user for _, user in recording.truths]
    first = [users.index(user) for user in set(users)]
    assert len(first) < len(users)
    np.testing.assert_array_equal(np.delete(errors_m != single_m, first), True)
    np.testing.assert_array_equal(errors_m[first], single_m[first])
    found, _ = replayed('--track')
    assert found['track'] == [
        f'{np.median(errors_m):.6f}', 'm', f'{np.sqrt(np.mean(errors_m**2)):.6f}', 'm', '0',
        f'{np.sqrt(np.mean(velocities**2)):.6f}', 'm/s']


PLUGIN = '''
import dataclasses

from rhs_isac_ros.positioning import BayesEstimator

class Mine(BayesEstimator):
    def __init__(self, system, *, scale=1.0, reject_outside=False):
        super().__init__(system, reject_outside=reject_outside)
        self._times = scale

    def estimate(self, received):
        found = super().estimate(received)
        return dataclasses.replace(found, mean=self._times * found.mean)
'''


def test_an_estimator_of_a_plugin_is_available_with_its_options(replayed, install):
    install('guesses', PLUGIN, {plugins.ESTIMATORS: {'mine': 'Mine'}})
    found, _ = replayed('--estimator', 'mine')
    assert found['mine'] == found['live bayes']
    found, _ = replayed('--estimator', 'mine', '--estimator-options', 'scale=2')
    assert float(found['mine'][0]) > 2.0 > float(found['live bayes'][0])


def test_another_codebook_is_assumed_with_a_warning(replayed, random_beams, tmp_path):
    other = random_beams(Scenario.from_yaml(CONFIG / 'quick.yaml'), np.random.default_rng(0))
    other.save(tmp_path / 'other.yaml')
    found, err = replayed('--codebook', tmp_path / 'other.yaml')
    assert found['bayes'] != found['live bayes']
    assert err.endswith(f'are evaluated with {other.id}\n')


@pytest.mark.parametrize('arguments, error', [
    (['--namespace', '/lab'], 'a true position in the namespace /lab; --namespace selects one '
     'of /'),
    (['--codebook', CONFIG / 'codebook.yaml'], 'analog: shape'),
    (['--config', CONFIG / 'table1.yaml'], 'shape'),
    (['--estimator', 'neural'], 'model'),
    (['--publish', '--namespace', '/lab'],
     'no received_signals in the namespace /lab; --namespace selects one of /'),
    (['--publish', '--codebook', CONFIG / 'codebook.yaml'], 'running nodes would drop them'),
    (['--publish', '--config', CONFIG / 'table1.yaml'], 'analog: shape (2, 3, 36), expected'),
])
def test_a_mismatch_is_named(run, capsys, arguments, error):
    assert main([str(run.path), *map(str, arguments)]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith('replay: error: ')
    assert error in line


def estimates_of(path):
    """Return the estimates of a recording by cycle, without their latencies."""
    estimates = (convert.from_bytes(m.PositionEstimate, found)
                 for _, found, _ in read(path, ['/position_estimate']))
    return {estimate.cycle_id: content(estimate) for estimate in estimates}


def content(plain):
    return (plain.user, plain.codebook_id, plain.position.tobytes(),
            plain.covariance_m2.tobytes(), plain.crlb_m2, plain.estimator)


@pytest.fixture(scope='module')
def positioner(module_processes):
    """A positioner, alone in its namespace."""
    return module_processes.start(
        'positioner', namespace='/again', scenario_file=CONFIG / 'quick.yaml')


@pytest.fixture
def received(built_scripts, shared_session, positioner):
    """The contents of the estimates of the positioner by cycle."""
    found = {}
    subscription = shared_session.node.create_subscription(
        convert.ros_type(m.PositionEstimate), '/again/position_estimate',
        lambda message: found.update({
            message.cycle_id: content(from_ros(m.PositionEstimate, message))}), OBSERVATION)
    # The replay awaits the positioner, but not this observer.
    assert shared_session.spin_until(lambda: subscription.get_publisher_count() > 0, 60)
    yield found
    shared_session.node.destroy_subscription(subscription)


def publishing(path, *arguments, namespace='/again'):
    return subprocess.Popen(
        [SCRIPTS / 'replay', path, '--publish', *arguments, '--ros-args', '-r',
         f'__ns:={namespace}'], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture
def publish(shared_session, received):
    """Function that publishes a recording at a rate until a number of cycles is answered."""
    def call(path, rate, n_cycles):
        with publishing(path, '--rate', rate) as process:
            complete = shared_session.spin_until(lambda: len(received) >= n_cycles, 60)
            out, err = process.communicate(timeout=240)
        assert process.returncode == 0, err
        assert complete
        return out
    return call


def test_a_running_positioner_reproduces_the_recorded_estimates(run, received, publish):
    """The estimates agree bit for bit; the codebook is published with the signals."""
    # A cycle that was repeated has its signals twice.
    signals = [convert.from_bytes(m.ReceivedSignals, found).cycle_id
               for _, found, _ in read(run.path, ['/received_signals'])]
    assert publish(run.path, '20', len(set(signals))) == f'{len(signals)} messages published\n'
    recorded = estimates_of(run.path)
    both = recorded.keys() & received.keys()
    assert both >= {cycle.cycle_id for cycle in run.cycles}
    assert {cycle: received[cycle] for cycle in both} == {cycle: recorded[cycle] for cycle in both}


@pytest.fixture
def many(write_recording, tmp_path):
    """A recording with more signals than the queue of a subscription holds."""
    codebook = Codebook.load(CONFIG / 'codebook_quick.yaml')
    center = np.array([SCENARIO.roi_center_m])
    received = simulate_received(SCENARIO, codebook, center, np.random.default_rng(0))
    signals = m.ReceivedSignals(
        cycle_id=1, scenario_id=SCENARIO.id, user=1, codebook_id=codebook.id,
        signals=received.reshape(SCENARIO.n_bands, SCENARIO.n_subbands, SCENARIO.n_frames))
    return write_recording(tmp_path / 'many.mcap', [
        convert.CodebookMessage.of(codebook), *(
            dataclasses.replace(signals, cycle_id=number) for number in range(1, N_MANY + 1))])


def test_no_signals_are_lost_at_any_rate(many, publish):
    assert publish(many, '100000', N_MANY) == f'{N_MANY} messages published\n'


def test_signals_that_nobody_answers_are_counted(many, bench):
    """A subscriber that publishes no estimates has the place of the positioner."""
    probe = bench.add(Node, 'probe', namespace='/silent')
    signals = []
    probe.create_subscription(
        convert.ros_type(m.ReceivedSignals), 'received_signals', signals.append, OBSERVATION)
    probe.create_publisher(convert.ros_type(m.PositionEstimate), 'position_estimate', EXCHANGE)
    with publishing(many, '--rate', '100000', '--timeout', '10', namespace='/silent') as process:
        # The rest would take a minute.
        bench.until(lambda: process.poll() is not None or len(
            {message.cycle_id for message in signals}) > 1, 'the signals')
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=240)
    assert process.returncode == 1, err
    assert re.fullmatch(r'replay: error: [0-9]+ signals without position_estimate or no_fix',
                        err.splitlines()[-1])


@pytest.mark.parametrize(('times_s', 'due_s', 'lines'), [
    ([5, 6, 8.5], [0, 1, 3.5], []),
    ([5, 3605, 3606], [0, 1, 2], ['a pause of 3600 s']),
    ([0, 100, 101, 201], [0, 1, 2, 3], ['a pause of 100 s', 'a pause of 100 s'])])
def test_gaps_of_a_recording_are_shortened_and_printed(times_s, due_s, lines, capsys):
    messages = [('codebook', b'', -1e6), *(('ack', b'', time_s) for time_s in times_s)]
    found = list(republish._without_gaps(messages))
    assert [time_s for _, _, time_s in found] == [0, *due_s]
    assert [line.removeprefix('replay: ').partition(' in the')[0]
            for line in capsys.readouterr().err.splitlines()] == lines


def test_topics_of_a_running_network_are_not_published(built_scripts, run, shared_session):
    """The low rate leaves time to discover the other publisher however slow discovery is."""
    done = subprocess.run(
        [SCRIPTS / 'replay', run.path, '--publish', '--rate', '0.001'], capture_output=True,
        text=True, timeout=240, check=False)
    assert (done.returncode, done.stdout) == (1, '')
    assert done.stderr.splitlines()[-1] == (
        'replay: error: received_signals: already published by another node')


def test_record_writes_all_topics_until_it_is_interrupted(
        built_scripts, shared_session, tmp_path):
    path = tmp_path / 'all.mcap'
    wanted = {'codebook', 'capacity', 'pilot', 'ground_truth', 'position'}
    with subprocess.Popen(
            [SCRIPTS / 'record', path, '--config', CONFIG / 'quick.yaml'], env=os.environ,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        missing = set(wanted)
        while missing:
            line = process.stderr.readline()
            assert line, f'no messages of {missing}'
            missing.discard(line.rpartition('first message of ')[2].strip())
        # The signal of a terminal that is closed.
        process.send_signal(signal.SIGHUP)
        out, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    messages = list(read(path))
    assert out == f'{len(messages)} messages in {path}\n'
    assert {f'/{name}' for name in wanted} <= {topic for topic, _, _ in messages}
    with pytest.raises(FileNotFoundError):
        path.with_name('all.mcap.part').stat()
