"""``scripts/topic``: what of ``ros2 topic`` the wheels lack, with the same output.

``python -m rhs_isac_ros.tools.topic --help`` lists the commands.
"""

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.qos import (
    DurabilityPolicy,
    QoSPresetProfiles,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from rhs_isac_ros.ros.timers import steady_timer
from rhs_isac_ros.tools.message_text import Layout, as_csv, as_yaml
from rhs_isac_ros.tools.rate import Rate
from rhs_isac_ros.tools.session import Session, ToolError, run_tool, say

_LONGEST = 128
_WINDOW = 10000
# How long others get to be discovered [s]: there is no daemon that knows them already.
_DISCOVERY_S = 3.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command on topics.

    Parameters
    ----------
    arguments
        Command line; by default the process's.

    Returns
    -------
    int
        Exit code, as of `run_tool`.
    """
    return run_tool(_parser(), arguments)


def show_list(session: Session, options: argparse.Namespace) -> None:
    """Print the names of all topics.

    Parameters
    ----------
    session
        The session.
    options
        ``show_types``, ``count_topics``, ``verbose``, ``include_hidden_topics``, ``spin_time``.
    """
    session.discover(options.spin_time)
    node = session.node
    topics = [(name, ', '.join(types)) for name, types in node.get_topic_names_and_types()
              if options.include_hidden_topics or not topic_or_service_is_hidden(name)]
    if options.count_topics:
        say(len(topics))
    elif options.verbose:
        say(_counted('Published', 'publisher', topics, node.count_publishers))
        say(_counted('Subscribed', 'subscriber', topics, node.count_subscribers))
    else:
        for name, types in topics:
            say(f'{name} [{types}]' if options.show_types else name)


def _counted(
        title: str, end: str, topics: list[tuple[str, str]], count: Callable[[str], int]) -> str:
    lines = [f'{title} topics:']
    for name, types in topics:
        if n := count(name):
            lines.append(f' * {name} [{types}] {n} {end}{"s" if n > 1 else ""}')
    return '\n'.join(lines) + '\n'


def show_info(session: Session, options: argparse.Namespace) -> None:
    """Print type and number of ends of a topic.

    Parameters
    ----------
    session
        The session.
    options
        ``topic_name``, ``verbose``, ``spin_time``.

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
    gap = '\n\n' if options.verbose else '\n'
    say(f'Type: {types[0] if len(types) == 1 else types}', end=gap)
    for title, count, ends in (
            ('Publisher', node.count_publishers, node.get_publishers_info_by_topic),
            ('Subscription', node.count_subscribers, node.get_subscriptions_info_by_topic)):
        say(f'{title} count: {count(name)}', end=gap)
        for end in ends(name) if options.verbose else ():
            say(end, end=gap)


def echo(session: Session, options: argparse.Namespace) -> None:
    """Print the messages of a topic.

    Parameters
    ----------
    session
        The session.
    options
        ``topic_name``, ``message_type`` and how to print and to subscribe.

    Raises
    ------
    ToolError
        If the type is not known, or has no such field.
    """
    name = session.full_name(options.topic_name)
    kind = (_load(options.message_type) if options.message_type
            else _published_type(session, name, options.topic_name, options.spin_time))
    layout = Layout(None if options.full_length else options.truncate_length,
                    not options.no_arr, not options.no_str, options.flow_style)
    printed = 0

    def show(message: Any) -> None:
        nonlocal printed
        # With --once, more than one message may be waiting.
        if not (options.once and printed):
            _print_message(_select(message, options.field), layout, options.csv)
            printed += 1
    subscription = session.node.create_subscription(
        kind, name, show, _matching_qos(session, name, options))
    try:
        session.until(lambda: bool(options.once and printed), options.timeout)
    finally:
        session.node.destroy_subscription(subscription)


def _print_message(value: Any, layout: Layout, csv: bool) -> None:
    if not hasattr(value, 'get_fields_and_field_types'):
        say(value, end='\n---\n')
    elif csv:
        say(as_csv(value, layout))
    else:
        say(as_yaml(value, layout), end='---\n')


def _select(message: Any, field: str | None) -> Any:
    for part in filter(None, (field or '').split('.')):
        try:
            message = getattr(message, part)
        except AttributeError as error:
            raise ToolError(f"Invalid field '{field}': {error}") from None
    return message


def _matching_qos(session: Session, name: str, options: argparse.Namespace) -> QoSProfile:
    """Return what hears all present publishers, and hears most."""
    ends = [info.qos_profile for info in session.node.get_publishers_info_by_topic(name)]
    reliable = bool(ends) and all(e.reliability == ReliabilityPolicy.RELIABLE for e in ends)
    latched = bool(ends) and all(e.durability == DurabilityPolicy.TRANSIENT_LOCAL for e in ends)
    qos = QoSPresetProfiles.get_from_short_key('sensor_data')
    return QoSProfile(
        depth=options.qos_depth or qos.depth, history=qos.history,
        reliability=(ReliabilityPolicy.get_from_short_key(options.qos_reliability)
                     if options.qos_reliability else
                     ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT),
        durability=(DurabilityPolicy.get_from_short_key(options.qos_durability)
                    if options.qos_durability else
                    DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE))


def show_rate(session: Session, options: argparse.Namespace) -> None:
    """Print once a second how often messages of a topic come.

    Parameters
    ----------
    session
        The session.
    options
        ``topic_name``, ``window_size``.

    Raises
    ------
    ToolError
        If the topic's type cannot be loaded.
    """
    name = session.full_name(options.topic_name)
    kind = _published_type(session, name, options.topic_name, None)
    rate, clock = Rate(options.window_size), Clock(clock_type=ClockType.STEADY_TIME)
    # Raw: nothing is read of the messages, which may be long.
    session.node.create_subscription(
        kind, name, lambda _: rate.add(clock.now().nanoseconds), qos_profile_sensor_data,
        raw=True)

    def report() -> None:
        if text := rate.report():
            say(text)
    steady_timer(session.node, 1.0, report)
    session.until(lambda: False)


def _published_type(
        session: Session, name: str, asked: str, patience_s: float | None) -> type:
    """Wait for a topic, and return the class of its messages."""
    def types() -> list[str]:
        return dict(session.node.get_topic_names_and_types()).get(name, [])
    first_s = _DISCOVERY_S if patience_s is None else patience_s
    if not session.until(lambda: bool(types()), first_s):
        say(f'WARNING: topic [{asked}] does not appear to be published yet')
        if patience_s is not None:
            raise ToolError('Could not determine the type for the passed topic')
        session.until(lambda: bool(types()))
    found = types()
    if len(found) > 1:
        raise ToolError(f"Cannot echo topic '{asked}', as it contains more than one type: "
                        f'[{", ".join(found)}]')
    return _load(found[0])


def _load(name: str) -> type:
    """Return the class of messages that a name like ``std_msgs/msg/String`` stands for."""
    try:
        package, folder, kind = name.split('/')
        return getattr(importlib.import_module(f'{package}.{folder}'), kind)
    except (ValueError, ImportError, AttributeError):
        raise ToolError(f"The message type '{name}' is invalid") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='topic', description='List topics, print messages, measure rates.')
    verbs = parser.add_subparsers(required=True, metavar='list | echo | hz | info')
    add = verbs.add_parser('list', help=show_list.__doc__.partition('\n')[0])
    add.set_defaults(verb=show_list)
    add.add_argument('-t', '--show-types', action='store_true', help='also the types')
    add.add_argument('-c', '--count-topics', action='store_true', help='only how many')
    add.add_argument('-v', '--verbose', action='store_true', help='also who is at their ends')
    add.add_argument('--include-hidden-topics', action='store_true', help='also hidden ones')
    _add_spin_time(add)
    add = verbs.add_parser('info', help=show_info.__doc__.partition('\n')[0])
    add.set_defaults(verb=show_info)
    add.add_argument('topic_name')
    add.add_argument('-v', '--verbose', action='store_true', help='also every end')
    _add_spin_time(add)
    add = verbs.add_parser('hz', help=show_rate.__doc__.partition('\n')[0])
    add.set_defaults(verb=show_rate)
    add.add_argument('topic_name')
    add.add_argument('-w', '--window', dest='window_size', type=_positive, default=_WINDOW,
                     metavar='N', help=f'latest intervals to average over (default: {_WINDOW})')
    add = verbs.add_parser('echo', help=echo.__doc__.partition('\n')[0])
    add.set_defaults(verb=echo)
    _add_echo_options(add)
    return parser


def _add_echo_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('topic_name')
    parser.add_argument('message_type', nargs='?', help='like std_msgs/msg/String')
    parser.add_argument('--once', action='store_true', help='end after one message')
    parser.add_argument('--timeout', type=float, metavar='N', help='end after N seconds')
    parser.add_argument('--field', help='only this field; a dot leads to fields within')
    parser.add_argument('--csv', action='store_true', help='a line of numbers for each message')
    parser.add_argument('--flow-style', action='store_true', help='collections on one line')
    parser.add_argument('-f', '--full-length', action='store_true', help='cut nothing off')
    parser.add_argument('-l', '--truncate-length', type=_positive, default=_LONGEST, metavar='N',
                        help=f'cut arrays and strings here (default: {_LONGEST})')
    parser.add_argument('--no-arr', action='store_true', help='of arrays type and length only')
    parser.add_argument('--no-str', action='store_true', help='of strings the length only')
    parser.add_argument('--qos-depth', type=_positive, metavar='N', help='length of the queue')
    parser.add_argument('--qos-reliability', choices=('reliable', 'best_effort'),
                        help='default: as the publishers')
    parser.add_argument('--qos-durability', choices=('transient_local', 'volatile'),
                        help='default: as the publishers')
    _add_spin_time(parser)


def _add_spin_time(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--spin-time', type=float, default=_DISCOVERY_S, metavar='S',
                        help=f'how long to wait for discovery (default: {_DISCOVERY_S:g} s)')


def _positive(text: str) -> int:
    if int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text}, expected at least 1')
    return int(text)


if __name__ == '__main__':
    sys.exit(main())
