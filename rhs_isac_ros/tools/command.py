"""What all commands use: their entry point, nodes, recordings and tables."""

import argparse
import functools
import os
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.node import Node

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.calibration import CalibrationError
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.model.geometry import movement_warning
from rhs_isac_ros.monitoring.role_statistics import Report
from rhs_isac_ros.positioning import ModelError, Site, SiteError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, diagnostics, endpoints, topics
from rhs_isac_ros.ros.environment import check_environment
from rhs_isac_ros.ros.recording import RecordingError, read, read_networks
from rhs_isac_ros.ros.run import StartError, parse, spin
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.arguments import check_distinct
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.exits import exit_code_of
from rhs_isac_ros.support.jobs import JobError
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.system import SystemFileError, fill_in

# Errors in arguments and files.
INVALID = (StartError, RecordingError, ScenarioError, SiteError, SystemFileError, CodebookError,
           CalibrationError, ModelError, plugins.PluginError)
# Error for an option that only recordings need.
NO_NAMESPACE = ('argument --namespace: expected together with a recording; for a running network, '
                '--ros-args -r __ns:=/lab selects the namespace')
# Advice after an error about messages that do not match the scenario.
OTHER_SCENARIO = '; if the network uses another scenario, pass it with --config FILE'
_NodeT = TypeVar('_NodeT', bound=Node)


class ToolError(RuntimeError):
    """A command cannot be executed."""


def entry(
        work: Callable[[argparse.Namespace, list[str]], int],
        make_parser: Callable[[], argparse.ArgumentParser],
        conflict: Callable[[argparse.Namespace], str] = lambda options: '', *,
        takes_ros_arguments: bool = True) -> Callable[..., int]:
    """Return the main function of a command.

    The function takes arguments, by default from the command line. It returns the exit code of
    `work`; 0 after a signal or if the reader closes the output; 1 after a `ToolError`, if a
    library is missing or a file cannot be written; 2 if an argument or a file is invalid.

    Parameters
    ----------
    work
        Runs the command. Takes the options, and the command line with the name of the program.
    conflict
        Returns an error if options contradict each other, otherwise ''.
    takes_ros_arguments
        Whether the command line may contain ROS arguments.
    """
    def main(arguments: Sequence[str] | None = None) -> int:
        parser, arguments = make_parser(), sys.argv[1:] if arguments is None else list(arguments)
        if takes_ros_arguments:
            parser.epilog = 'ROS arguments select the namespace: --ros-args -r __ns:=/lab'
            options = parse(parser, arguments)
        else:
            options = parser.parse_args(arguments)
            check_environment(parser)

        def checked() -> int:
            if problem := conflict(options):
                parser.error(problem)
            fill_in(options)
            check_distinct(parser, options)
            return work(options, [parser.prog, *arguments])
        return exit_code_of(checked, INVALID, parser.prog, interrupted=0,
                            failures=(ToolError, JobError, MissingLibraryError))
    return main


#: Prints and flushes, so that the reader of a pipe receives the text at once.
print_now = functools.partial(print, flush=True)


def none_within(what: str, timeout_s: float) -> ToolError:
    """Return the error for a network that did not provide something within a time [s]."""
    return ToolError(f'{what} within {timeout_s:g} s, in the domain '
                     f'{os.environ.get("ROS_DOMAIN_ID", "0")} and this namespace')


def missing_codebook(source: object, codebook_id: str) -> RecordingError:
    """Return the error for a codebook that is neither in a source nor an option."""
    return RecordingError(f'{source}: codebook {codebook_id}: not in the recording; give its file '
                          'with --codebook FILE, or with --library FILE of replay')


def nothing_recorded(path: Path, what: str, namespace: str) -> RecordingError:
    """Return the error for a recording without messages of a network; it names the networks."""
    end = f'/{topics.NAMES[m.ReceivedSignals]}'
    others = sorted({topic.removesuffix(end) or '/' for topic, _, _ in read(path)
                     if topic.endswith(end)} - {topic_prefix(namespace).rstrip('/') or '/'})
    return RecordingError(f'{path}: no {what} in the namespace {namespace}' + (
        f'; --namespace selects one of {", ".join(others)}' if others else '') + (
        ', and --site of a replay those of a site' if len(others) > 1 else ''))


def observe(
        make: Callable[[], _NodeT], arguments: Sequence[str],
        done: Callable[[_NodeT], bool] = lambda node: False) -> _NodeT:
    """Create a node, spin it until a signal arrives or `done` returns True, and return it."""
    (node,) = spin(lambda: [make()], arguments, lambda nodes: done(nodes[0]))
    return node


def expecting_cycles(node: _NodeT, delay_s: float = 3.0) -> _NodeT:
    """Return a node that logs a warning if base stations run only in other namespaces."""
    def examine() -> None:
        spaces = {space for name, space in node.get_node_names_and_namespaces() if name == 'bs'}
        if spaces and node.get_namespace() not in spaces:
            endpoints.log(
                node, f'no base station in the namespace {node.get_namespace()}; select one with '
                f'--ros-args -r __ns:=NAME: {", ".join(sorted(spaces))}', LoggingSeverity.WARN)
    endpoints.once(node, delay_s, examine)
    return node


def subscribe_codebooks(
        node: Node, scenario: Scenario, on_codebook: Callable[[Codebook], None]) -> None:
    """Subscribe to the codebooks of a network, and drop codebooks that do not fit the scenario."""
    def receive(content: bytes, _: object) -> None:
        try:
            codebook = convert.from_bytes(convert.CodebookMessage, content).codebook()
            codebook.check(scenario)
        except (m.MessageError, CodebookError) as error:
            endpoints.log(node, f'dropped codebook: {error}', LoggingSeverity.WARN)
            return
        on_codebook(codebook)
    endpoints.subscribe(
        node, ros.Codebook, topics.CODEBOOK, receive, endpoints.LATCHED, raw=True)


def choose_scenario(config: Path | None, recording: Path | None = None,
                    namespace: str | None = None, site: Site | None = None) -> Scenario:
    """Return the scenario in a file, or else in a recording, or else the paper's Table I.

    In a recording of a site, each surface has its own scenario in its own namespace. If users may
    move too far in a cycle for it, a line on stderr says so.
    """
    found = Scenario.from_yaml(config) if config else None
    if not config and recording:
        found = read_networks(recording, site).of(namespace or '')
    scenario = found or Scenario()
    if text := movement_warning(scenario):
        print(f'warning: {text}', file=sys.stderr)
    return scenario


def topic_prefix(namespace: str) -> str:
    """Return the prefix of the full names of the topics in a namespace."""
    return f'/{namespace.strip("/")}/'.replace('//', '/')


def recorded(
        path: Path, namespace: str, scenario: Scenario, kinds: Collection[type]
) -> Iterator[tuple[Any, float]]:
    """Yield the recorded messages of a network and their times [s], in order.

    `kinds` may contain message classes, `Codebook` and `Report`. A report is yielded as a pair
    (node name, report). Raises RecordingError if the file is not a recording, or a message is
    malformed or does not fit the scenario.
    """
    prefix = topic_prefix(namespace)
    names: dict[type, str] = {**topics.NAMES, Codebook: topics.CODEBOOK}
    by_topic = {f'{prefix}{names[kind]}': kind for kind in kinds if kind is not Report}
    if Report in kinds:
        by_topic[topics.DIAGNOSTICS] = Report
    for topic, content, time_s in read(path, by_topic):
        kind = by_topic[topic]
        with translated((m.MessageError, CodebookError), RecordingError, f'{path}: {topic}'):
            if kind is Report:
                array = convert.deserialize(content, DiagnosticArray)
                yield from ((pair, time_s) for pair in diagnostics.from_ros(array, namespace))
            elif kind is Codebook:
                codebook = convert.from_bytes(convert.CodebookMessage, content).codebook()
                codebook.check(scenario)
                yield codebook, time_s
            else:
                message: m.Message = convert.from_bytes(kind, content)
                m.check(message, scenario)
                yield message, time_s
