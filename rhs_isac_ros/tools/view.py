"""``scripts/view``: shows a running network or a recording in the browser."""

import argparse
import itertools
import signal
import sys
import time
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from rhs_isac_ros.calibration import CalibrationError, load_surface
from rhs_isac_ros.executables import exit_code_of, print_error
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.model.arguments import (
    ArgumentParser,
    check_distinct,
    input_file,
    integer,
    output_file,
    positive_float,
    positive_int,
)
from rhs_isac_ros.model.optional import MissingLibraryError
from rhs_isac_ros.positioning import Motion
from rhs_isac_ros.ros.command_line import parse
from rhs_isac_ros.ros.recording import RecordingError, read_scenario
from rhs_isac_ros.ros.run import run
from rhs_isac_ros.tools.rerun_stream import RerunStream
from rhs_isac_ros.tools.session import print_now
from rhs_isac_ros.tools.view_node import ViewNode
from rhs_isac_ros.tools.view_posteriors import Posteriors
from rhs_isac_ros.tools.view_recording import entries

_PROGRAM = 'view'
_PORT = 9090
_POLL_S = 0.2
_SWITCH_INTERVAL_S = 5e-4


def main(arguments: Sequence[str] | None = None) -> int:
    """Show a network or a recording until a signal arrives, or write a file.

    Parameters
    ----------
    arguments
        Command line including ROS arguments; by default that of the process.

    Returns
    -------
    int
        Exit code: 0, including after a signal; 1 if rerun is missing, the port is in use, or no
        cycle was observed that could be saved; 2 if an argument or a file is invalid.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = _parser()
    options = parse(parser, arguments)
    if options.file is None and (options.track or options.namespace):
        parser.error('arguments --track and --namespace: expected together with a recording; '
                     'for a running network, --ros-args -r __ns:=/lab selects the namespace')
    if options.track_speed and not options.track:
        parser.error('argument --track-speed: expected together with --track')
    check_distinct(parser, {'file': options.file, '--config': options.config,
                            '--calibration': options.calibration}, {'--save': options.save})
    try:
        stream = RerunStream()
        try:
            return _show(stream, options, [_PROGRAM, *arguments])
        finally:
            # After `close`, there is nothing left to discard.
            stream.discard()
    except (RecordingError, ScenarioError, CalibrationError, OSError) as error:
        print_error(error, _PROGRAM)
        return 2
    except (MissingLibraryError, _PortError, _NoCycleError) as error:
        print_error(error, _PROGRAM)
        return 1
    except KeyboardInterrupt:
        # The handlers of signals are not installed yet while libraries are imported.
        return 0


class _PortError(RuntimeError):
    """The viewer cannot be served."""


class _NoCycleError(RuntimeError):
    """There is nothing to save."""


def _show(stream: RerunStream, options: argparse.Namespace, arguments: Sequence[str]) -> int:
    scenario = _scenario(options)
    surface = load_surface(str(options.calibration), scenario) if options.calibration else None
    posteriors = Posteriors(scenario, surface)
    _open(stream, options)
    if options.file is None:
        return _show_live(stream, scenario, posteriors, options, arguments)
    return _show_recording(stream, scenario, posteriors, options)


def _scenario(options: argparse.Namespace) -> Scenario:
    if options.config:
        return Scenario.from_yaml(options.config)
    return (options.file and read_scenario(options.file)) or Scenario()


def _open(stream: RerunStream, options: argparse.Namespace) -> None:
    """Open the file, or serve the viewer and print its address."""
    if options.save:
        stream.save(options.save)
        return
    try:
        address = stream.serve(options.port, options.bind)
    except (OSError, RuntimeError) as error:
        raise _PortError(f'{options.bind}, ports {options.port} to {options.port + 2}: {error}; '
                         'choose others with --port') from None
    print_now(address)
    if options.open:
        webbrowser.open(address)


def _show_live(
        stream: RerunStream, scenario: Scenario, posteriors: Posteriors,
        options: argparse.Namespace, arguments: Sequence[str]) -> int:
    # With many messages, the background threads would otherwise wait 5 ms for each step.
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    nodes: list[ViewNode] = []

    def create() -> list[ViewNode]:
        nodes.append(ViewNode(scenario, posteriors, stream.write))
        return nodes

    def done() -> bool:
        return bool(options.cycles) and nodes[0].view.n_ended >= options.cycles
    code = run(create, arguments, done)
    if options.save and nodes and not nodes[0].view.n_cycles:
        raise _NoCycleError(f'{options.save} is not written: {nodes[0].silence}')
    if not code:
        _finish(stream, options)
    return code


def _show_recording(
        stream: RerunStream, scenario: Scenario, posteriors: Posteriors,
        options: argparse.Namespace) -> int:
    # A list, because a handler must not take a lock.
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
    stream.write(itertools.takewhile(lambda _: not signals, entries(
        options.file, options.namespace or '/', scenario, posteriors,
        (options.track_speed or Motion.speed_mps) if options.track else None,
        options.cycles)))
    while not (signals or options.save):
        time.sleep(_POLL_S)
    _finish(stream, options)
    return 0


def _finish(stream: RerunStream, options: argparse.Namespace) -> None:
    """End the service, or complete the file and print its name."""
    stream.close()
    if options.save:
        print(options.save)


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog=_PROGRAM, description='Show a running network, or a recording, in three dimensions '
        'and in charts over the cycles: in the browser until Ctrl-C, or as a file for Rerun. ROS '
        'arguments select the namespace of a running network: --ros-args -r __ns:=/lab')
    parser.add_argument('file', nargs='?', type=input_file,
                        help='recording; by default the running network')
    parser.add_argument('--save', type=_recording_file, metavar='FILE',
                        help='write a file for Rerun, *.rrd, instead of serving the viewer')
    parser.add_argument('--cycles', type=positive_int, default=0, metavar='N',
                        help='show N cycles; the view of a running network then ends')
    parser.add_argument('--config', type=input_file, metavar='FILE',
                        help="scenario file; by default that of the recording, or the paper's "
                        'Table I')
    parser.add_argument('--calibration', type=input_file, metavar='FILE',
                        help='calibration of the surface, for the modes of the posterior; by '
                        'default that of the scenario')
    server = parser.add_argument_group('browser')
    server.add_argument('--port', type=integer(1, 65533), default=_PORT, metavar='P',
                        help=f'port of the viewer; its data use the next two (default: {_PORT})')
    server.add_argument('--bind', default='127.0.0.1', metavar='ADDRESS',
                        help='address that the viewer listens on; by default only this machine '
                        'can connect, with 0.0.0.0 any other')
    server.add_argument('--open', action='store_true', help='open the browser')
    recording = parser.add_argument_group('recording')
    recording.add_argument('--namespace', help='namespace of the recorded network (default: /)')
    recording.add_argument('--track', action='store_true',
                           help='track the users, as positioner does with prior:=track')
    recording.add_argument('--track-speed', type=positive_float, metavar='MPS',
                           help='typical speed of the users for --track (default: '
                           f'{Motion.speed_mps:g} m/s)')
    return parser


def _recording_file(text: str) -> Path:
    """Parse the path of a file that Rerun recognises by its suffix, for argparse."""
    path = output_file(text)
    if path.suffix != '.rrd':
        raise argparse.ArgumentTypeError(f'{text!r}, expected a name that ends with .rrd')
    return path


if __name__ == '__main__':
    sys.exit(exit_code_of(main))
