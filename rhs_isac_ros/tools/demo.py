"""The executable ``demo``: runs each node of a network as a process, and reports on the cycles."""

import argparse
import collections
import contextlib
import functools
import itertools
import math
import os
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.utilities import try_shutdown

from rhs_isac_ros.calibration import load_surface
from rhs_isac_ros.codebook import Codebook, CodebookError, default_codebook_file
from rhs_isac_ros.codebook.library import Library
from rhs_isac_ros.frontend import RADIOS, SURFACES, Air, Waveform, make_radio, make_surface
from rhs_isac_ros.frontend.opensourceris_emulator import EmulatedBoard
from rhs_isac_ros.frontend.sigmf_recording import SAMPLES_FAILED
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.cycle_log import RECEIVES, CompleteCycle, CycleLog, CycleRecord
from rhs_isac_ros.positioning.site import Site
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.settings import PRIORS, REGION, TRACK
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.ros import endpoints, parameters, topics
from rhs_isac_ros.ros.diagnostics import TABLE_PROGRESS
from rhs_isac_ros.ros.environment import private_domain
from rhs_isac_ros.ros.observer import CycleObserver
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.ros.recording import Recorder
from rhs_isac_ros.ros.roster import MAX_USER_NODES, nodes_of
from rhs_isac_ros.ros.run import StartError, init, starting
from rhs_isac_ros.support import arguments, plugins
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.exits import on_end_signals, print_error
from rhs_isac_ros.support.pictures import write_picture
from rhs_isac_ros.support.texts import counted, text_table
from rhs_isac_ros.system import add_files
from rhs_isac_ros.tools.command import choose_scenario, entry
from rhs_isac_ros.tools.pictures import compose_cycles

# Maximum time between two complete cycles, or without progress of a node that computes [s].
_CYCLE_TIMEOUT_S = 60.0
# Steps of a cycle are repeated as often as by default, but for longer. On a busy processor, a
# position with a velocity takes several seconds, and so do the signals of a large surface.
_STEPS: dict[str, Any] = {'step_timeout_s': 20.0, 'retries': 79}
# Speed of users whom codebooks follow; faster ones move too far between two cycles.
_WALKING_MPS = 1.0
# Period of checks [s].
_PERIOD_S = 0.5
_PHASES = (m.Phase.BEACONING, m.Phase.POSITIONING, m.Phase.ESTIMATING, m.Phase.TRANSMITTING)
_HEADS = ('cycle', 'user', 'true position [m]', 'estimate [m]', 'error\n[m]', '√CRLB\n[m]',
          'beacon\n[ms]', 'sound\n[ms]', 'locate\n[ms]', 'data\n[ms]', 'capacity\n[Mbit/s]',
          'loss\n[%]')
# Name of the fusion in tables.
_FUSED = 'fused'


def add_network_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for the seed and the files of a network."""
    parser.add_argument('--seed', type=arguments.seed, default=0,
                        help='seed of all random numbers')
    parser.add_argument('--config', '--scenario', type=arguments.input_file, metavar='FILE',
                        help="scenario file; by default the paper's Table I")
    parser.add_argument('--codebook', type=arguments.input_file, metavar='FILE',
                        help='codebook file; by default codebook_NAME beside the scenario file '
                             'NAME, or else the codebook of the package')


def load_files(config: Path | None, codebook: Path | None) -> tuple[Scenario, Path]:
    """Return a scenario, and the absolute path of a codebook file that fits it.

    Raises ScenarioError or CodebookError if a file is invalid or the codebook does not fit.
    """
    scenario = choose_scenario(config)
    beside = config and config.with_name(f'codebook_{config.name}')
    if beside and beside.is_file():
        codebook = codebook or beside
    codebook_file = Path(codebook or default_codebook_file()).resolve()
    Codebook.load(codebook_file, scenario)
    return scenario, codebook_file


def start_network(
        processes: Processes, users: int, scenario: Scenario, *, together: bool = False,
        composed: bool = False, surfaces: Collection[str] = (), **given: Any) -> None:
    """Start each node of a network, or of a site with `surfaces`, in a separate process.

    If `together`, the users are in one node; if `composed`, all nodes are in one process. Users
    walk at random, by default at the maximum speed of the scenario, which in a site is that of the
    first surface. Each parameter in `given` applies to all nodes that have it; None selects its
    default. A scenario other than Table I must also be given as ``scenario_file``, and a site as
    ``site_file``. With ``first_cycle=1``, the seed determines multipath and noise.
    """
    walking: dict[str, Any] = {'mobility': 'random_walk', 'speed_mps': scenario.max_user_speed_mps}
    given = walking | {name: value for name, value in given.items() if value is not None}
    if composed:
        processes.start('network', users=users, **given)
        return
    for one in nodes_of(users, surfaces, together):
        known = {parameter.name for parameter in parameters.NODES[one.role]}
        processes.start(one.role, one.name, namespace=one.namespace, **one.users, **{
            name: value for name, value in given.items() if name in known})


def watch(
        observer: CycleObserver, processes: Processes, cycles: int,
        on_progress: Callable[[int, int], None],
        stopped: Callable[[], bool] = lambda: False) -> str:
    """Spin an observer until it has received `cycles` complete cycles, or `stopped` is True.

    At first and whenever their number changes, `on_progress` is called with this number and with
    `cycles`. Returns the error that ended the wait, or ''. The wait continues while nodes compute
    tables, which takes minutes for large surfaces.
    """
    seen, changed_s = -1, time.monotonic()
    tables = _table_progress(observer)
    before: dict[str, str] = {}
    # This executor takes messages in the order of their arrival, also when it is late.
    with EventsExecutor() as executor:
        executor.add_node(observer)
        while seen < cycles and not stopped():
            executor.spin_once(timeout_sec=_PERIOD_S)
            complete = len(observer.complete)
            if tables != before:
                for name in sorted(tables.keys() - before.keys()):
                    print(f'{name} computes a table of templates', file=sys.stderr)
                before, changed_s = dict(tables), time.monotonic()
            if complete != seen:
                seen, changed_s = complete, time.monotonic()
                on_progress(complete, cycles)
            for name, code in processes.ended().items():
                return f'{name} ended with exit code {code}:\n{processes.log(name)}'
            if time.monotonic() - changed_s > _CYCLE_TIMEOUT_S:
                # In a site, the name of the leading surface precedes that of the role.
                (name,) = (name for name in processes.names if name.endswith('bs'))
                warnings = [line for other in processes.names if other != name
                            for line in processes.log(other).splitlines()
                            if '[WARN]' in line or '[ERROR]' in line]
                return '\n'.join([
                    f'no cycle within {_CYCLE_TIMEOUT_S:.0f} s; log of the base station, and '
                    'warnings of others:', processes.log(name), *warnings])
    return ''


def _table_progress(node: Node) -> Mapping[str, str]:
    """Return the latest progress of each node that computes a table, by name, as it changes."""
    progress: dict[str, str] = {}

    def receive(message: DiagnosticArray) -> None:
        for status in message.status:
            progress.update((status.name, pair.value) for pair in status.values
                            if pair.key == TABLE_PROGRESS)
    endpoints.subscribe(node, DiagnosticArray, topics.DIAGNOSTICS, receive, endpoints.EXCHANGE)
    return progress


def table(cycles: Sequence[CompleteCycle]) -> str:
    """Return a table with one line for each cycle."""
    return text_table(_HEADS, map(_row, cycles), '>' * len(_HEADS))


def _row(cycle: CompleteCycle) -> list[str]:
    durations = cycle.durations_s()
    return [
        str(cycle.cycle_id), str(cycle.user),
        *(' '.join(f'{coordinate:6.2f}' for coordinate in position)
          for position in (cycle.truth.position, cycle.estimate.position)),
        f'{cycle.error_m:.2f}', f'{math.sqrt(cycle.estimate.crlb_m2):.2f}',
        *(f'{1e3 * durations.get(phase, math.nan):.1f}' for phase in _PHASES),
        f'{cycle.capacity.actual_bps / 1e6:.3f}', f'{cycle.capacity.loss_percent:.3f}']


def summary(cycles: Sequence[CompleteCycle], given_up: Sequence[CycleRecord]) -> str:
    """Return statistics of one or more complete cycles, and a line for each cycle given up."""
    errors = np.array([cycle.error_m for cycle in cycles])
    bounds = np.sqrt([cycle.estimate.crlb_m2 for cycle in cycles])
    lengths = np.array([cycle.duration_s for cycle in cycles])
    losses = np.array([cycle.capacity.loss_percent for cycle in cycles])
    users = len({cycle.user for cycle in cycles})
    return '\n'.join([
        f'{len(cycles)} cycles of {users} users served, {len(given_up)} given up; codebooks: '
        f'{len({cycle.signals.codebook_id for cycle in cycles})}',
        f'position error: median {np.median(errors):.2f} m, root mean square '
        f'{np.sqrt(np.mean(errors**2)):.2f} m; median √CRLB {np.median(bounds):.2f} m',
        f'cycle: median {1e3 * np.nanmedian(lengths):.1f} ms; estimator: median '
        f'{1e3 * np.median([cycle.estimate.latency_s for cycle in cycles]):.1f} ms',
        f'capacity: median {np.median([c.capacity.actual_bps for c in cycles]) / 1e6:.2f} '
        f'Mbit/s; loss: median {np.median(losses):.3f} %, worst {losses.max():.3f} %',
        *_abandoned(given_up)])


def _abandoned(given_up: Sequence[CycleRecord]) -> list[str]:
    return [f'cycle {record.cycle_id} of user {record.user} given up: {record.outcome}'
            for record in given_up]


class SiteObserver(CycleObserver):
    """Collects the cycles of the leader, the positions of all, and the carriers of the data.

    With a `recorder`, which the caller closes, it also records the topics of the site.
    """

    def __init__(self, site: Site, recorder: Recorder | None = None, **options: Any) -> None:
        super().__init__(recorder, receives=(), **options)
        endpoints.subscribe_messages(
            self, RECEIVES, None, self.observe, exchange=endpoints.OBSERVATION,
            prefix=f'/{site.leader}/')
        # By cycle, for each surface and for the fusion.
        self.estimates: dict[str, dict[int, m.PositionEstimate]] = {}
        # By cycle, the surface that delivered the uplink data.
        self.carriers: dict[int, str] = {}
        for name, scenario, prefix in [
                *((name, one.scenario, f'/{name}/') for name, one in site.surfaces.items()),
                (_FUSED, None, '/')]:
            self.estimates[name] = {}
            endpoints.subscribe_messages(
                self, [m.PositionEstimate, m.Data], scenario, functools.partial(self._keep, name),
                on_foreign=lambda message: None, exchange=endpoints.OBSERVATION, prefix=prefix)

    def _keep(self, name: str, message: m.Message, *_: object) -> None:
        match message:
            case m.PositionEstimate():
                self.estimates[name][message.cycle_id] = message
            case m.Data(direction=m.Direction.UPLINK, stage=m.Stage.DELIVERED):
                self.carriers[message.cycle_id] = name

    @property
    def complete(self) -> Sequence[CompleteCycle]:
        """Cycles with a position of the fusion, from the first one that all surfaces located."""
        return list(itertools.dropwhile(
            lambda cycle: any(cycle.cycle_id not in one for one in self.estimates.values()),
            (cycle for cycle in self.log.complete
             if cycle.cycle_id in self.estimates[_FUSED] and cycle.cycle_id in self.carriers)))

    def errors_m(self, cycle: CompleteCycle) -> dict[str, float]:
        """Return the error of each surface and of the fusion in a cycle [m]; NaN without a fix."""
        return {name: float(np.linalg.norm(estimates[cycle.cycle_id].position
                                           - cycle.truth.position))
                if cycle.cycle_id in estimates else math.nan
                for name, estimates in self.estimates.items()}


def site_lines(observer: SiteObserver) -> Iterator[str]:
    """Yield a table with a line for each cycle, the errors of each surface, and its data."""
    cycles = observer.complete
    errors_m = [observer.errors_m(cycle) for cycle in cycles]
    names = [*observer.estimates]
    heads = ('cycle', 'user', 'true position [m]', *(f'{name}\n[m]' for name in names), 'data')
    yield text_table(heads, (
        (str(cycle.cycle_id), str(cycle.user),
         ' '.join(f'{coordinate:6.2f}' for coordinate in cycle.truth.position),
         *(f'{error_m:.3f}' for error_m in of_cycle.values()),
         observer.carriers.get(cycle.cycle_id, ''))
        for cycle, of_cycle in zip(cycles, errors_m, strict=True)), '>' * len(heads))
    for name in names:
        found = np.array([of_cycle[name] for of_cycle in errors_m])
        found = found[np.isfinite(found)]
        yield (f'{name}: {len(found)} positions, root mean square error '
               f'{np.sqrt(np.mean(found**2)) if len(found) else math.nan:.3f} m')
    yield _carriage(observer, cycles)


def _carriage(observer: SiteObserver, cycles: Sequence[CompleteCycle]) -> str:
    """Describe how many cycles each surface carried, and how often users changed the surface."""
    latest: dict[int, str] = {}
    n_handovers = 0
    for cycle in cycles:
        carrier = observer.carriers[cycle.cycle_id]
        n_handovers += latest.get(cycle.user, carrier) != carrier
        latest[cycle.user] = carrier
    carried = collections.Counter(observer.carriers[cycle.cycle_id] for cycle in cycles)
    return (f'data: {", ".join(f"{n} over {name}" for name, n in sorted(carried.items()))}; '
            f'{counted(n_handovers, "handover")}')


def _demonstrate(options: argparse.Namespace, _: list[str]) -> int:
    """Return 0 if every cycle was served or had no fix, even after a signal; otherwise 1."""
    try:
        demonstration = (_SiteDemonstration if options.site else _Demonstration)(options)
    except CodebookError as error:
        raise CodebookError(f'{error}; to create a codebook for a scenario: python3 -m '
                            'rhs_isac_ros.codebook --scenario FILE --output FILE') from None
    os.environ.update(private_domain())
    return _run(demonstration, options)


def _conflict(options: argparse.Namespace) -> str:
    defaults = _parser()
    others = [name for name in (
        'system', 'config', 'codebook', 'follow', 'calibration', 'surface', 'port', 'radio',
        'radio_options', 'samples', 'picture')
        # Defaults of files are texts.
        if str(getattr(options, name)) != str(defaults.get_default(name))]
    return (f'argument --{others[0].replace("_", "-")}: not allowed with --site'
            if options.site and others else '')


def follow(options: argparse.Namespace) -> None:
    """Select the tracks as prior; without a library, fill in that of the band plan."""
    options.prior = TRACK
    if options.follow is True:
        folder = default_codebook_file().parent
        options.follow = folder / 'library_bandplan.npz'
        options.config = options.config or folder / 'bandplan.yaml'
        options.codebook = options.codebook or folder / 'codebook_bandplan.yaml'


def _check_front_end(options: argparse.Namespace, scenario: Scenario) -> None:
    """Raise StartError if the options select a surface or a radio that `channel` would refuse."""
    causes = ValueError, plugins.PluginError
    with translated(causes, StartError):
        load_surface(str(options.calibration or ''), scenario)
    with translated(causes, StartError, 'argument --surface'):
        port = {'port': options.port} if options.port else {}
        make_surface(options.surface, scenario.n_elements, **port).close()
    with translated(causes, StartError, 'argument --radio'):
        radio = make_radio(options.radio, scenario, Air(scenario, np.random.default_rng(0)),
                           **arguments.parse_options(options.radio_options or ''))
    radio.close()
    if options.samples and not isinstance(radio.modem, Waveform):
        raise StartError(f'argument --samples: the radio {options.radio} has no samples')


class _Demonstration:
    """A network with one surface: its parameters, observer, recording and report."""

    site: Site | None = None
    recorder: Recorder | None = None

    def __init__(self, options: argparse.Namespace) -> None:
        if options.follow:
            follow(options)
        self.scenario, codebook_file = load_files(options.config, options.codebook)
        if options.follow:
            Library.load(options.follow).check(self.scenario)
        _check_front_end(options, self.scenario)
        self.files = {'scenario_file': options.config, 'codebook_file': codebook_file}
        self.options = options
        self.board = EmulatedBoard() if options.port == 'emulated' else None

    def start(self, processes: Processes, together: bool) -> None:
        """Begin the recording, if any, and start all processes."""
        if self.options.record:
            self.recorder = Recorder(self.options.record, self.scenario, self.site)
        options, port = self.options, self.board.port if self.board else self.options.port
        start_network(
            processes, options.users, self.scenario, together=together,
            surfaces=self.site.surfaces if self.site else (),
            first_cycle=1, seed=options.seed, **_STEPS, **self.files,
            prior=options.prior, library_file=options.follow, calibration_file=options.calibration,
            states_file=options.calibration, surface=options.surface,
            surface_options=f'port={shlex.quote(port)}' if port else None,
            # Other radios have noise of their own.
            radio=options.radio, radio_options=options.radio_options,
            samples_folder=options.samples, receiver_noise=options.radio == 'emulated',
            speed_mps=_WALKING_MPS if options.follow else None,
            # The parameter does not admit 0.
            track_speed_mps=None if options.prior == REGION else _WALKING_MPS if options.follow
            else max(self.scenario.max_user_speed_mps, 0.01))

    def observer(self, log: CycleLog) -> CycleObserver:
        """Create the observer of the cycles."""
        return CycleObserver(self.recorder, log=log, **WITHOUT_SERVICES)

    @property
    def failure(self) -> str:
        """The reason why the recording failed, or ''."""
        return self.recorder.failure if self.recorder else ''

    def report(self, log: CycleLog) -> None:
        """Print and draw at least one complete cycle."""
        print(table(log.complete))
        print(summary(log.complete, log.given_up))
        write_picture(self.options.picture, compose_cycles(log.complete, self.scenario))
        print(f'picture: {self.options.picture}')


class _SiteDemonstration(_Demonstration):
    """A site, in which one base station leads, and the other surfaces follow."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.site = site = Site.from_yaml(options.site)
        self.scenario = site.surfaces[site.leader].scenario
        self.files, self.options, self.board = {'site_file': options.site.resolve()}, options, None

    def observer(self, log: CycleLog) -> CycleObserver:
        assert self.site
        self._observer = SiteObserver(self.site, self.recorder, log=log, **WITHOUT_SERVICES)
        return self._observer

    def report(self, log: CycleLog) -> None:
        for line in [*site_lines(self._observer), *_abandoned(log.given_up)]:
            print(line)


def _run(demonstration: _Demonstration, options: argparse.Namespace) -> int:
    """Run the network until the cycles are complete, report them, and return the exit code."""
    # A signal must not interrupt the recorder while it writes.
    signals: list[int] = []
    on_end_signals(lambda number, _: signals.append(number))
    log, code = CycleLog(), 0
    together = options.users > MAX_USER_NODES
    if together:
        print(f'the {options.users} users run in one process', file=sys.stderr)
    with (tempfile.TemporaryDirectory(prefix='rhs_isac_ros.') as logs,
          contextlib.ExitStack() as stack):
        # The processes run until the cycles have been observed.
        with Processes(Path(logs), {'ROS_LOG_DIR': logs}) as processes:
            try:
                demonstration.start(processes, together)
                if demonstration.board:
                    stack.enter_context(demonstration.board)
                problem = '' if signals else _observe(
                    log, processes, demonstration, options.cycles,
                    lambda: bool(signals or demonstration.failure))
            finally:
                if demonstration.recorder:
                    demonstration.recorder.close()
            processes.interrupt()
            on_end_signals(signal.default_int_handler)
            with contextlib.suppress(KeyboardInterrupt):
                code = _report(log, demonstration, options, problem)
        # The node `channel` writes the last samples when it ends.
        if options.samples and 'channel' in processes.names:
            for line in processes.log('channel').splitlines():
                if SAMPLES_FAILED in line:
                    print_error(line.partition('[channel]: ')[2], 'demo')
                    code = 1
    return code


def _observe(
        log: CycleLog, processes: Processes, demonstration: _Demonstration, cycles: int,
        stopped: Callable[[], bool]) -> str:
    """Observe a number of cycles, and return the error that ended the observation, or ''."""
    init(['demo'])
    with starting():
        observer = demonstration.observer(log)
    try:
        problem = watch(observer, processes, cycles, _show_progress, stopped)
        # The executor may have processed further messages at once.
        if len(complete := observer.complete[:cycles]) == cycles:
            log.cut(complete[-1].ended_s)
        return problem
    finally:
        observer.destroy_node()  # type: ignore[no-untyped-call]
        try_shutdown()


def _show_progress(complete: int, goal: int) -> None:
    if complete == 0:
        print(f'network started with ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}, '
              'waiting for the first cycle', file=sys.stderr)
    elif sys.stderr.isatty():
        print(f'\rcycle {min(complete, goal)} of {goal}', end='\n' if complete >= goal else '',
              file=sys.stderr, flush=True)
    elif complete % 10 == 0 or complete >= goal:
        print(f'cycle {min(complete, goal)} of {goal}', file=sys.stderr)


def _report(
        log: CycleLog, demonstration: _Demonstration, options: argparse.Namespace,
        problem: str) -> int:
    if log.complete:
        demonstration.report(log)
    if options.record and not demonstration.failure:
        print(f'recording: {options.record}')
    if problem := problem or demonstration.failure:
        print_error(problem, 'demo')
    return 1 if problem or log.failed else 0


def _parser() -> argparse.ArgumentParser:
    parser = arguments.ArgumentParser(
        prog='demo',
        description='Start a network, every node as a process, and report on its cycles.')
    add = parser.add_argument
    add('--users', type=arguments.integer(1, MAX_USERS), default=2, help='number of users')
    add('--cycles', type=arguments.positive_int, default=20, help='cycles to wait for')
    add_network_options(parser)
    add_files(parser, 'calibration', 'system')
    add('--surface', metavar='NAME', default='emulated',
        help=f'surface that shows the configurations: {", ".join(SURFACES)}, or a plug-in')
    add('--port', metavar='PORT',
        help='port of the surface, or emulated: an emulated board Open Source RIS')
    add('--site', type=arguments.input_file, metavar='FILE',
        help='site file, instead of --config and --codebook')
    add('--radio', metavar='NAME', default='emulated',
        help=f'radio that measures the pilots: {", ".join(RADIOS)}, or a plug-in')
    add('--radio-options', metavar='OPTIONS', help='options of the radio, as in path=samples')
    add('--samples', metavar='FOLDER',
        help='folder in which the samples of the radio are recorded (SigMF)')
    add('--prior', choices=PRIORS, default=REGION,
        help='prior of the positions: the region, or the track of each user')
    add('--follow', nargs='?', type=arguments.input_file, const=True, metavar='LIBRARY',
        help='follow the tracks of walking users, at 1 m/s, with the codebooks of a library; by '
             'default, with the band plan and its library')
    add('--record', type=arguments.output_file, metavar='FILE', help='recording to write (MCAP)')
    add('--picture', type=arguments.picture_file, default='demo.png', metavar='FILE',
        help='file to draw: PNG, PDF or SVG')
    return parser


main = entry(_demonstrate, _parser, _conflict, takes_ros_arguments=False)
