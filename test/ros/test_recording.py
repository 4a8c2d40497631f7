"""Recordings, read back by the package and by independent decoders."""

import array
import importlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time
from rclpy.duration import Infinite
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.serialization import deserialize_message
from ros_messages import from_ros, to_ros

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.transmission import TransmissionNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.presences import Presence
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.endpoints import ACKS, EXCHANGE
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.recording import (
    Recorder,
    RecordingError,
    _offered_qos,
    read,
    read_networks,
    recorded_topics,
    type_name,
)

pytest.importorskip('mcap', reason='there is no mcap here')
READERS = Path(__file__).parents[2] / 'build' / 'readers'


def received(cycle_id):
    return ros.ReceivedSignals(
        cycle_id=cycle_id, user=2, codebook_id='cb1', signals=ros.ComplexArray(
            shape=array.array('I', [1, 1, 3]), re=array.array('d', [1.0, -2.5, cycle_id]),
            im=array.array('d', [0.25, 0.0, 1e-30])))


@pytest.fixture
def recording(bench, probe, tmp_path):
    """A recording of three messages of two types, and the messages."""
    recorder = Recorder(tmp_path / 'run.mcap', Scenario(n_frames=2))
    recorder.record_topics(probe)
    sent = [received(1), ros.PositionEstimate(cycle_id=1, covariance_m2=np.arange(9.0)),
            received(2)]
    publishers = {ros.ReceivedSignals: 'received_signals',
                  ros.PositionEstimate: 'position_estimate'}
    publishers = {kind: probe.create_publisher(kind, name, EXCHANGE)
                  for kind, name in publishers.items()}
    for publisher in publishers.values():
        bench.until(publisher.get_subscription_count, 'the recorder')
    for number, message in enumerate(sent, 1):
        publishers[type(message)].publish(message)
        bench.until(lambda number=number: recorder.count >= number, 'the message')
    path = tmp_path / 'run.mcap'
    assert not path.exists()
    recorder.close()
    recorder.close()
    assert [file.name for file in tmp_path.iterdir()] == ['run.mcap']
    return path, sent


def test_messages_are_read_back(recording):
    path, sent = recording
    found = list(read(path))
    assert [deserialize_message(content, type(message)) for (_, content, _), message in zip(
        found, sent, strict=True)] == sent
    assert [topic for topic, _, _ in found] == [
        '/received_signals', '/position_estimate', '/received_signals']
    assert read_networks(path).scenario == Scenario(n_frames=2)


def test_the_times_are_those_of_the_middleware_however_late_the_callback_is(
        bench, probe, tmp_path, monkeypatch):
    """Those of the messages in the file, and those with which an observer logs cycles."""
    from mcap.reader import make_reader
    times_s = []
    monkeypatch.setattr(CycleObserver, 'observe', lambda *arguments: times_s.append(arguments[-1]))
    recorder = Recorder(tmp_path / 'run.mcap', Scenario())
    bench.add(CycleObserver, recorder)
    publisher = probe.create_publisher(ros.Beacon, 'beacon', EXCHANGE)
    bench.until(lambda: publisher.get_subscription_count() == 2, 'the recorder')
    begin_ns, begin_s = time.time_ns(), time.monotonic()
    publisher.publish(ros.Beacon(cycle_id=7))
    # Nobody spins meanwhile.
    time.sleep(0.5)
    late_ns, late_s = time.time_ns() - 10**8, time.monotonic() - 0.1
    bench.until(lambda: times_s and recorder.count, 'the message')
    recorder.close()
    with (tmp_path / 'run.mcap').open('rb') as stream:
        ((_, _, message),) = make_reader(stream).iter_messages()
    assert begin_ns < message.publish_time < message.log_time < late_ns
    assert begin_s - 1e-3 < times_s[0] < late_s


def test_messages_are_read_in_the_order_of_their_arrival(tmp_path):
    """Callbacks may be called in another order, and copies are often sorted."""
    from mcap.writer import Writer
    path = tmp_path / 'a.mcap'
    writer = Writer(str(path))
    writer.start()
    channel = writer.register_channel('/ack', 'cdr', writer.register_schema(
        'rhs_isac_msgs/msg/Ack', '', b''))
    for time_ns in (3, 1, 2, 1):
        writer.add_message(channel, time_ns * 10**9, bytes([time_ns]), 0)
    writer.finish()
    assert [(content, time_s) for _, content, time_s in read(path)] == [
        (b'\1', 1.0), (b'\1', 1.0), (b'\2', 2.0), (b'\3', 3.0)]


def write_metadata(folder, names):
    """Write what ``ros2 bag`` reads, as in version 1 and later, of which the fields differ."""
    (folder / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap', 'relative_file_paths': names}}))


def test_a_folder_of_ros2_bag_is_one_recording(tmp_path):
    """Options divide it into files, which number topics and types anew, or compress messages."""
    import zstandard
    from mcap.writer import Writer
    kinds = {'/ack': 'rhs_isac_msgs/msg/Ack', '/beacon': 'rhs_isac_msgs/msg/Beacon'}
    for number, names in enumerate((['/ack', '/beacon'], ['/beacon', '/ack'])):
        writer = Writer(str(tmp_path / f'lab_{number}.mcap'))
        writer.start()
        for name in names:
            channel = writer.register_channel(
                name, 'cdr', writer.register_schema(kinds[name], '', b''))
            content = name.encode()
            writer.add_message(channel, 10**9 * (2 - number), content if number else
                               zstandard.ZstdCompressor().compress(content), 0)
        writer.finish()
    for act in (lambda: list(read(tmp_path)), lambda: read_networks(tmp_path)):
        with pytest.raises(RecordingError, match='or a folder with metadata.yaml'):
            act()
    write_metadata(tmp_path, ['lab_0.mcap', 'lab_1.mcap'])
    assert [(name, time_s) for name, content, time_s in read(tmp_path)
            if name.encode() == content] == [
        ('/beacon', 1.0), ('/ack', 1.0), ('/ack', 2.0), ('/beacon', 2.0)]


@pytest.mark.parametrize('names', [['a.mcap'], ['lab/a.mcap']], ids=str)
def test_only_the_files_in_the_metadata_of_a_folder_are_read(recording, tmp_path, names):
    """Others may be copies, such as those that ``mcap recover`` or ``ros2 bag convert`` writes."""
    for name in ('a.mcap', 'a_recovered.mcap', 'b.mcap'):
        shutil.copy(recording[0], tmp_path / name)
    write_metadata(tmp_path, names)
    assert list(read(tmp_path)) == list(read(recording[0]))
    assert read_networks(tmp_path).scenario == read_networks(recording[0]).scenario


@pytest.mark.parametrize(('names', 'error'), [
    (['a.mcap', 'b.mcap'], 'b.mcap: cannot be read: No such file'),
    (['a.mcap.zstd'], 'which lists files .*mcap'), (['a.db3'], 'which lists files .*mcap'),
    ([], 'which lists files .*mcap'), ([1], 'which lists files .*mcap')], ids=str)
def test_the_error_names_what_a_folder_lacks(recording, tmp_path, names, error):
    shutil.copy(recording[0], tmp_path / 'a.mcap')
    write_metadata(tmp_path, names)
    with pytest.raises(RecordingError, match=error):
        list(read(tmp_path))


def test_a_recorder_replaces_no_file(tmp_path):
    path = tmp_path / 'run.mcap'
    recorder = Recorder(path, Scenario())
    with pytest.raises(RecordingError, match='run.mcap.part: cannot be written: File exists; a '
                                             'recorder that runs, or was killed, has the file'):
        Recorder(path, Scenario())
    path.write_text('other')
    recorder.close()
    assert 'File exists' in recorder.failure
    assert path.read_text() == 'other'
    assert read_networks(tmp_path / 'run.mcap.part').scenario == Scenario()
    with pytest.raises(RecordingError, match='run.mcap: cannot be written: File exists'):
        Recorder(path, Scenario())


def test_an_observer_logs_the_cycles_that_it_records(bench, probe, tmp_path):
    recorder = Recorder(tmp_path / 'run.mcap', Scenario())
    observer = bench.add(CycleObserver, recorder)
    beacon = probe.create_publisher(ros.Beacon, 'beacon', EXCHANGE)
    state = probe.create_publisher(ros.ProtocolState, 'protocol_state', EXCHANGE)
    signals = probe.create_publisher(ros.ReceivedSignals, 'received_signals', EXCHANGE)
    for publisher in (beacon, state, signals):
        bench.until(publisher.get_subscription_count, 'the recorder')
    beacon.publish(ros.Beacon(cycle_id=7))
    bench.until(lambda: recorder.count == 1)
    # A malformed message is recorded, but not logged.
    signals.publish(ros.ReceivedSignals(cycle_id=7, signals=ros.ComplexArray(
        shape=array.array('I', [2]))))
    bench.until(lambda: recorder.count == 2)
    state.publish(ros.ProtocolState(cycle_id=7, user=1, outcome='no_ack'))
    bench.until(lambda: observer.log.given_up and recorder.count == 3)
    assert observer.log.given_up[0].cycle_id == 7
    recorder.close()
    assert [topic for topic, _, _ in read(tmp_path / 'run.mcap')] == [
        '/beacon', '/received_signals', '/protocol_state']


@pytest.mark.parametrize('content', [b'', b'no recording at all', None], ids=str)
def test_the_error_names_a_file_that_is_not_a_recording(tmp_path, content):
    path = tmp_path / 'bad.mcap'
    if content is not None:
        path.write_bytes(content)
    for act in (lambda: list(read(path)), lambda: read_networks(path)):
        with pytest.raises(RecordingError, match=f'^{path}: '):
            act()


def test_a_recording_without_an_end_is_read_up_to_there(recording, capfd):
    path, _ = recording
    complete = list(read(path))
    path.write_bytes(path.read_bytes()[:-100])
    assert list(read(path)) == complete
    assert f'{path}: incomplete, because its writer did not close it' in capfd.readouterr().err
    path.write_bytes(path.read_bytes()[:5])
    with pytest.raises(RecordingError, match=f'^{path}: not a complete recording'):
        list(read(path))


def test_changed_bytes_cause_no_other_error(recording):
    path, _ = recording
    content, rng, errors = path.read_bytes(), np.random.default_rng(1), 0
    for _ in range(200):
        changed = bytearray(content)
        for place in rng.integers(len(content), size=2):
            changed[place] = rng.integers(256)
        path.write_bytes(changed)
        for act in (lambda: list(read(path)), lambda: read_networks(path)):
            try:
                act()
            except RecordingError as error:
                assert str(error).startswith(f'{path}: ')
                errors += 1
    assert errors > 50


@pytest.mark.parametrize('compression', ['ZSTD', 'LZ4', 'NONE'])
@pytest.mark.parametrize(('declared', 'reason'), [
    (None, 'a chunk of 100[0-9]{4} bytes, expected at most 500000'),
    (1000, 'CRCValidationError')])
def test_a_chunk_is_not_expanded_beyond_the_limit(
        tmp_path, monkeypatch, compression, declared, reason):
    from mcap import records, writer
    monkeypatch.setattr('rhs_isac_ros.ros.recording._MAX_BYTES', 500_000)
    write = records.Chunk.write

    def lie(chunk, builder):
        chunk.uncompressed_size = declared or chunk.uncompressed_size
        write(chunk, builder)
    monkeypatch.setattr(records.Chunk, 'write', lie)
    path = tmp_path / 'bomb.mcap'
    bomb = writer.Writer(str(path), compression=getattr(writer.CompressionType, compression))
    bomb.start()
    bomb.add_message(bomb.register_channel('/ack', 'cdr', 0), 0, bytes(1_000_000), 0)
    bomb.finish()
    if compression == 'NONE':
        reason = 'RecordLengthLimitExceeded'
    with pytest.raises(RecordingError, match=f'bomb.mcap: not a complete recording: .*{reason}'):
        list(read(path))


def test_a_message_without_a_topic_is_an_error(tmp_path):
    from mcap.writer import Writer
    writer = Writer(str(tmp_path / 'a.mcap'))
    writer.start()
    writer.add_message(7, 0, b'', 0)
    writer.finish()
    with pytest.raises(RecordingError, match='a.mcap: a message without a topic'):
        list(read(tmp_path / 'a.mcap'))


def test_a_scenario_of_another_version_is_an_error(tmp_path):
    class Other:
        def changes(self):
            return {'n_moons': 2}
    recorder = Recorder(tmp_path / 'run.mcap', Other())
    recorder.close()
    with pytest.raises(RecordingError, match='invalid scenario: .*n_moons'):
        read_networks(tmp_path / 'run.mcap')


@pytest.mark.parametrize(('text', 'reason'), [
    ('n_frames: [&a [1, 1], &b [*a, *a]]', 'it contains references'),
    (f'n_frames: [{2**19 * "1,"}]', 'it contains references, or is too long'),
    (10_000 * '[', 'nested more than 16 times')], ids=['references', 'long', 'nested'])
def test_a_scenario_that_would_occupy_the_process_is_an_error(
        tmp_path, monkeypatch, text, reason):
    monkeypatch.setattr(yaml, 'safe_dump', lambda changes: text)
    Recorder(tmp_path / 'run.mcap', Scenario()).close()
    with pytest.raises(RecordingError, match=f'run.mcap: invalid scenario: {reason}'):
        read_networks(tmp_path / 'run.mcap')


@pytest.mark.parametrize(('region', 'reason'), [
    (None, 'surfaces side, but no region'), ('[1, 2]', 'invalid region: '),
    ('[[a, b, c], [1, 2, 3]]', 'invalid region: '), ('[[&a 1, 2, 3], *a]', 'invalid region: ')])
def test_a_site_without_a_valid_region_is_an_error(tmp_path, region, reason):
    from mcap.writer import Writer
    path = tmp_path / 'site.mcap'
    writer = Writer(str(path))
    writer.start()
    writer.add_metadata('scenario', {'network': 'side', 'yaml': '{}'})
    if region:
        writer.add_metadata('region', {'yaml': region})
    writer.finish()
    with pytest.raises(RecordingError, match=f'^{path}: {reason}'):
        read_networks(path)


def rewritten(path, change, **options):
    """Copy a recording with another writer and with changed definitions; return the copy."""
    from mcap.reader import make_reader
    from mcap.writer import Writer
    copy, channels = path.with_name('copy.mcap'), {}
    with path.open('rb') as source, copy.open('wb') as target:
        writer = Writer(target, **options)
        writer.start('other', 'another writer')
        for about, channel, message in make_reader(source).iter_messages():
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, writer.register_schema(
                        about.name, about.encoding, change(about.data.decode()).encode()))
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return copy


# One message of each topic of a network of version 1.0.0, and a posterior of a later one, in which
# posteriors did not have the fields of `Places`.
EARLIER = Path(__file__).parents[1] / 'data' / 'earlier_versions.mcap'


def test_messages_of_earlier_versions_have_the_defaults_of_fields_that_have_come_since():
    kinds = {name: kind for kind, name in topics.NAMES.items()} | {
        'codebook': convert.CodebookMessage, 'presence': Presence}
    contents = {topic.removeprefix('/'): content for topic, content, _ in read(EARLIER)}
    # The network had no user outside, and its users were in nodes of their own.
    assert kinds.keys() - contents.keys() == {'no_fix', 'ground_truths'}
    found = {name: convert.from_bytes(kinds[name], one) for name, one in contents.items()}
    posterior, presence, estimate = (
        found[name] for name in ('posterior', 'presence', 'position_estimate'))
    assert (posterior.user, posterior.misfit_log_ratio, posterior.sheet_means.tolist()) == (
        2, -2.0, [[8.0, -0.25, 0.0]])
    assert (posterior.outside_means.shape, posterior.outside_range_m) == ((0, 3), 0.0)
    assert (presence.role, presence.use_sim_time, presence.library_id) == ('positioner', False, '')
    assert (estimate.estimator, estimate.next_codebook_id, estimate.next_codebook_s) == (
        'bayes', '', 0.0)
    assert estimate.position == pytest.approx([11.938, 1.588, 0.347], abs=1e-3)
    scenario = read_networks(EARLIER).scenario
    for name, message in found.items():
        if isinstance(message, m.Message):
            m.check(message, scenario)
        # They are whole messages, which may be published.
        whole = deserialize_message(contents[name], convert.ros_type(kinds[name]))
        assert convert.to_bytes(from_ros(kinds[name], whole), 0) == convert.to_bytes(message, 0)


@pytest.mark.parametrize(('old', 'new', 'owner'), [
    ('ComplexArray signals.*\n', '', 'ReceivedSignals'),
    (r'float64\[] im.*\n', '', 'ComplexArray'),
    ('(?s).*', '', 'ReceivedSignals'),
    ('uint64 sender.*\n', '', 'ReceivedSignals'),
    ('uint64 sender', 'int64 sender', 'ReceivedSignals'),
    (r'float64\[] im', 'float32[] im', 'ComplexArray')])
def test_a_recording_with_other_fields_is_an_error(recording, old, new, owner):
    """Such as one from before the messages had headers: its bytes would be misread."""
    copy = rewritten(recording[0], lambda text: re.sub(old, new, text))
    with pytest.raises(RecordingError, match=f'mcap: rhs_isac_msgs/{owner}: recorded with other'):
        list(read(copy))


@pytest.mark.parametrize('options', [
    {}, {'compression': 'LZ4'}, {'compression': 'NONE', 'use_chunking': False},
    {'index_types': 'NONE', 'use_statistics': False, 'use_summary_offsets': False,
     'repeat_channels': False, 'repeat_schemas': False, 'enable_crcs': False}], ids=str)
def test_a_copy_by_another_writer_contains_the_same_messages(recording, options):
    """Such as one that qualifies types, and drops comments, constants, defaults and spaces."""
    from mcap import writer

    def change(text):
        text = re.sub(r' *#.*|.*=[^=\n].*|(?<=_user) \d+$', '', text, flags=re.MULTILINE)
        text = re.sub(r'\b(\w+_msgs)/(?=[A-Z])', r'\1/msg/', text).replace('byte ', 'octet ')
        return re.sub(r'^(?=(Real|Complex)Array)', 'rhs_isac_msgs/msg/', text, flags=re.MULTILINE)
    enums = {'compression': writer.CompressionType, 'index_types': writer.IndexType}
    copy = rewritten(recording[0], change, **{
        key: enums[key][value] if key in enums else value for key, value in options.items()})
    assert list(read(copy)) == list(read(recording[0]))


def test_the_error_names_a_missing_folder(tmp_path):
    with pytest.raises(RecordingError, match='none/run.mcap.part: cannot be written: No such'):
        Recorder(tmp_path / 'none' / 'run.mcap', Scenario())


def test_the_error_names_the_missing_library(tmp_path, monkeypatch):
    for name in ('mcap.writer', 'mcap.stream_reader'):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(RecordingError, match=r'^recording needs mcap.*rhs_isac_ros\[recording\]'):
        Recorder(tmp_path / 'run.mcap', Scenario())
    with pytest.raises(RecordingError, match='^reading a recording needs mcap'):
        list(read(tmp_path / 'run.mcap'))
    assert not list(tmp_path.iterdir())


def filled(kind, rng):
    """Return a message with a random value in every field."""
    message = kind()
    for name, text in kind.get_fields_and_field_types().items():
        value = getattr(message, name)
        part = text.removeprefix('sequence<').removesuffix('>')
        if hasattr(value, 'get_fields_and_field_types'):
            setattr(message, name, filled(type(value), rng))
        elif '/' in part:
            package, short = part.split('/')
            module = importlib.import_module(f'{package}.msg')
            setattr(message, name, [filled(getattr(module, short), rng) for _ in range(2)])
        elif isinstance(value, np.ndarray):
            setattr(message, name, rng.normal(size=value.shape))
        elif isinstance(value, array.array):
            numbers = rng.normal(size=5) if value.typecode == 'd' else rng.integers(1000, size=5)
            setattr(message, name, array.array(value.typecode, numbers.tolist()))
        else:
            made = {str: lambda: f'é{rng.integers(1000)}', float: rng.normal,
                    bool: lambda: bool(rng.integers(2)),
                    bytes: lambda: bytes([rng.integers(3)]),
                    int: lambda: int(rng.integers(1, 100))}
            setattr(message, name, made[type(value)]())
    return message


def agree(ours, theirs):
    """Return whether two messages of different libraries have the same fields and values."""
    if hasattr(ours, 'get_fields_and_field_types'):
        names = set(ours.get_fields_and_field_types())
        fields = getattr(theirs, '__dataclass_fields__', getattr(theirs, '__slots__', names))
        # Names of constants are in upper case.
        return names == {name for name in fields if name.islower()} - {'__msgtype__'} and all(
            agree(getattr(ours, name), getattr(theirs, name)) for name in names)
    if isinstance(ours, list):
        return len(ours) == len(theirs) and all(map(agree, ours, theirs))
    if isinstance(ours, bytes):
        return ours in (theirs, bytes([theirs]) if isinstance(theirs, int) else b'')
    return np.array_equal(np.asarray(ours), np.asarray(theirs))


@pytest.fixture
def every_topic(bench, probe, tmp_path):
    """A recording of some messages on every topic, and the messages by topic."""
    recorder, rng, sent = Recorder(tmp_path / 'all.mcap', Scenario()), np.random.default_rng(0), {}
    recorder.record_topics(probe)
    for number, (name, (kind, profile)) in enumerate(recorded_topics().items()):
        publisher = probe.create_publisher(kind, name, profile)
        bench.until(publisher.get_subscription_count, 'the recorder')
        name = f'/{name.lstrip("/")}'
        sent[name] = [filled(kind, rng) for _ in range(1 + number % 3)]
        for message in sent[name]:
            before = recorder.count
            publisher.publish(message)
            bench.until(lambda before=before: recorder.count > before, 'the message')
    recorder.close()
    return tmp_path / 'all.mcap', sent


# Types, counts and contents follow from the definitions in the file alone.
def test_rosbags_reads_all_topics(every_topic):
    highlevel = pytest.importorskip('rosbags.highlevel', reason='there is no rosbags here')
    path, sent = every_topic
    with highlevel.AnyReader([path]) as reader:
        assert {connection.topic: (connection.msgtype, connection.msgcount)
                for connection in reader.connections} == {
            topic: (type_name(type(messages[0])), len(messages))
            for topic, messages in sent.items()}
        assert {connection.topic: [(policy.durability.name, policy.reliability.name)
                                   for policy in connection.ext.offered_qos_profiles]
                for connection in reader.connections} == {
            f'/{name.lstrip("/")}': [(profile.durability.name, 'RELIABLE')]
            for name, (_, profile) in recorded_topics().items()}
        for connection, _, content in reader.messages():
            ours = sent[connection.topic].pop(0)
            assert agree(ours, reader.deserialize(content, connection.msgtype)), connection.topic
    assert not any(sent.values())


def test_the_decoder_of_mcap_reads_all_topics(every_topic):
    decoder = pytest.importorskip('mcap_ros2.decoder', reason='there is no mcap_ros2 here')
    from mcap.reader import make_reader
    path, sent = every_topic
    with path.open('rb') as stream:
        for _, channel, _, theirs in make_reader(
                stream, decoder_factories=[decoder.DecoderFactory()]).iter_decoded_messages():
            assert agree(sent[channel.topic].pop(0), theirs), channel.topic
    assert not any(sent.values())


def contents(value):
    """Return the sum of the arc tangents of all numbers of a message, and the length of its texts.

    An arc tangent weighs small and large numbers alike.
    """
    if hasattr(value, 'get_fields_and_field_types'):
        value = [getattr(value, name) for name in value.get_fields_and_field_types()]
    if isinstance(value, str):
        return np.array([0, len(value)])
    if isinstance(value, list | np.ndarray | array.array | bytes):
        return sum(map(contents, value), np.zeros(2))
    return np.array([math.atan(value), 0])


def test_the_libraries_of_foxglove_read_all_topics(every_topic):
    """In Node.js, for which ``scripts/test --readers`` installs them."""
    if not (READERS / 'node_modules').exists():
        pytest.skip('the libraries are not installed (scripts/test --readers)')
    shutil.copy(Path(__file__).with_name('read_recording.mjs'), READERS)
    path, sent = every_topic
    lines = subprocess.run(
        ['node', READERS / 'read_recording.mjs', path], capture_output=True, text=True,
        timeout=240, check=True).stdout.splitlines()
    for line in map(json.loads, lines):
        np.testing.assert_allclose(
            [line['sum'], line['length']], contents(sent[line['topic']].pop(0)), rtol=1e-12)
    assert not any(sent.values())


def test_a_full_disk_ends_the_recording_with_one_error(bench, probe, tmp_path, full_disk):
    recorder, seen = Recorder(tmp_path / 'run.mcap', Scenario()), []
    recorder.record_topics(probe, lambda name, *_: seen.append(name))
    publisher = probe.create_publisher(ros.Ack, 'ack', ACKS)
    bench.until(publisher.get_subscription_count, 'the recorder')

    def failed():
        for _ in range(5):
            publisher.publish(ros.Ack(cycle_id=1, user=1, scenario_id=os.urandom(100_000).hex()))
        return recorder.failure
    with full_disk(100_000):
        failure = bench.until(failed, 'the failure')
    assert 'mcap.part: cannot be written: File too large; the recording ends after ' in failure
    # Observers of the recorded messages receive the others nevertheless.
    n_seen, count = len(seen), recorder.count
    publisher.publish(ros.Ack(cycle_id=1, user=1))
    bench.until(lambda: len(seen) > n_seen, 'another message')
    for _ in range(2):
        recorder.close()
    assert (recorder.count, recorder.failure) == (count, failure)
    assert not (tmp_path / 'run.mcap').exists()


def test_the_tool_ends_with_one_line_if_the_disk_is_full(tmp_path, full_disk):
    with full_disk(10):
        process = subprocess.run(
            [sys.executable, '-m', 'rhs_isac_ros.tools', 'record', 'run.mcap'], cwd=tmp_path,
            capture_output=True, text=True, timeout=240, check=False)
    assert process.returncode == 1
    assert 'Traceback' not in process.stderr
    assert process.stderr.count('error: ') == process.stderr.count(
        'run.mcap.part: cannot be written: File too large') == 1


def test_nodes_receive_a_recording_that_is_played_with_its_recorded_qos(bench, tmp_path):
    """As ``ros2 bag play`` does, which reads the quality of service from the file."""
    codebook = Codebook.default()
    message = to_ros(
        convert.CodebookMessage.of(codebook, 1, Scenario().id), Time())
    player = bench.add(Node, 'player')
    (recorded,) = yaml.safe_load(_offered_qos(recorded_topics()[topics.CODEBOOK][1]))
    assert recorded['liveliness_lease_duration'] == recorded['deadline'] == dict(
        zip(('sec', 'nsec'), divmod(Infinite.nanoseconds, 10**9), strict=True))
    publisher = player.create_publisher(ros.Codebook, topics.CODEBOOK, QoSProfile(
        history=HistoryPolicy.get_from_short_key(recorded['history']), depth=recorded['depth'],
        reliability=ReliabilityPolicy.get_from_short_key(recorded['reliability']),
        durability=DurabilityPolicy.get_from_short_key(recorded['durability']),
        liveliness=LivelinessPolicy.get_from_short_key(recorded['liveliness'])))
    publisher.publish(message)
    node = bench.add(TransmissionNode)
    # The codebook itself comes from the parameters of an optimizer.
    bench.until(lambda: node._codebook_client._announced_id == codebook.id, 'the announcement')
    assert not node._peers.conflicts()


def test_a_recorder_that_is_killed_leaves_its_messages(bench, probe, tmp_path):
    process = subprocess.Popen(
        [sys.executable, '-m', 'rhs_isac_ros.tools', 'record', str(tmp_path / 'run.mcap')],
        stdout=subprocess.DEVNULL)
    publisher = probe.create_publisher(ros.Ack, 'ack', ACKS)
    bench.until(publisher.get_subscription_count, 'the recorder')
    publisher.publish(ros.Ack(cycle_id=7, user=1))
    # The file grows when the chunk with the message is complete.
    partial = tmp_path / 'run.mcap.part'
    bench.until(lambda: any(True for _ in read(partial)), 'the message in the file')
    process.kill()
    process.wait(60)
    assert [file.name for file in tmp_path.iterdir()] == [partial.name]
    assert [topic for topic, _, _ in read(partial)] == ['/ack']
