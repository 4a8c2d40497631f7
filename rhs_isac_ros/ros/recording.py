"""Recordings: MCAP files as of ``ros2 bag``, with the definitions of their messages.

They open in Foxglove and in ``ros2 bag info`` and ``play``. The library mcap is optional.
"""

import contextlib
import re
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.ros import convert, qos, topics
from rhs_isac_ros.ros.subscriptions import subscribe

# What stands between the definitions of a schema, as in ROS 1 and 2.
_RULE = '=' * 80
_SCENARIO = 'scenario'
_BUILT_IN = re.compile(r'(bool|byte|char|float\d+|u?int\d+|w?string)\b')


class RecordingError(Exception):
    """A recording cannot be written or read."""


def outlets() -> dict[str, tuple[type, QoSProfile]]:
    """Return every topic of a network.

    Returns
    -------
    dict
        Class of the messages and quality of service, by relative name.
    """
    found = {name: (convert.ros_type(kind), qos.of(kind)) for kind, name in topics.NAMES.items()}
    found[topics.POSITION] = PoseWithCovarianceStamped, qos.EXCHANGE
    found[topics.CODEBOOK] = ros.Codebook, qos.LATCHED
    found[topics.DIAGNOSTICS] = DiagnosticArray, qos.EXCHANGE
    return found


def type_name(kind: type) -> str:
    """Return the name of a class of messages, such as ``std_msgs/msg/Header``.

    Parameters
    ----------
    kind
        The class.

    Returns
    -------
    str
        Its name.
    """
    return f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'


def schema(kind: type) -> str:
    """Return the definition of a class of messages, followed by those that it is made of.

    Parameters
    ----------
    kind
        The class.

    Returns
    -------
    str
        The text that MCAP calls ``ros2msg``.
    """
    first = type_name(kind).replace('/msg/', '/')
    texts: dict[str, str] = {}
    wanted = [first]
    while wanted:
        name = wanted.pop(0)
        if name not in texts:
            package, short = name.split('/')
            file = Path(get_package_share_directory(package)) / 'msg' / f'{short}.msg'
            texts[name] = file.read_text(encoding='utf-8')
            wanted += _parts(texts[name], package)
    own = texts.pop(first)
    return '\n'.join([own, *(f'{_RULE}\nMSG: {name}\n{text}' for name, text in texts.items())])


def _offered(profile: QoSProfile) -> str:
    """Write a quality of service as ``ros2 bag play`` reads it: else nothing would be latched."""
    for_ever = {'sec': 9223372036, 'nsec': 854775807}
    return yaml.safe_dump([{
        'history': profile.history.short_key, 'depth': profile.depth,
        'reliability': profile.reliability.short_key, 'durability': profile.durability.short_key,
        'deadline': dict(for_ever), 'lifespan': dict(for_ever), 'liveliness': 'automatic',
        'liveliness_lease_duration': dict(for_ever), 'avoid_ros_namespace_conventions': False}])


def _parts(text: str, package: str) -> Iterator[str]:
    """Yield the messages that a definition names."""
    for line in text.splitlines():
        field = re.match(r'\s*([A-Za-z][\w/]*)', line)
        if field and not _BUILT_IN.match(field[1]):
            name = field[1].replace('/msg/', '/')
            yield name if '/' in name else f'{package}/{name}'


class Recorder:
    """Writes what is said in a network to a file, which is there under its name once closed.

    Until then it is ``<name>.part``, of which a broken run leaves what was written.

    Parameters
    ----------
    path
        The file.
    scenario
        Scenario of the network, kept in the file.

    Attributes
    ----------
    count
        Messages written.

    Raises
    ------
    RecordingError
        If mcap is not installed, or the file cannot be written.
    """

    def __init__(self, path: str | Path, scenario: Scenario) -> None:
        try:
            from mcap.writer import Writer
        except ImportError:
            raise RecordingError(_missing('recording')) from None
        self._path = Path(path)
        self._aside = self._path.with_name(f'{self._path.name}.part')
        try:
            self._stream = self._aside.open('wb')
        except OSError as error:
            raise RecordingError(f'{path}: cannot be written: {error.strerror}') from None
        self._writer = Writer(self._stream)
        self._writer.start(profile='ros2', library='rhs_isac_ros')
        self._writer.add_metadata(_SCENARIO, {'yaml': yaml.safe_dump(scenario.changes())})
        self.count = 0

    def listen(self, node: Node, then: Callable[[str, bytes], None] | None = None) -> None:
        """Record every topic of a node's namespace.

        Parameters
        ----------
        node
            The node.
        then
            Called with the relative name of the topic and the serialised message once it is
            written.
        """
        for name, (kind, profile) in outlets().items():
            channel = self._writer.register_channel(
                topic=node.resolve_topic_name(name), message_encoding='cdr',
                schema_id=self._writer.register_schema(
                    type_name(kind), 'ros2msg', schema(kind).encode()),
                metadata={'offered_qos_profiles': _offered(profile)})
            subscribe(
                node, kind, name, self._writes(channel, name, then), profile, raw=True)

    def _writes(
            self, channel: int, name: str, then: Callable[[str, bytes], None] | None
    ) -> Callable[[bytes], None]:
        def write(message: bytes) -> None:
            now_ns = time.time_ns()
            self._writer.add_message(
                channel_id=channel, log_time=now_ns, publish_time=now_ns, data=message)
            self.count += 1
            if then:
                then(name, message)
        return write

    def close(self) -> None:
        """Complete the file and give it its name."""
        if not self._stream.closed:
            self._writer.finish()
            self._stream.close()
            self._aside.replace(self._path)


def read(
        path: str | Path, names: Collection[str] | None = None
) -> Iterator[tuple[str, Any, float]]:
    """Read the messages of a recording in the order in which they were written.

    Parameters
    ----------
    path
        The file.
    names
        Full names of the topics to read; None: all.

    Yields
    ------
    tuple
        Full name of the topic, the ROS message, and when it was recorded [s].

    Raises
    ------
    RecordingError
        If mcap is not installed, or the file is no recording.
    """
    kinds = {type_name(kind): kind for kind, _ in outlets().values()}
    with _opened(path) as reader:
        for found, channel, message in reader.iter_messages(topics=names):
            if found is not None and found.name in kinds:
                yield (channel.topic, deserialize_message(message.data, kinds[found.name]),
                       1e-9 * message.log_time)


def read_scenario(path: str | Path) -> Scenario | None:
    """Read the scenario that a recording keeps.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    Scenario or None
        The scenario; None if it keeps none, as a recording of ``ros2 bag``.

    Raises
    ------
    RecordingError
        If mcap is not installed, or the file is no recording.
    ScenarioError
        If the scenario is wrong.
    """
    with _opened(path) as reader:
        for metadata in reader.iter_metadata():
            if metadata.name == _SCENARIO:
                try:
                    return Scenario(**yaml.safe_load(metadata.metadata['yaml']))
                # Of another version, or written by someone else.
                except (KeyError, TypeError, yaml.YAMLError) as error:
                    raise RecordingError(f'{path}: its scenario is none: {error}') from None
    return None


@contextlib.contextmanager
def _opened(path: str | Path) -> Iterator[Any]:
    """Yield a reader; what goes wrong with it becomes a `RecordingError`."""
    try:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    except ImportError:
        raise RecordingError(_missing('reading a recording')) from None
    try:
        with Path(path).open('rb') as stream:
            yield make_reader(stream)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from None
    except McapError as error:
        raise RecordingError(f'{path}: no whole recording: {error!r}') from None


def _missing(purpose: str) -> str:
    return f'{purpose} needs mcap, which is not installed (pip install mcap)'
