"""``scripts/topic``: commands of ``ros2 topic``, which has no wheel, with the same output."""

import argparse
import array
import collections
import importlib
import operator
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import yaml
from parts.verbs import run_verb
from rclpy.exceptions import InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.subscription import Subscription
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden
from rclpy.validate_full_topic_name import validate_full_topic_name

from rhs_isac_ros.protocol.messages import MessageError
from rhs_isac_ros.protocol.role import NewestDict
from rhs_isac_ros.ros.convert import deserialize
from rhs_isac_ros.ros.endpoints import OBSERVATION, log_dropped, steady_timer
from rhs_isac_ros.ros.session import Session
from rhs_isac_ros.support.arguments import ArgumentParser, nonnegative_float
from rhs_isac_ros.tools.command import ToolError, entry, print_now

_MAX_LENGTH = 128
# Number of latest messages that are not printed twice.
_MAX_KNOWN = 256
# Maximum number of latest messages from which a rate is computed.
_MAX_TIMES = 10001
# Time to discover other nodes [s]; unlike ``ros2``, this tool has no daemon.
_DISCOVERY_TIMEOUT_S = 3.0


def as_yaml(message: Any, max_length: int | None = None) -> str:
    """Return a ROS message as YAML that ends with a newline.

    Dots replace array entries and string characters beyond `max_length`, unless it is None.
    """
    return yaml.dump(_plain(message, max_length), sort_keys=False, allow_unicode=True,
                     width=sys.maxsize, default_flow_style=False)


def _plain(value: Any, max_length: int | None) -> Any:
    match value:
        case bytes():
            return _plain(''.join(map(chr, value)), max_length)
        case str():
            text = value[:max_length]
            return text if text == value else f'{text}...'
        case list() | tuple() | array.array() | np.ndarray():
            entries = [_plain(entry, max_length) for entry in value[:max_length]]
            return entries + ['...'] * (len(value) > len(entries))
        case np.generic():
            return value.item()
        case bool() | int() | float():
            return value
    return {name: _plain(getattr(value, name), max_length)
            for name in value.get_fields_and_field_types()}


def rate_text(times_ns: Sequence[int]) -> str:
    """Return the two lines that ``ros2 topic hz`` prints for messages at given times [ns]."""
    intervals_s = 1e-9 * np.diff(times_ns)
    mean_s = intervals_s.mean()
    return (f'average rate: {1 / mean_s if mean_s else 0.0:.3f}\n\tmin: {intervals_s.min():.3f}s '
            f'max: {intervals_s.max():.3f}s std dev: {intervals_s.std():.5f}s '
            f'window: {len(intervals_s)}')


def show_list(session: Session, options: argparse.Namespace) -> None:
    """Print the names of all topics that are not hidden."""
    session.discover(options.spin_time)
    for name, types in session.node.get_topic_names_and_types():
        if not topic_or_service_is_hidden(name):
            print_now(f'{name} [{", ".join(types)}]' if options.show_types else name)


def show_info(session: Session, options: argparse.Namespace) -> None:
    """Print the type, the publishers and the subscriptions of a topic, or raise `ToolError`."""
    session.discover(options.spin_time)
    node, name = session.node, _full_name(session.node, options.topic_name)
    types = dict(node.get_topic_names_and_types()).get(name)
    if types is None:
        raise ToolError(f"Unknown topic '{options.topic_name}'")
    end = '\n\n' if options.verbose else '\n'
    print_now(f'Type: {types[0] if len(types) == 1 else types}', end=end)
    for title, count, endpoints in (
            ('Publisher', node.count_publishers, node.get_publishers_info_by_topic),
            ('Subscription', node.count_subscribers, node.get_subscriptions_info_by_topic)):
        print_now(f'{title} count: {count(name)}', end=end)
        for endpoint in endpoints(name) if options.verbose else ():
            print_now(endpoint, end=end)


def echo(session: Session, options: argparse.Namespace) -> None:
    """Print the messages of a topic, or raise `ToolError`."""
    name = _full_name(session.node, options.topic_name)
    kind = _published_type(session, name, options.topic_name, options.spin_time)
    max_length = None if options.full_length else _MAX_LENGTH
    printed = 0
    # Of the publishers that appear one after the other, each needs a subscription that suits it; a
    # message may arrive at several.
    subscriptions: dict[tuple[ReliabilityPolicy, DurabilityPolicy], Subscription] = {}
    known: NewestDict[tuple[int, int], None] = NewestDict(_MAX_KNOWN)

    def show(content: bytes, info: Mapping[str, int]) -> None:
        nonlocal printed
        # With --once, further messages may already have arrived.
        if options.once and printed or (key := (
                info['source_timestamp'], info['publication_sequence_number'])) in known:
            return
        known.put(key, None)
        try:
            message = deserialize(content, kind)
        except MessageError as error:
            log_dropped(session.node, error)
            return
        try:
            value = operator.attrgetter(options.field)(message) if options.field else message
        except AttributeError as error:
            raise ToolError(f"Invalid field '{options.field}': {error}") from None
        text = (as_yaml(value, max_length) if hasattr(value, 'get_fields_and_field_types')
                else f'{value}\n')
        print_now(f'{text}---')
        printed += 1

    def done() -> bool:
        for publisher in session.node.get_publishers_info_by_topic(name):
            offered = publisher.qos_profile
            policies = offered.reliability, offered.durability
            if policies not in subscriptions:
                subscriptions[policies] = session.node.create_subscription(
                    kind, name, show, QoSProfile(  # type: ignore[arg-type]
                        depth=OBSERVATION.depth, reliability=policies[0], durability=policies[1]),
                    raw=True)
        return bool(options.once and printed)
    try:
        session.spin_until(done, options.timeout)
    finally:
        for subscription in subscriptions.values():
            session.node.destroy_subscription(subscription)


def show_rate(session: Session, options: argparse.Namespace) -> None:
    """Print the rate of the messages of a topic once a second, or raise `ToolError`."""
    name = _full_name(session.node, options.topic_name)
    kind = _published_type(session, name, options.topic_name, None)
    times_ns: collections.deque[int] = collections.deque(maxlen=_MAX_TIMES)
    reported_ns = 0
    # Raw messages, because deserialization of long messages takes time.
    session.node.create_subscription(
        kind, name, lambda _, info: times_ns.append(  # type: ignore[arg-type, misc]
            info['received_timestamp']), qos_profile_sensor_data, raw=True)

    def report() -> None:
        nonlocal reported_ns
        if len(times_ns) > 1 and times_ns[-1] != reported_ns:
            reported_ns = times_ns[-1]
            print_now(rate_text(times_ns))
    steady_timer(session.node, 1.0, report)
    session.spin_until(lambda: False)


def _full_name(node: Node, topic: str) -> str:
    """Return the full name of a topic, or raise `ToolError` if its name is invalid."""
    try:
        name = expand_topic_name(topic, node.get_name(), node.get_namespace())
        validate_full_topic_name(name)
    except (ValueError, InvalidTopicNameException) as error:
        # The text ends with a location in the source code of ROS.
        raise ToolError(str(error).partition(', at /')[0]) from None
    return name


def _published_type(
        session: Session, name: str, given_name: str, timeout_s: float | None) -> type[Any]:
    """Wait for a topic, indefinitely if `timeout_s` is None, and return its message class."""
    def types() -> list[str]:
        return dict(session.node.get_topic_names_and_types()).get(name, [])
    warn_after_s = _DISCOVERY_TIMEOUT_S if timeout_s is None else timeout_s
    if not session.spin_until(lambda: bool(types()), warn_after_s):
        print_now(f'WARNING: topic [{given_name}] does not appear to be published yet')
        if timeout_s is not None:
            raise ToolError('Could not determine the type for the passed topic')
        session.spin_until(lambda: bool(types()))
    found = types()
    if len(found) > 1:
        raise ToolError(f"Cannot echo topic '{given_name}', as it contains more than one type: "
                        f'[{", ".join(found)}]')
    package, folder, message = found[0].split('/')
    try:
        return getattr(importlib.import_module(f'{package}.{folder}'), message)
    except (ImportError, AttributeError):
        raise ToolError(f"The message type '{found[0]}' is invalid") from None


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='scripts/topic', description='List topics, print messages, measure rates.')
    verbs = parser.add_subparsers(required=True, metavar='list | echo | hz | info')

    def add_verb(name: str, function: Any, text: str) -> argparse.ArgumentParser:
        verb = verbs.add_parser(name, help=text)
        verb.set_defaults(verb=function)
        if name != 'list':
            verb.add_argument('topic_name')
        if name != 'hz':
            verb.add_argument('--spin-time', type=nonnegative_float, metavar='S',
                              default=_DISCOVERY_TIMEOUT_S, help='time for discovery (default: '
                              f'{_DISCOVERY_TIMEOUT_S:g} s)')
        return verb
    verb = add_verb('list', show_list, 'Print the names of all topics.')
    verb.add_argument('-t', '--show-types', action='store_true', help='print the types')
    verb = add_verb('info', show_info, 'Print type, publishers and subscriptions of a topic.')
    verb.add_argument('-v', '--verbose', action='store_true',
                      help='print every publisher and subscription')
    add_verb('hz', show_rate, 'Print the rate of the messages of a topic once a second.')
    verb = add_verb('echo', echo, 'Print the messages of a topic.')
    verb.add_argument('--once', action='store_true', help='exit after one message')
    verb.add_argument('--timeout', type=nonnegative_float, metavar='N',
                      help='exit after N seconds')
    verb.add_argument('--field', default='',
                      help='print only this field; dots select nested fields')
    verb.add_argument('-f', '--full-length', action='store_true',
                      help=f'print more than {_MAX_LENGTH} entries of arrays and strings')
    return parser


main = entry(run_verb, _parser)
