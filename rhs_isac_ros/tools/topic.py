"""``scripts/topic``: ``ros2 topic``, which the wheels lack, with the same output.

``python3 -m rhs_isac_ros.tools.topic --help`` lists the commands.
"""

import argparse
import array
import collections
import dataclasses
import importlib
import itertools
import re
import statistics
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import yaml
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import (
    DurabilityPolicy,
    QoSPresetProfiles,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.ros.endpoints import steady_timer
from rhs_isac_ros.support.arguments import ArgumentParser, nonnegative_float, positive_int
from rhs_isac_ros.tools.command import Session, ToolError, print_now, run_tool


@dataclasses.dataclass(frozen=True)
class Layout:
    """Options of the text.

    Attributes
    ----------
    max_length
        Maximum number of entries of an array or characters of a string; the rest is replaced by
        dots. None: unlimited.
    arrays, strings
        Whether their values are written; otherwise only type and length.
    flow
        Whether collections are written on one line.
    """

    max_length: int | None = None
    arrays: bool = True
    strings: bool = True
    flow: bool = False


def as_yaml(message: Any, layout: Layout) -> str:
    """Return a ROS message as YAML, ending with a newline."""
    return yaml.dump(_mapping(message, layout), sort_keys=False, allow_unicode=True,
                     width=sys.maxsize, default_flow_style=layout.flow)


def as_csv(message: Any, layout: Layout) -> str:
    """Return all fields of a ROS message and of nested messages, separated by commas."""
    return ','.join(str(leaf) for leaf in _leaves(_mapping(message, layout)))


def _mapping(message: Any, layout: Layout) -> dict[str, Any]:
    types = message.get_fields_and_field_types()
    return {name: _plain(getattr(message, name), kind, layout) for name, kind in types.items()}


def _plain(value: Any, kind: str, layout: Layout) -> Any:
    """Convert a value to types that YAML supports."""
    max_length = layout.max_length
    match value:
        case bytes():
            return _truncate(''.join(map(chr, value)), max_length)
        case str():
            return (_truncate(value, max_length) if layout.strings
                    else f'<string length: <{len(value)}>>')
        case list() | tuple() | array.array() | np.ndarray():
            if kind and not layout.arrays:
                return _array_summary(kind, len(value))
            entries = [_plain(entry, '', layout) for entry in value[:max_length]]
            return entries + ['...'] * (len(value) > len(entries))
        case np.generic():
            return value.item()
        case bool() | int() | float():
            return value
    return _mapping(value, layout)


def _truncate(text: str, max_length: int | None) -> str:
    if max_length is None or len(text) <= max_length:
        return text
    return f'{text[:max_length]}...'


def _array_summary(kind: str, length: int) -> str:
    """Return type and length of an array, from the type as the message class names it."""
    if sequence := re.fullmatch(r'sequence<(.+?)(?:, (\d+))?>', kind):
        entry, bound = sequence.groups()
    else:
        entry, _, bound = kind.removesuffix(']').rpartition('[')
    entry = entry.replace('/', '/msg/')
    bound = f'[{bound}]' if bound else ''
    return (f'<sequence type: {entry}{bound}, length: {length}>' if sequence
            else f'<array type: {entry}{bound}>')


def _leaves(value: Any) -> list[Any]:
    if isinstance(value, dict | list):
        entries = value.values() if isinstance(value, dict) else value
        # An empty array takes one column.
        return [leaf for entry in entries for leaf in _leaves(entry)] or ['']
    return [value]


class Rate:
    """Intervals between the latest messages of a topic.

    Parameters
    ----------
    window
        Number of intervals to keep.
    """

    def __init__(self, window: int) -> None:
        self._times_ns: collections.deque[int] = collections.deque(maxlen=window + 1)
        self._changed = False

    def add(self, time_ns: int) -> None:
        """Add a message that arrived at a time [ns]; discard the others if the clock went back."""
        if self._times_ns and time_ns < self._times_ns[-1]:
            self._times_ns.clear()
        self._times_ns.append(time_ns)
        self._changed = True

    def report(self) -> str:
        """Return the two lines that ``ros2 topic hz`` prints, or '' if nothing has arrived."""
        intervals_s = [1e-9 * (after - before)
                       for before, after in itertools.pairwise(self._times_ns)]
        if not self._changed or not intervals_s:
            return ''
        self._changed = False
        mean_s = statistics.fmean(intervals_s)
        rate_hz = 1 / mean_s if mean_s else 0.0
        return (f'average rate: {rate_hz:.3f}\n\tmin: {min(intervals_s):.3f}s '
                f'max: {max(intervals_s):.3f}s std dev: {statistics.pstdev(intervals_s):.5f}s '
                f'window: {len(intervals_s)}')


_MAX_LENGTH = 128
_RATE_WINDOW = 10000
# Time for the discovery of other nodes [s]: unlike ``ros2``, there is no daemon with their names.
_DISCOVERY_TIMEOUT_S = 3.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command on topics and return the exit code of `run_tool`."""
    return run_tool(_parser(), arguments)


def show_list(session: Session, options: argparse.Namespace) -> None:
    """Print the names of all topics."""
    session.discover(options.spin_time)
    node = session.node
    topics = [(name, ', '.join(types)) for name, types in node.get_topic_names_and_types()
              if options.include_hidden_topics or not topic_or_service_is_hidden(name)]
    if options.count_topics:
        print_now(len(topics))
    elif options.verbose:
        print_now(_endpoint_counts('Published', 'publisher', topics, node.count_publishers))
        print_now(_endpoint_counts('Subscribed', 'subscriber', topics, node.count_subscribers))
    else:
        for name, types in topics:
            print_now(f'{name} [{types}]' if options.show_types else name)


def _endpoint_counts(
        title: str, endpoint: str, topics: list[tuple[str, str]], count: Callable[[str], int]
) -> str:
    lines = [f'{title} topics:']
    for name, types in topics:
        if n := count(name):
            lines.append(f' * {name} [{types}] {n} {endpoint}{"s" if n > 1 else ""}')
    return '\n'.join(lines) + '\n'


def show_info(session: Session, options: argparse.Namespace) -> None:
    """Print type, publishers and subscriptions of a topic.

    Raises
    ------
    ToolError
        If there is no such topic.
    """
    session.discover(options.spin_time)
    node, name = session.node, session.full_name(options.topic_name)
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
    """Print the messages of a topic.

    Raises
    ------
    ToolError
        If the type is unknown, or has no such field.
    """
    name = session.full_name(options.topic_name)
    kind = (_load_type(options.message_type) if options.message_type
            else _published_type(session, name, options.topic_name, options.spin_time))
    layout = Layout(None if options.full_length else options.truncate_length,
                    not options.no_arr, not options.no_str, options.flow_style)
    printed = 0

    def show(message: Any) -> None:
        nonlocal printed
        # With --once, further messages may be waiting already.
        if not (options.once and printed):
            _print_message(_select(message, options.field), layout, options.csv)
            printed += 1
    subscription = session.node.create_subscription(
        kind, name, show, _matching_qos(session, name, options))
    try:
        session.spin_until(lambda: bool(options.once and printed), options.timeout)
    finally:
        session.node.destroy_subscription(subscription)


def _print_message(value: Any, layout: Layout, csv: bool) -> None:
    if not hasattr(value, 'get_fields_and_field_types'):
        print_now(value, end='\n---\n')
    elif csv:
        print_now(as_csv(value, layout))
    else:
        print_now(as_yaml(value, layout), end='---\n')


def _select(message: Any, field: str | None) -> Any:
    for part in filter(None, (field or '').split('.')):
        try:
            message = getattr(message, part)
        except AttributeError as error:
            raise ToolError(f"Invalid field '{field}': {error}") from None
    return message


def _matching_qos(session: Session, name: str, options: argparse.Namespace) -> QoSProfile:
    """Return the strictest profile that is compatible with all known publishers."""
    offered = [info.qos_profile for info in session.node.get_publishers_info_by_topic(name)]
    reliable = bool(offered) and all(
        profile.reliability == ReliabilityPolicy.RELIABLE for profile in offered)
    latched = bool(offered) and all(
        profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in offered)
    preset = QoSPresetProfiles.get_from_short_key('sensor_data')
    return QoSProfile(
        depth=options.qos_depth or preset.depth, history=preset.history,
        reliability=(ReliabilityPolicy.get_from_short_key(options.qos_reliability)
                     if options.qos_reliability else
                     ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT),
        durability=(DurabilityPolicy.get_from_short_key(options.qos_durability)
                    if options.qos_durability else
                    DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE))


def show_rate(session: Session, options: argparse.Namespace) -> None:
    """Print the rate of the messages of a topic once a second.

    Raises
    ------
    ToolError
        If the topic's type cannot be loaded.
    """
    name = session.full_name(options.topic_name)
    kind = _published_type(session, name, options.topic_name, None)
    rate, clock = Rate(options.window_size), Clock(clock_type=ClockType.STEADY_TIME)
    # Raw messages: long ones would take time to deserialize.
    session.node.create_subscription(
        kind, name, lambda _: rate.add(clock.now().nanoseconds), qos_profile_sensor_data,
        raw=True)

    def report() -> None:
        if text := rate.report():
            print_now(text)
    steady_timer(session.node, 1.0, report)
    session.spin_until(lambda: False)


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
    return _load_type(found[0])


def _load_type(name: str) -> type[Any]:
    """Return the message class of a name such as ``std_msgs/msg/String``."""
    try:
        package, folder, kind = name.split('/')
        loaded: type[Any] = getattr(importlib.import_module(f'{package}.{folder}'), kind)
    except (ValueError, ImportError, AttributeError):
        raise ToolError(f"The message type '{name}' is invalid") from None
    return loaded


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='scripts/topic', description='List topics, print messages, measure rates.')
    verbs = parser.add_subparsers(required=True, metavar='list | echo | hz | info')
    verb = verbs.add_parser('list', help='Print the names of all topics.')
    verb.set_defaults(verb=show_list)
    verb.add_argument('-t', '--show-types', action='store_true', help='print the types')
    verb.add_argument('-c', '--count-topics', action='store_true',
                      help='print only the number of topics')
    verb.add_argument('-v', '--verbose', action='store_true',
                      help='print the numbers of publishers and subscribers')
    verb.add_argument('--include-hidden-topics', action='store_true',
                      help='include hidden topics')
    _add_spin_time(verb)
    verb = verbs.add_parser('info', help='Print type, publishers and subscriptions of a topic.')
    verb.set_defaults(verb=show_info)
    verb.add_argument('topic_name')
    verb.add_argument('-v', '--verbose', action='store_true',
                      help='print every publisher and subscription')
    _add_spin_time(verb)
    verb = verbs.add_parser('hz', help='Print the rate of the messages of a topic once a second.')
    verb.set_defaults(verb=show_rate)
    verb.add_argument('topic_name')
    verb.add_argument('-w', '--window', dest='window_size', type=positive_int,
                      default=_RATE_WINDOW, metavar='N',
                      help=f'number of intervals to average over (default: {_RATE_WINDOW})')
    verb = verbs.add_parser('echo', help='Print the messages of a topic.')
    verb.set_defaults(verb=echo)
    _add_echo_options(verb)
    return parser


def _add_echo_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('topic_name')
    parser.add_argument('message_type', nargs='?', help='such as std_msgs/msg/String')
    parser.add_argument('--once', action='store_true', help='exit after one message')
    parser.add_argument('--timeout', type=nonnegative_float, metavar='N',
                        help='exit after N seconds')
    parser.add_argument('--field', help='print only this field; dots select nested fields')
    parser.add_argument('--csv', action='store_true', help='print each message as one CSV line')
    parser.add_argument('--flow-style', action='store_true',
                        help='print collections on one line')
    parser.add_argument('-f', '--full-length', action='store_true', help='do not truncate')
    parser.add_argument('-l', '--truncate-length', type=positive_int, default=_MAX_LENGTH,
                        metavar='N',
                        help=f'maximum length of arrays and strings (default: {_MAX_LENGTH})')
    parser.add_argument('--no-arr', action='store_true',
                        help='print type and length of arrays only')
    parser.add_argument('--no-str', action='store_true', help='print the length of strings only')
    parser.add_argument('--qos-depth', type=positive_int, metavar='N', help='depth of the queue')
    parser.add_argument('--qos-reliability', choices=('reliable', 'best_effort'),
                        help='default: that of the publishers')
    parser.add_argument('--qos-durability', choices=('transient_local', 'volatile'),
                        help='default: that of the publishers')
    _add_spin_time(parser)


def _add_spin_time(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--spin-time', type=nonnegative_float, default=_DISCOVERY_TIMEOUT_S,
                        metavar='S',
                        help=f'time for discovery (default: {_DISCOVERY_TIMEOUT_S:g} s)')


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
