"""``scripts/replay FILE``: passes the received signals in a recording to estimators.

With ``--publish``, it passes them to running nodes instead; see `republish`.
"""

import argparse
import functools
import posixpath
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from rhs_isac_ros.calibration import load_surface
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.library import Library
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.cycle_log import Key, SignalLog
from rhs_isac_ros.positioning import (
    ESTIMATORS,
    BayesEstimator,
    Estimate,
    Estimator,
    EstimatorKind,
    Motion,
    Site,
    fuse,
)
from rhs_isac_ros.positioning.estimate import estimate_of
from rhs_isac_ros.positioning.site import share_left_out
from rhs_isac_ros.positioning.store import default_folder
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.positioner import Tracks
from rhs_isac_ros.ros.recording import Recorded, RecordingError, read_networks
from rhs_isac_ros.support.arguments import (
    ArgumentParser,
    input_file,
    input_path,
    positive_float,
    typed,
)
from rhs_isac_ros.support.texts import text_table
from rhs_isac_ros.system import System, add_files
from rhs_isac_ros.tools import command, republish
from rhs_isac_ros.tools.command import ToolError

# Positions, float64 [3] [m], some with velocities, [6] [m, m/s], by cycle and user.
_Positions: TypeAlias = dict[Key, np.ndarray]
# Locates a user from its signals at a time [s].
_Locate: TypeAlias = Callable[[m.ReceivedSignals, float], Estimate]


class Recording:
    """The signals of one or more surfaces in the same cycles, and their true positions.

    `logs` contains those of each surface by name, and '' for what answers the base station: the
    network itself or, in a site, the fusion. `truths` contains the positions of all cycles with
    signals and a true position, also of those without a fix, but without those of which the
    recorder, at its start or end, has missed the answer. Raises RecordingError if there are none.
    """

    def __init__(self, path: Path, namespace: str, scenarios: Mapping[str, Scenario]) -> None:
        self.path, self.logs = path, {name: SignalLog() for name in scenarios}
        for name, log in self.logs.items():
            for found in command.recorded(
                    path, posixpath.join(namespace, name), scenarios[name],
                    [*SignalLog.RECEIVES, Codebook]):
                log.add(*found)
        self.scenarios, leader = scenarios, next(iter(self.logs.values()))
        # In the order of the cycles: the clock of a recording may have gone back.
        found_in = dict(sorted({
            key: truth for log in self.logs.values() for key, signals in log.signals.items()
            if (truth := leader.truths.of(signals))}.items()))
        ended = self.logs[''].ended & found_in.keys()
        keys = [key for key in found_in if key >= min(ended, default=key)]
        self.truths: _Positions = {
            key: found_in[key].position for key in keys if key in ended or key != keys[-1]}
        self._velocities = {key: truth.velocity for key, truth in found_in.items()}
        if not self.truths:
            raise command.nothing_recorded(
                path, 'received signals with a true position', namespace)

    def live(self, name: str = '') -> _Positions:
        """Return the recorded positions."""
        return {key: found.position for key, found in self.logs[name].estimates.items()}

    def errors_m(self, positions: _Positions) -> np.ndarray:
        """Return the errors of positions, float64 [N] [m]; NaN without a position."""
        return np.array([np.linalg.norm(positions.get(key, np.full(3, np.nan))[:3] - truth)
                         for key, truth in self.truths.items()])

    def velocity_errors_mps(self, positions: _Positions) -> np.ndarray:
        """Return the errors of the velocities, float64 [n] [m/s], where there are any."""
        return np.array([np.linalg.norm(found[3:] - self._velocities[key])
                         for key, found in positions.items() if found[3:].size])


def load(path: Path, namespace: str = '/', config: Path | None = None,
         site: Site | None = None) -> Recording:
    """Load a recording of a network; `config`, a file, or `site` replaces the recorded scenario.

    Raises ScenarioError if the scenario is invalid, RecordingError if the recording is.
    """
    return Recording(path, namespace, {
        '': command.choose_scenario(config, path, namespace, site)})


def alone(functions: Mapping[str, Callable[[np.ndarray], Estimate]]) -> _Locate:
    """Return a function that locates users in single cycles; the keys are ids of codebooks."""
    return lambda signals, _: functions[signals.codebook_id](signals.stacked)


def tracked(estimators: Mapping[str, Estimator], speed_mps: float) -> _Locate:
    """Return a function that tracks users with a typical speed [m/s] over the cycles."""
    tracks = Tracks()
    return lambda signals, now_s: tracks.locate(
        signals, estimators[signals.codebook_id], speed_mps, now_s)


def locate(recording: Recording, locate_user: _Locate) -> _Positions:
    """Locate the users of a network again; those without a fix have no position."""
    return {key: _state(found) for key, found in zip(
        recording.truths, _estimates(recording, locate_user), strict=True)
        if found and found.fix}


def locate_in_site(
        recording: Recording, bounds_m: np.ndarray, table_folder: Path | None = None
) -> dict[str, _Positions]:
    """Locate the users of a site again; return the positions by surface, '' for the fusion."""
    # In the order of the node `fusion`.
    names, leader = sorted(filter(None, recording.logs)), recording.scenarios['']
    posteriors = [_estimates(recording, alone({
        codebook_id: BayesEstimator(
            System(recording.scenarios[name], codebook), table_folder, reject_outside=True,
            left_out=share_left_out(name)).posterior
        for codebook_id, codebook in _codebooks(recording, name).items()}), name)
        for name in names]
    again: dict[str, _Positions] = {name: {} for name in (*names, '')}
    for key, *found in zip(recording.truths, *posteriors, strict=True):
        sightings = [sighting for one in found if one and (sighting := one.sighting)]
        fused = fuse(sightings, bounds_m, leader.outside_probability,
                     leader.user_speed_std_mps) if sightings else None
        for name, one in zip(again, (*found, fused), strict=True):
            if one and one.fix:
                again[name][key] = _state(one)
    return again


def _estimates(
        recording: Recording, locate_user: _Locate, name: str = '') -> Iterator[Estimate | None]:
    """Yield estimates in all cycles, None without signals, in the frame of the site."""
    log, pose = recording.logs[name], recording.scenarios[name].pose
    for key in recording.truths:
        signals = log.signals.get(key)
        yield None if signals is None else locate_user(
            signals, signals.time_s(log.arrived_s[key])).to_site(pose)


def _state(estimate: Estimate) -> np.ndarray:
    state = np.append(estimate.mean, estimate.velocity)
    return state[np.isfinite(state)]


def _replay_site(options: argparse.Namespace, networks: Recorded) -> int:
    """Compare the errors of each surface and of the fusion with the recorded errors."""
    given = [name for name in (
        'publish', 'system', 'codebook', 'library', 'config', 'calibration',
        'estimator-options', 'model', 'track') if getattr(options, name.replace('-', '_'))]
    if any(kind.name != BayesEstimator.name for kind, _ in options.estimator):
        given.append('estimator')
    if given:
        # Only the leading surface has whole cycles.
        surfaces = [*networks.surfaces][:None if options.publish else 1]
        names = ', '.join(f'{options.namespace.rstrip("/")}/{name}' for name in surfaces)
        raise ToolError(f'--{given[0]}: not available for a whole site; select a surface with '
                        f'--namespace: {names}')
    leader = next(iter(networks.surfaces.values()))
    recording = Recording(options.file, options.namespace, {**networks.surfaces, '': leader})
    command.print_now(f'{len(recording.truths)} cycles')
    again = locate_in_site(recording, networks.bounds_m, default_folder())
    _print_table([
        _row(f'{label}{name or "fusion"}', recording, positions) for name in recording.logs
        for label, positions in (('live ', recording.live(name)), ('', again[name]))])
    return 0


def _conflict(options: argparse.Namespace) -> str:
    if options.publish and (options.estimator or options.estimator_options or options.model
                            or options.calibration or options.library or options.track):
        return ('argument --publish: not allowed with --estimator, --estimator-options, --model, '
                '--calibration, --library or --track, because running nodes estimate')
    kinds = options.estimator or [EstimatorKind(BayesEstimator.name)]
    try:
        options.estimator = [(kind, kind.parse(options.estimator_options)) for kind in kinds]
    except ValueError as error:
        return f'argument --estimator-options: {error}'
    ideal = next((kind.name for kind in kinds if not kind.uses_surface), '')
    if options.calibration and ideal:
        return (f'argument --calibration: not allowed with --estimator {ideal}, which assumes the '
                'surface of the scenario')
    if not options.publish and (options.topic, options.rate, options.timeout) != (
            None, republish.RATE, republish.TIMEOUT_S):
        return 'arguments --topic, --rate and --timeout: expected together with --publish'
    if options.config and options.site:
        return 'argument --config: not allowed with --site'
    if options.track and not any(kind.uses_tracks for kind in kinds):
        return 'argument --track: expected together with --estimator bayes'
    if options.track_speed is not None and not options.track:
        return 'argument --track-speed: expected together with --track'
    if options.model and not any('model_file' in kind.options for kind in kinds):
        return 'argument --model: expected together with --estimator neural'
    return ''


def _replay(options: argparse.Namespace, arguments: list[str]) -> int:
    """Publish a recording, or compare the errors of estimators with the recorded errors."""
    if options.site:
        options.site = Site.from_yaml(options.site)
    networks = read_networks(options.file, options.site)
    if networks.is_site(options.namespace):
        return _replay_site(options, networks)
    leader = next(iter(networks.surfaces), '')
    if leader and not options.publish and posixpath.basename(
            options.namespace.rstrip('/')) != leader:
        raise RecordingError(f'{options.file}: namespace {options.namespace} has no base station, '
                             f'expected that of {leader} or of the site')
    if options.publish:
        return republish.republish(options, arguments)
    recording = load(options.file, options.namespace, options.config, options.site)
    (scenario,), (log,) = recording.scenarios.values(), recording.logs.values()
    if options.library:
        library = Library.load(options.library)
        library.check(scenario)
        log.codebooks.update(library.by_id)
    codebooks = _codebooks(
        recording, given=options.codebook and Codebook.load(options.codebook, scenario))
    names = sorted({estimate.estimator for estimate in log.estimates.values()})
    command.print_now(f'{len(recording.truths)} cycles')
    rows = [_row(f'live {", ".join(names)}', recording, recording.live())]
    surface = load_surface(str(options.calibration or ''), scenario)
    for kind, further in options.estimator:
        accepted = kind.accepted(table_folder=default_folder(), model_file=options.model or '',
                                 reject_outside=True, left_out=share_left_out(leader)) | further
        estimators = {codebook_id: kind.create(System(scenario, codebook, surface), **accepted)
                      for codebook_id, codebook in codebooks.items()}
        rows.append(_row(kind.name, recording, locate(recording, alone({
            key: functools.partial(estimate_of, one) for key, one in estimators.items()}))))
        if options.track and kind.uses_tracks:
            rows.append(_row('track', recording, locate(recording, tracked(
                estimators, options.track_speed or Motion.speed_mps))))
    _print_table(rows)
    return 0


def _print_table(rows: Sequence[Sequence[str]]) -> None:
    heads = ['', 'median error', 'root mean square', 'no fix', 'velocity, rms']
    n = 5 if any(row[-1] for row in rows) else 4
    print(text_table(heads[:n], [row[:n] for row in rows], '<>>>>'[:n]))


def _row(name: str, recording: Recording, positions: _Positions) -> list[str]:
    errors, speeds = recording.errors_m(positions), recording.velocity_errors_mps(positions)
    fixes = errors[~np.isnan(errors)]
    median, rms = ((np.median(fixes), np.sqrt(np.mean(fixes**2))) if len(fixes)
                   else (np.nan, np.nan))
    return [name, f'{median:.6f} m', f'{rms:.6f} m', str(len(errors) - len(fixes)),
            f'{np.sqrt(np.mean(speeds**2)):.6f} m/s' if len(speeds) else '']


def _codebooks(
        recording: Recording, name: str = '', given: Codebook | None = None
) -> dict[str, Codebook]:
    """Return the codebooks to assume for a surface, by the id of the recorded codebook."""
    log = recording.logs[name]
    used = sorted({signals.codebook_id for key, signals in log.signals.items()
                   if key in recording.truths})
    for codebook_id in used:
        if given and codebook_id != given.id:
            print(f'signals received with codebook {codebook_id} are evaluated with {given.id}',
                  file=sys.stderr)
        if not given and codebook_id not in log.codebooks:
            raise command.missing_codebook(recording.path, codebook_id)
    return {codebook_id: given or log.codebooks[codebook_id] for codebook_id in used}


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog='replay', description='Feed the received signals of a recording to estimators, and '
        'compare their errors with the errors of the recorded network.')
    add = parser.add_argument
    add('file', type=input_path, help='recording, or folder of ros2 bag record')
    add('--estimator', action='append', type=typed(EstimatorKind), metavar='NAME',
        help=f'{", ".join(ESTIMATORS)}, an installed plug-in or MODULE:NAME; may be repeated '
             '(default: bayes)')
    add('--estimator-options', default='', metavar='TEXT',
        help='further options of each estimator, such as log2_points=12')
    add('--track', action='store_true', help='also track the users with the estimator bayes')
    add('--track-speed', type=positive_float, metavar='MPS',
        help=f'typical speed of the users (default: {Motion.speed_mps:g} m/s)')
    add_files(parser, 'codebook', 'config', 'calibration', 'system')
    add('--library', type=input_file, metavar='FILE',
        help='library of codebooks that the network has used')
    add('--model', type=input_file, metavar='FILE', help='model of the estimator neural')
    add('--site', type=input_file, metavar='FILE',
        help='site file; by default the recorded scenarios of the surfaces')
    add('--namespace', default='/', help='namespace of the recorded network (default: /)')
    republish.add_options(parser)
    return parser


main = command.entry(_replay, _parser, _conflict)
