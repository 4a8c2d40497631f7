"""``scripts/calibrate``: estimates a surface, or the multipath, from pilots at known positions.

The pilots come from a recording or a running network whose users publish their true positions, or
from arrays in a file. Poses of the surfaces of a site are estimated from users at unknown
positions.
"""

import argparse
import functools
import itertools
import posixpath
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rclpy.node import Node

from rhs_isac_ros.calibration import CalibrationError, Pilots
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.experiments import calibrate
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import stands_still
from rhs_isac_ros.monitoring.cycle_log import SignalLog
from rhs_isac_ros.positioning import Sighting, Site
from rhs_isac_ros.positioning.alignment import PoseError, estimate_pose
from rhs_isac_ros.positioning.site import SiteError, site_text
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.fusion import sighting_of
from rhs_isac_ros.ros.endpoints import subscribe_messages
from rhs_isac_ros.ros.parameters import WITHOUT_SERVICES
from rhs_isac_ros.ros.recording import RecordingError, read_networks
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    positive_float,
    positive_int,
)
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.files import save_or_rescue, write_whole
from rhs_isac_ros.tools import command

# The messages that pilots consist of.
_RECEIVES = (m.GroundTruth, m.ReceivedSignals)
_CYCLES = 200
_SITE_OUTPUT = Path('site_calibrated.yaml')
_NOT_OF_SITES = ('file', 'multipath', 'states', 'board', 'system', 'config', 'codebook',
                 'calibration', 'jobs', 'dask')
_TIMEOUT_S = 600.0


class PilotLog(SignalLog):
    """Collects pilots, also of cycles without a fix, which may require the calibration.

    Users have to stand still: the pilots of a cycle have one position.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__()
        self._scenario = scenario

    @property
    def n_pilots(self) -> int:
        """Number of pilots whose position and codebook are known."""
        return len(self._known())

    @property
    def missing_codebooks(self) -> list[str]:
        """Ids of unknown codebooks with which signals were received."""
        return sorted({signals.codebook_id for signals in self.signals.values()}
                      - self.codebooks.keys())

    def pilots(self) -> list[Pilots]:
        """Return the pilots whose position and codebook are known, grouped by codebook."""
        groups: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for signals, truth in self._known():
            groups.setdefault(signals.codebook_id, []).append(
                (self._scenario.pose.to_surface(truth.position), signals.stacked))
        return [Pilots(self.codebooks[codebook_id], *map(np.array, zip(*group, strict=True)))
                for codebook_id, group in groups.items()]

    @property
    def n_moving(self) -> int:
        """Number of cycles that are left out because their users moved too far."""
        return sum(not self._is_at_rest(truth) for signals in self.signals.values()
                   if (truth := self.truths.of(signals)))

    def _is_at_rest(self, truth: m.GroundTruth) -> bool:
        return stands_still(self._scenario, float(np.linalg.norm(truth.velocity)))

    def _known(self) -> list[tuple[m.ReceivedSignals, m.GroundTruth]]:
        return [(signals, truth) for signals in self.signals.values()
                if (truth := self.truths.of(signals)) and signals.codebook_id in self.codebooks
                and self._is_at_rest(truth)]


class CalibratorNode(Node):
    """Collects the pilots of a running network."""

    def __init__(self, log: PilotLog, scenario: Scenario) -> None:
        super().__init__('calibrator', **WITHOUT_SERVICES)
        subscribe_messages(self, _RECEIVES, scenario, log.add, on_foreign=lambda message: None)
        command.subscribe_codebooks(self, scenario, log.add)


class PosteriorLog:
    """Collects the posteriors of the surfaces of a site, by cycle and user."""

    def __init__(self, site: Site) -> None:
        self._names = [*site.surfaces]
        self._found: dict[tuple[int, int], dict[str, Sighting]] = {}

    def add(self, name: str, message: m.Message, *_: object) -> None:
        """Add a posterior of a surface."""
        assert isinstance(message, m.Posterior)
        self._found.setdefault((message.cycle_id, message.user), {})[name] = sighting_of(message)

    def pairs(self, one: str, other: str) -> tuple[list[Sighting], list[Sighting]]:
        """Return the sightings by both surfaces of users that they located in one cycle."""
        both = [found for found in self._found.values() if {one, other} <= found.keys()]
        return [found[one] for found in both], [found[other] for found in both]

    @property
    def n_pairs(self) -> int:
        """Smallest number of users that the first surface and another one located together."""
        first, *others = self._names
        return min(len(self.pairs(first, other)[0]) for other in others)


class AlignerNode(Node):
    """Collects the posteriors in the namespaces of the surfaces of a running site."""

    def __init__(self, log: PosteriorLog, site: Site) -> None:
        super().__init__('calibrator', **WITHOUT_SERVICES)
        for name, one in site.surfaces.items():
            subscribe_messages(
                self, [m.Posterior], one.scenario, functools.partial(log.add, name),
                on_foreign=lambda message: None, prefix=f'{name}/')


def _collect(make: Callable[[], Node], count: Callable[[], int], what: str,
             options: argparse.Namespace, arguments: list[str]) -> None:
    """Spin a node until `count` has reached the number in the options, or raise ToolError."""
    end_s = time.monotonic() + options.timeout
    command.observe(
        make, arguments, lambda _: count() >= options.cycles or time.monotonic() > end_s)
    if count() < options.cycles:
        raise command.none_within(f'{count()} of {options.cycles} {what}', options.timeout)


def _align(options: argparse.Namespace, arguments: list[str]) -> int:
    """Estimate the poses of all surfaces of a site but the first, and write a site file."""
    site = Site.from_yaml(options.site)
    if len(site.surfaces) < 2:
        raise SiteError(f'{options.site}: surfaces: one, expected at least two')
    log = PosteriorLog(site)
    _collect(lambda: AlignerNode(log, site), lambda: log.n_pairs,
             'users located by two surfaces', options, arguments)
    first, *others = site.surfaces
    poses = {}
    for name in others:
        try:
            pose = estimate_pose(*log.pairs(first, name), site.bounds_m)
        except PoseError as error:
            raise SiteError(f'{name}: {error}') from None
        change = site.surfaces[name].pose.error_of(pose)
        std = np.sqrt(np.diagonal(pose.covariance))
        print(f'{name}: moved by {change[:3].round(3)} m, turned by '
              f'{np.degrees(change[3:]).round(2)} deg; standard deviations {std[:3].round(3)} m, '
              f'{np.degrees(std[3:]).round(2)} deg', flush=True)
        poses[name] = pose
    save_or_rescue(
        lambda path: write_whole(path, site_text(options.site, poses, path.parent)),
        options.output)
    print(options.output)
    return 0


def _calibrate(options: argparse.Namespace, arguments: list[str]) -> int:
    if options.site:
        return _align(options, arguments)
    needs_none = options.states or options.file and options.file.suffix == calibrate.ARRAYS
    scenario = command.choose_scenario(
        options.config, None if needs_none else options.file, options.namespace)
    with translated(ValueError, CalibrationError):
        pilots = None if needs_none else _collected(options, scenario, arguments)
    calibrate.estimate(options, scenario, pilots)
    return 0


def _collected(
        options: argparse.Namespace, scenario: Scenario, arguments: list[str]) -> list[Pilots]:
    log = PilotLog(scenario)
    if options.file:
        # Only the leading surface of a site records true positions, in the frame of the site.
        others = read_networks(options.file).surfaces
        for found, _ in itertools.chain(
                command.recorded(
                    options.file, options.namespace, scenario, [*_RECEIVES, Codebook]),
                *(command.recorded(options.file, posixpath.join(posixpath.dirname(
                    options.namespace.rstrip('/')), name), other, [m.GroundTruth])
                  for name, other in others.items())):
            log.add(found)
    else:
        _collect(lambda: command.expecting_cycles(CalibratorNode(log, scenario)),
                 lambda: log.n_pilots, 'pilots', options, arguments)
    if options.codebook:
        codebook = Codebook.load(options.codebook, scenario)
        log.codebooks.update(dict.fromkeys(log.missing_codebooks, codebook))
    source = options.file or 'network'
    if log.missing_codebooks:
        raise command.missing_codebook(source, log.missing_codebooks[0])
    if log.n_moving:
        print(f'calibrate: {source}: {log.n_moving} cycles of users who moved are left out',
              file=sys.stderr)
    if not (pilots := log.pilots()):
        what = 'received signals with a true position'
        raise (command.nothing_recorded(options.file, what, options.namespace) if options.file
               else RecordingError(f'network: no {what}'))
    return pilots


def _conflict(options: argparse.Namespace) -> str:
    if options.site and (others := calibrate.given(options, _NOT_OF_SITES)):
        return f'argument --site: not allowed with {others}'
    if options.site and not options.output:
        options.output = _SITE_OUTPUT
    if problem := calibrate.conflict(options):
        return problem
    if options.namespace != '/' and not options.file:
        return command.NO_NAMESPACE
    if (options.file or options.states) and (options.cycles, options.timeout) != (
            _CYCLES, _TIMEOUT_S):
        return 'arguments --cycles and --timeout: expected for a running network'
    return ''


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='calibrate', description=f'{calibrate.DESCRIPTION} Without a file, the signals come '
        'from a running network.')
    add = parser.add_argument
    calibrate.add_options(parser, 'recording, or ')
    add('--site', type=input_file, metavar='FILE',
        help='estimate the poses of the surfaces of a running site, except for the first one, '
        'from users that two surfaces locate; write a site file, by default '
        f'{_SITE_OUTPUT}')
    add('--namespace', default='/', help='namespace of the recorded network (default: /)')
    add('--cycles', type=positive_int, default=_CYCLES, metavar='N',
        help='pilots, or users that two surfaces locate, to collect from a running network')
    add('--timeout', type=positive_float, default=_TIMEOUT_S, metavar='S',
        help=f'maximum time to collect the pilots (default: {_TIMEOUT_S:g} s)')
    return parser


main = command.entry(_calibrate, _parser, _conflict)
