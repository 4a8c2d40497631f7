"""Recordings of networks.

A recording holds the topics of a namespace with their scenario. If the namespace is that of a
site, it also holds those of each surface, in a namespace below, with the scenarios and the region.
Recordings are self-contained MCAP files, which Foxglove, ``ros2 bag info`` and ``ros2 bag play``
can read. The library mcap is optional.
"""

import contextlib
import copy
import dataclasses
import errno
import functools
import os
import posixpath
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.qos import QoSProfile

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import numbers
from rhs_isac_ros.positioning.site import Site
from rhs_isac_ros.ros import convert, endpoints, topics
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.files import parse_yaml, read_yaml
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import

# Separator between the message definitions of a schema, as in ROS 1 and 2.
_SEPARATOR = '=' * 80
# Metadata: scenarios by the name of the surface, empty for the namespace of the recorder; and the
# bounds of the region of a site.
_SCENARIO, _NETWORK, _WHOLE, _REGION = 'scenario', 'network', '', 'region'
# Maximum size of a record, and of a decompressed chunk or message [bytes].
_MAX_BYTES = 2**26
# Begin of a message that ``ros2 bag record --compression-mode message`` has compressed with zstd.
_ZSTD = b'\x28\xb5\x2f\xfd'
# Period of completing a chunk, so that a killed process loses at most this time [s].
_FLUSH_S = 0.5
# Maximum number of characters of a scenario.
_MAX_SCENARIO = 2**20
_BUILT_IN = re.compile(r'bool|float\d+|u?int\d+|w?string')
# Names of the same type in different languages.
_BYTES = {'byte', 'char', 'octet'}
# Type, bounds and name of a field; the name of a constant begins with a capital letter.
_FIELD = re.compile(r'\s*([A-Za-z][\w/]*)(\S*)\s+([a-z]\w*)')


class RecordingError(Exception):
    """A recording cannot be written or read."""


def recorded_topics() -> dict[str, tuple[type, QoSProfile]]:
    """Return the type and quality of service of each recorded topic, by its name in `topics`."""
    found = {name: (convert.ros_type(kind), endpoints.profile_for(kind))
             for kind, name in topics.NAMES.items()}
    found[topics.POSITION] = PoseWithCovarianceStamped, endpoints.EXCHANGE
    found[topics.CODEBOOK] = ros.Codebook, endpoints.LATCHED
    found[topics.PRESENCE] = ros.Presence, endpoints.PRESENCES
    found[topics.DIAGNOSTICS] = DiagnosticArray, endpoints.EXCHANGE
    return found


def type_name(kind: type) -> str:
    """Return the name of a ROS message class, such as ``std_msgs/msg/Header``."""
    return f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'


def schema(kind: type) -> str:
    """Return the definition of a message class and its nested messages in ``ros2msg`` format."""
    first = type_name(kind).replace('/msg/', '/')
    texts: dict[str, str] = {}
    wanted = [first]
    while wanted:
        name = wanted.pop(0)
        if name not in texts:
            package, short = name.split('/')
            file = Path(get_package_share_directory(package)) / 'msg' / f'{short}.msg'
            texts[name] = file.read_text(encoding='utf-8')
            wanted += (part.partition('[')[0] for part, _ in _fields(name, texts[name])
                       if '/' in part)
    own = texts.pop(first)
    parts = (f'{_SEPARATOR}\nMSG: {name}\n{text}' for name, text in texts.items())
    return '\n'.join([own, *parts])


def _offered_qos(profile: QoSProfile) -> str:
    """Return a quality of service in YAML, as ``ros2 bag play`` needs it to latch topics."""
    unlimited = {'sec': 9223372036, 'nsec': 854775807}
    return yaml.safe_dump([{
        'history': profile.history.short_key, 'depth': profile.depth,
        'reliability': profile.reliability.short_key, 'durability': profile.durability.short_key,
        'deadline': dict(unlimited), 'lifespan': dict(unlimited), 'liveliness': 'automatic',
        'liveliness_lease_duration': dict(unlimited), 'avoid_ros_namespace_conventions': False}])


def _fields(owner: str, text: str) -> list[tuple[str, str]]:
    """Return type and name of each field in the definition of a message, such as ``pkg/Name``.

    Other writers omit constants, defaults and comments, or qualify the types.
    """
    package = owner.partition('/')[0]
    return [(('uint8' if kind in _BYTES else kind if '/' in kind or _BUILT_IN.fullmatch(kind) else
              f'{package}/{kind}') + bounds, name)
            for kind, bounds, name in (
                (found[1].replace('/msg/', '/'), *found.groups()[1:])
                for found in map(_FIELD.match, text.splitlines()) if found)]


class Recorder:
    """Writes the messages and the scenario of a network, or of those of a site, to a new file.

    Until `close` completes the file, its name is ``<name>.part``; an incomplete file keeps it.
    The messages up to `_FLUSH_S` before the end of a process that is killed are readable. Raises
    RecordingError if mcap is not installed, or one of the two files exists or cannot be created.
    """

    def __init__(self, path: str | Path, scenario: Scenario, site: Site | None = None) -> None:
        with translated(MissingLibraryError, RecordingError), optional_import(
                'recording', extra='recording'):
            from mcap.writer import Writer
        self._path = Path(path)
        self._partial = self._path.with_name(f'{self._path.name}.part')
        try:
            self._check_absence()
            self._stream = self._partial.open('xb')
        except OSError as error:
            hint = '; a recorder that runs, or was killed, has the file FILE.part' if isinstance(
                error, FileExistsError) else ''
            raise RecordingError(
                f'{error.filename}: cannot be written: {error.strerror}{hint}') from None
        self._writer = Writer(self._stream)
        self._networks = [_WHOLE, *(site.surfaces if site else ())]
        # Number of messages written, and the reason why writing failed, such as a full disk.
        self.count, self.failure = 0, ''
        self._attempt(lambda: self._begin(scenario, site))

    def _begin(self, scenario: Scenario, site: Site | None) -> None:
        self._writer.start(profile='ros2', library='rhs_isac_ros')
        surfaces = {name: one.scenario for name, one in site.surfaces.items()} if site else {}
        for name, one in {_WHOLE: scenario, **surfaces}.items():
            self._writer.add_metadata(
                _SCENARIO, {_NETWORK: name, 'yaml': yaml.safe_dump(one.changes())})
        if site:
            self._writer.add_metadata(_REGION, {'yaml': yaml.safe_dump(site.bounds_m.tolist())})
        self._writer.flush()

    def record_topics(
            self, node: Node, on_message: Callable[[str], None] = lambda name: None) -> None:
        """Record the topics of `recorded_topics` in the namespace of a node and of the surfaces.

        `on_message` is called for each message with the name of its topic, as in `recorded_topics`
        after the name of the surface.
        """
        # Absolute names are the same in all namespaces.
        for name, (kind, profile) in {
                posixpath.join(network, name): found for network in self._networks
                for name, found in recorded_topics().items()}.items():
            channel = self._writer.register_channel(
                topic=node.resolve_topic_name(name), message_encoding='cdr',
                schema_id=self._writer.register_schema(
                    type_name(kind), 'ros2msg', schema(kind).encode()),
                metadata={'offered_qos_profiles': _offered_qos(profile)})
            # The process may be suspended for several seconds.
            queue = copy.copy(profile)
            queue.depth = endpoints.OBSERVATION.depth
            endpoints.subscribe(node, kind, name, functools.partial(
                self._write, channel, name, on_message), queue, raw=True)
        endpoints.steady_timer(
            node, _FLUSH_S, functools.partial(self._attempt, self._writer.flush))

    def _write(
            self, channel: int, name: str, on_message: Callable[[str], None], message: bytes,
            info: Mapping[str, int]) -> None:
        self._attempt(lambda: self._writer.add_message(
            channel_id=channel, log_time=info['received_timestamp'],
            publish_time=info['source_timestamp'], data=message))
        self.count += not self.failure
        on_message(name)

    def _attempt(self, write: Callable[[], object]) -> None:
        """Write unless the file is closed or an attempt has failed."""
        try:
            if not (self.failure or self._stream.closed):
                write()
        except OSError as error:
            self.failure = (f'{self._partial}: cannot be written: {error.strerror}; the recording '
                            f'ends after {self.count} messages')

    def close(self) -> None:
        """Complete the file and rename it; after a failure, the incomplete file remains."""
        self._attempt(self._complete)
        with contextlib.suppress(OSError):
            self._stream.close()

    def _complete(self) -> None:
        self._writer.finish()
        # Closing writes the rest of the buffer, which may fail.
        self._stream.close()
        self._check_absence()
        self._partial.replace(self._path)

    def _check_absence(self) -> None:
        if self._path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(self._path))


def read(
        path: str | Path, names: Collection[str] | None = None
) -> Iterator[tuple[str, bytes, float]]:
    """Yield the topic, the bytes (CDR) and the recorded time [s] of each message of a known type.

    The path is that of a file, or of a folder that ``ros2 bag record`` has written. The messages
    are sorted by time; copies of a recording may have them in another order. The known types are
    those of `recorded_topics`. `names`, if given, selects topics by full name. Fields that the
    installed type has after those of the recorded one have their defaults. Raises RecordingError
    if a file cannot be read, or a type differs otherwise.
    """
    kinds = {type_name(kind): kind for kind, _ in recorded_topics().values()}
    known: dict[tuple[str, int], Any] = {}
    converted: dict[int, Callable[[bytes], bytes]] = {}
    messages: list[tuple[str, bytes, int]] = []
    for record in _records(path):
        what = type(record).__name__
        if what == 'Header':
            # Each file has its own numbers.
            known, converted = {}, {}
        if what in ('Schema', 'Channel'):
            known[what, record.id] = record
        if what != 'Message':
            continue
        if not (channel := known.get(('Channel', record.channel_id))):
            raise RecordingError(f'{path}: a message without a topic')
        found = known.get(('Schema', channel.schema_id))
        if (found is None or found.name not in kinds
                or names is not None and channel.topic not in names):
            continue
        if found.id not in converted:
            converted[found.id] = _conversion(path, found, kinds[found.name])
        content = record.data
        if content.startswith(_ZSTD):
            with translated(Exception, RecordingError, f'{path}: {channel.topic}'):
                content = _expanded(content, _MAX_BYTES)
        messages.append((channel.topic, converted[found.id](content), record.log_time))
    messages.sort(key=lambda message: message[2])
    yield from ((topic, content, 1e-9 * time_ns) for topic, content, time_ns in messages)


def _conversion(path: str | Path, found: Any, kind: type) -> Callable[[bytes], bytes]:
    """Return a function that converts messages with a recorded schema to the installed type."""
    if found.encoding != 'ros2msg':
        return bytes
    recorded = _definitions(found.name, found.data.decode(errors='replace'))
    (owner, fields), *parts = _definitions(found.name, schema(kind)).items()
    before = recorded[owner]
    other = next((name for name, part in parts if recorded.get(name, part) != part), '')
    if not other and before == fields:
        return bytes
    if not other and before == fields[:len(before)] and (
            extension := convert.extension(kind, len(before))):
        return extension
    raise RecordingError(
        f'{path}: {other or owner}: recorded with other fields than the installed message has; '
        'expected the same, or all but the last ones that have defaults')


def _definitions(name: str, text: str) -> dict[str, list[tuple[str, str]]]:
    """Return the fields of the message `name` and of its nested messages, by their names."""
    first, *others = re.split(r'^=+\s*MSG: (\S+)', text, flags=re.MULTILINE)
    texts = {name: first, **dict(zip(others[::2], others[1::2], strict=True))}
    return {(short := name.replace('/msg/', '/')): _fields(short, part)
            for name, part in texts.items()}


class Recorded(NamedTuple):
    """What a recording declares about its networks."""

    #: Scenario of the recorded namespace; None if there is none, as with ``ros2 bag record``.
    scenario: Scenario | None
    #: Scenarios of the surfaces of a site, in namespaces of their names; empty without a site.
    surfaces: Mapping[str, Scenario]
    bounds_m: np.ndarray  #: Bounds of the region of a site, float64 [2, 3] [m]; NaN without one.

    def is_site(self, namespace: str) -> bool:
        """Return whether a namespace is that of a whole site."""
        return bool(self.surfaces) and _last(namespace) not in self.surfaces

    def of(self, namespace: str) -> Scenario | None:
        """Return the scenario of a namespace, whose last part may name a surface."""
        return self.surfaces.get(_last(namespace), self.scenario)


def _last(namespace: str) -> str:
    """Return the last part of a namespace."""
    return namespace.rstrip('/').rpartition('/')[2]


def read_networks(path: str | Path, site: Site | None = None) -> Recorded:
    """Return the scenarios of a recording, or of a site that the recording does not describe.

    Raises RecordingError if the file, a scenario or the region is unreadable, ScenarioError if a
    value is wrong.
    """
    if site:
        return Recorded(None, {name: one.scenario for name, one in site.surfaces.items()},
                        site.bounds_m)
    scenarios: dict[str, Scenario] = {}
    bounds_m = np.full((2, 3), np.nan)
    for record in _records(path):
        match type(record).__name__:
            case 'Metadata' if record.name == _SCENARIO:
                fields = _parsed(path, record)
                with translated(TypeError, RecordingError, f'{path}: invalid scenario'):
                    scenarios[record.metadata.get(_NETWORK, _WHOLE)] = Scenario(**fields)
            case 'Metadata' if record.name == _REGION:
                with translated(ValueError, RecordingError, f'{path}: invalid region'):
                    bounds_m = numbers('bounds', _parsed(path, record)).reshape(2, 3)
            case 'Message' if scenarios:
                break
    scenario = scenarios.pop(_WHOLE, None)
    if scenarios and np.isnan(bounds_m).any():
        raise RecordingError(f'{path}: surfaces {", ".join(scenarios)}, but no region')
    return Recorded(scenario, scenarios, bounds_m)


def _parsed(path: str | Path, record: Any) -> Any:
    """Return the content of metadata in YAML."""
    try:
        text = record.metadata['yaml']
        # With references, a short text can describe an enormous value.
        if '&' in text or len(text) > _MAX_SCENARIO:
            raise TypeError('it contains references, or is too long')
        return parse_yaml(text)
    # The file may come from another version or another program.
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f'{path}: invalid {record.name}: {error}') from None


def _records(path: str | Path) -> Iterator[Any]:
    """Yield the records of a file, or of the files of a folder of ``ros2 bag record``."""
    for file in _files(Path(path)):
        yield from _records_of(file)


def _files(path: Path) -> list[Path]:
    """Return the files of a recording; those of a folder are listed in its metadata.

    Other files in the folder may be copies, or of other recordings.
    """
    if not path.is_dir():
        return [path]
    try:
        names = read_yaml(path / 'metadata.yaml')['rosbag2_bagfile_information'][
            'relative_file_paths']
        # Early versions put the name of the folder in front.
        files = [path / Path(name).name for name in names]
    # The file may be missing, or come from another program.
    except (KeyError, TypeError, ValueError):
        files = []
    if not files or any(file.suffix != '.mcap' for file in files):
        raise RecordingError(f'{path}: expected a file, or a folder with metadata.yaml, which '
                             'lists files *.mcap: ros2 bag record -s mcap writes it, without '
                             '--compression-mode file; ros2 bag convert converts others')
    return files


def _records_of(path: Path) -> Iterator[Any]:
    """Yield the records of a file and of its chunks, in the order of the file.

    Unlike the readers of mcap, this function limits the size of a decompressed chunk. If the end
    of the file is missing, because its writer was killed, it logs a warning. Raises RecordingError
    if the file cannot be read.
    """
    with translated(MissingLibraryError, RecordingError), optional_import(
            'reading a recording', extra='recording'):
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk
    is_begun = False
    try:
        stream = path.open('rb')
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from None
    with stream:
        try:
            for record in StreamReader(stream, emit_chunks=True, validate_crcs=True,
                                       record_size_limit=_MAX_BYTES).records:
                is_begun = True
                if isinstance(record, Chunk):
                    yield from breakup_chunk(_decompressed(record), validate_crc=True)
                else:
                    yield record
        except OSError as error:
            raise RecordingError(f'{path}: cannot be read: {error.strerror}') from None
        # For a damaged file, mcap and its libraries raise many kinds of exceptions.
        except Exception as error:
            if not is_begun or stream.read(1):
                raise RecordingError(f'{path}: not a complete recording: {error!r}') from None
            get_logger('recording').warning(
                f'{path}: incomplete, because its writer did not close it; read up to its end',
                once=True)


def _decompressed(chunk: Any) -> Any:
    """Return a chunk without compression; raise ValueError if it is too large."""
    import lz4.frame

    size = chunk.uncompressed_size
    if size > _MAX_BYTES:
        raise ValueError(f'a chunk of {size} bytes, expected at most {_MAX_BYTES}')
    match chunk.compression:
        case 'zstd':
            data = _expanded(chunk.data, size)
        case 'lz4':
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size)
        case _:
            data = chunk.data
    return dataclasses.replace(chunk, compression='', data=data)


def _expanded(data: bytes, size: int) -> bytes:
    """Return up to `size` bytes of data that zstd has compressed."""
    import zstandard

    return bytes(zstandard.ZstdDecompressor().stream_reader(data).read(size))
