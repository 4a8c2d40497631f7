"""Consistency of positions for all pairs of capabilities.

Problem: sites, tracks, priors, impairments and the rest are each measured alone. Are positions
also consistent where two of them meet? Each cell of the table combines two ingredients, each
ingredient with itself is a cell without another. The band plan of config/bandplan.yaml, with one
surface, exact knowledge and one cycle for each user, is what the ingredients change. A cell that
the software refuses has the reason instead of figures.

The role `channel` emulates the signals, and a part of what it draws is constant: elements, gain
and carrier, and whether a user is blocked, for each user and surface; a wrong pose for each user.
With tracks, users walk at 1 m/s and are located 20 times, in intervals of 0.1 s; otherwise every
position belongs to a new user. All estimators reject users outside, as those of the nodes.

The 95 % region is the ellipsoid of the covariance that contains 95 % of a Gaussian. NEES is the
squared error normalised by the covariance; its mean is the number of dimensions in which the
position is uncertain. The MSE ratio is the squared error relative to the trace of the covariance,
1 for a consistent estimate. These figures and the share of fixes are for users inside whom at
least one surface has in sight; the share of wrong fixes is that of positions of other users. The
intervals are from resampling the users.

With `--walking`, each ingredient meets the users of config/lab_walk.yaml instead, who walk at
1 m/s while the surface steps its patterns. Cycles of a track are then 0.6 s apart, carriers are
off by 1 Hz, and the region is that of the lab.

With `--site`, several surfaces have another arrangement than the right angle of `site`. With
`--sites`, the table contains all arrangements instead, with the bands of Table I and of the band
plan: half of the users are outside of the region, as the scenarios declare.
"""

import argparse
import dataclasses
import functools
import inspect
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from parts import frame
from parts.emulated_cycle import EmulatedLink
from scipy.special import chdtri

from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.library import EMPTY, Library
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.frontend import Air, EmulatedRadio, Radio, WaveformRadio
from rhs_isac_ros.model import Pose, Scenario, ScenarioError
from rhs_isac_ros.model.mobility import RandomWalk
from rhs_isac_ros.positioning import BayesEstimator, Estimate, Mixture, Sighting, Tracker, fuse
from rhs_isac_ros.positioning.site import share_left_out
from rhs_isac_ros.positioning.tracking import MixtureTracker, Motion
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import output_file
from rhs_isac_ros.support.files import write_whole
from rhs_isac_ros.system import System

N_CYCLES, SPEED_MPS = 20, 1.0
# Angles about the vertical axis through the centre of the region [deg], heights [m] and upward
# tilts [deg] of the surfaces of each site.
SITES = {
    'right_angle': ((0.0, 0.0, 0.0), (90.0, 0.0, 0.0)),
    'diagonal': ((-45.0, 0.0, 0.0), (45.0, 0.0, 0.0)),
    'sixty': ((0.0, 0.0, 0.0), (60.0, 0.0, 0.0)),
    'sixty_both_sides': ((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (-60.0, 0.0, 0.0)),
    'facing': ((0.0, 2.0, 0.0), (180.0, -2.0, 0.0)),
    'tilted': ((0.0, 0.0, 20.0), (90.0, 0.0, -15.0)),
    'three': ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (220.0, 1.0, 0.0)),
}
PLANS = ('table1', 'bandplan')  # of `--sites`
SHELL_M = (0.5, 5.0)
# A variance above this counts as a dimension [m^2].
LEAST_M2 = 1e-8


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a cell simulates, and how it locates users; the defaults are those of no ingredient."""

    declared: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # scenario fields
    site: str = 'right_angle'  # of `SITES`
    has_site: bool = False  # whether there are all surfaces, or only the first one
    pose_error: tuple[float, float] = (0.0, 0.0)  # [m], [deg]; drawn and declared
    size_m: tuple[float, float, float] = (10.0, 10.0, 2.0)  # of the region
    n_cycles: int = 1  # of each user; several are a track
    outside: float = 0.0  # share of users
    prior_std_m: float = 0.0  # of a mixture around the user; 0 without one
    library: Callable[[], Library] = lambda: EMPTY
    radio: Callable[[Scenario, Air], Radio] = EmulatedRadio
    plan: str = 'bandplan'  # of `frame.system`
    distance_m: float = 10.0  # of the centre of the region from each surface
    period_s: float = 0.1  # of the cycles of a track

    @property
    def bounds_m(self) -> np.ndarray:
        """Bounds of the region in the frame of the site, float64 [2, 3] [m]."""
        return np.array([self.distance_m, 0.0, 0.0]) + np.outer([-0.5, 0.5], self.size_m)

    @property
    def poses(self) -> list[Pose]:
        """Poses of the surfaces; without height and tilt, they face the centre of the region."""
        found = []
        for angle, height_m, tilt in SITES[self.site][:None if self.has_site else 1]:
            turn, lift = np.radians([angle, tilt]) / 2
            sine, cosine = np.sin(lift), np.cos(lift)
            pose = Pose(quaternion=tuple(np.append(
                sine * np.array([np.sin(turn), -np.cos(turn)]),
                cosine * np.array([np.sin(turn), np.cos(turn)])).tolist()))
            origin = np.array([self.distance_m, 0.0, height_m]) - pose.to_site(
                np.array([self.distance_m, 0.0, 0.0]))
            found.append(dataclasses.replace(pose, position_m=tuple(np.round(origin, 9).tolist())))
        return found

    @property
    def walks(self) -> bool:
        """Whether users walk while the surface steps its patterns."""
        return self.plan == 'lab_walk'

    def walking(self) -> 'Setting':
        """Return the same setting for the walking users of the lab; raise Refused without one."""
        if self.radio is not EmulatedRadio or self.library is not Setting.library:
            raise Refused('config/lab_walk.yaml: expected neither samples nor a library')
        if 'element_error_rms' in self.declared or 'failed_element_share' in self.declared:
            raise Refused('config/lab_walk.yaml: expected known elements')
        # An offset turns the phase by less than half a turn between two frames.
        declared = {name: min(value, 1.0) if name == 'carrier_offset_std_hz' else value
                    for name, value in self.declared.items()}
        return dataclasses.replace(
            self, declared=declared, plan='lab_walk', distance_m=4.0, period_s=0.6,
            size_m=tuple(np.multiply(self.size_m, (0.4, 0.4, 0.5))))


Ingredient = Callable[[Setting], Setting]


def change(**values: Any) -> Ingredient:
    """Return the ingredient that sets fields of the setting."""
    return lambda setting: dataclasses.replace(setting, **values)


def declare(others: Ingredient = lambda setting: setting, **fields: Any) -> Ingredient:
    """Return the ingredient that declares fields of the scenario; those of others are kept."""
    return lambda setting: dataclasses.replace(
        others(setting), declared=fields | dict(setting.declared))


INGREDIENTS: dict[str, Ingredient] = {
    'site': change(has_site=True),
    'track': change(n_cycles=N_CYCLES),
    'prior': change(prior_std_m=0.3),
    'library': change(library=functools.partial(
        Library.load, frame.CONFIG / 'library_bandplan.npz')),
    'gain': declare(user_gain_std_db=3.0),
    'band_phases': declare(band_phase_std_rad=0.3),
    'timing': declare(timing_std_s=1e-7),
    # In frames of 4 us, the offset would hardly turn a phase; in 15 ms, by several turns.
    'carrier': declare(carrier_offset_std_hz=300.0, frame_duration_s=1e-4),
    'elements': declare(element_error_rms=0.03),
    'failures': declare(failed_element_share=0.01),
    'pose': change(pose_error=(0.1, 1.0)),
    'outside': declare(change(outside=0.25), outside_probability=0.25),
    'blocked': declare(blocked_probability=0.2),
    'thin': change(size_m=(10.0, 10.0, 0.0)),
    # What pilots as samples require of a scenario. The timing contains the delay of the multipath.
    'waveform': declare(change(radio=WaveformRadio), timing_std_s=5e-7, frame_duration_s=1e-4,
                        band_phase_std_rad=6.2832),
}


class Refused(Exception):
    """The software has no such combination."""


REFUSALS = (Refused, CodebookError, ScenarioError)


class Surface:
    """What is known about one surface in a cell."""

    def __init__(self, setting: Setting, pose: Pose) -> None:
        base, self.codebook = frame.system(setting.plan)
        pose = dataclasses.replace(pose, uncertainty=setting.pose_error)
        corners = np.stack(np.meshgrid(*setting.bounds_m.T), axis=-1).reshape(-1, 3)
        # Rounded, because a region without extent along an axis has none in any frame.
        places = np.round(pose.to_surface(corners), 6)
        low, high = places.min(axis=0), places.max(axis=0)
        self.scenario = dataclasses.replace(
            base, pose=pose, roi_center_m=tuple((low + high) / 2), roi_size_m=tuple(high - low),
            **setting.declared)
        self._library = adapted(setting.library(), self.scenario)
        self._states = System.from_yaml(
            frame.CONFIG / 'lab_walk_system.yaml').surface if setting.walks else None
        self._make_radio, self._left_out = setting.radio, share_left_out(len(setting.poses) > 1)
        self.estimator = functools.cache(self._estimator)

    def codebook_at(self, predicted: tuple[np.ndarray, np.ndarray] | None) -> Codebook:
        """Return the codebook for a predicted position and covariance in the site's frame."""
        if predicted is None:
            return self.codebook
        mean, covariance = predicted
        return self._library.codebook_at(
            self.scenario.pose.to_surface(mean),
            float(np.sqrt(np.trace(covariance) / 3))) or self.codebook

    def link(self, seed: int, error: np.ndarray) -> EmulatedLink:
        """Return the link of a user, with a wrong pose: errors [6] in standard deviations."""
        pose = self.scenario.pose
        std = np.sqrt(np.diag(pose.covariance))
        return EmulatedLink(dataclasses.replace(
            self.scenario, pose=pose.displaced(std * error)), seed, self._make_radio,
            self._states)

    def _estimator(self, codebook: Codebook) -> BayesEstimator:
        # The positioner creates the estimators of a library like this, too.
        return BayesEstimator(System(self.scenario, codebook, self._states),
                              reject_outside=True, lazy=codebook is not self.codebook,
                              left_out=self._left_out)


def adapted(library: Library, scenario: Scenario) -> Library:
    """Return the library for another scenario with the same codebooks, by the nearest cells."""
    if not library.codebooks:
        return library
    plan = dataclasses.replace(library.plan, scenario=scenario.unplaced.id)
    cells = plan.cells(scenario)
    found = Library.of(plan, cells, [
        library.codebook_at(np.array(cell.centre_m), cell.std_m) for cell in cells])
    found.check(scenario)
    return found


class Look(NamedTuple):
    """The signals that one surface has received in a cycle, and the estimator for them."""

    surface: Surface
    estimator: BayesEstimator
    signals: np.ndarray


class OneSurface:
    """Locates a user from one surface, with a tracker if there are several cycles."""

    def __init__(self, setting: Setting, surfaces: Sequence[Surface]) -> None:
        (self._surface,) = surfaces
        self._tracker = Tracker(self._surface.estimator(
            self._surface.codebook), Motion(SPEED_MPS)) if setting.n_cycles > 1 else None

    def predict(self, time_s: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the predicted position and covariance in the frame of the site, if any."""
        found = self._tracker and self._tracker.predict(time_s)
        pose = self._surface.scenario.pose
        return found and (pose.to_site(found[0]), pose.covariances_to_site(found[1]))

    def locate(self, time_s: float, looks: Sequence[Look], prior: Mixture | None) -> Estimate:
        """Return the position in the frame of the site."""
        (look,) = looks
        if self._tracker:
            self._tracker.estimator = look.estimator
            found = with_prior(self._tracker.update, prior)(time_s, look.signals)
        else:
            found = look.estimator.posterior(look.signals, prior)
        return found.to_site(self._surface.scenario.pose)


class SeveralSurfaces:
    """Locates a user from several surfaces, as the role `Fusion` does."""

    def __init__(self, setting: Setting, surfaces: Sequence[Surface]) -> None:
        self._bounds_m, scenario = setting.bounds_m, surfaces[0].scenario
        self._users = scenario.outside_probability, scenario.user_speed_std_mps
        self._tracker = MixtureTracker(
            surfaces[0].scenario, setting.bounds_m, Motion(SPEED_MPS)
        ) if setting.n_cycles > 1 else None

    def predict(self, time_s: float) -> None:
        """Return None: the codebooks of a site do not follow a user."""

    def locate(self, time_s: float, looks: Sequence[Look], prior: Mixture | None) -> Estimate:
        """Return the position in the frame of the site; a prior counts like a surface."""
        sightings = [one.at(look.surface.scenario.pose) for look in looks
                     if (one := look.estimator.posterior(look.signals, prior).sighting)]
        if not sightings:
            return Estimate.without_fix('no surface has a position')
        if prior:
            sightings.append(Sighting(Pose(), prior))
        fused = fuse(sightings, self._bounds_m, *self._users)
        if fused.reason or not self._tracker:
            return fused
        missing = float(np.prod([one.missing for one in sightings]))
        tracked = self._tracker.update(time_s, fused.mixture, missing)
        return tracked or Estimate.without_fix('late')


def with_prior(function: Callable[..., Any], prior: Mixture | None) -> Callable[..., Any]:
    """Return the function with a prior; raise Refused if it takes none."""
    if prior is None:
        return function
    if 'prior' not in inspect.signature(function).parameters:
        raise Refused(f'{function.__qualname__} takes no prior: it is that of the track')
    return functools.partial(function, prior=prior)


class Results(NamedTuple):
    """The positions of a cell, one row for each cycle of each user."""

    estimate: Estimate
    states: np.ndarray  # Positions, and velocities if users walk, float64 [N, 3 or 6].
    expected: np.ndarray  # Whether the user should have a position, bool [N].
    users: np.ndarray  # Number of the user, int [N].

    def figures(self) -> dict[str, Any]:
        """Return the figures of the cell; None where there is nothing to average."""
        fix = np.asarray(self.estimate.fix)
        counted = fix & self.expected
        errors = (self.estimate.mean - self.states[:, :3])[counted]
        covariances, users = self.estimate.covariance[counted], self.users[counted]
        squares = np.sum(errors * np.linalg.solve(covariances, errors[..., None])[..., 0], axis=1)
        dimensions = np.sum(np.linalg.eigvalsh(covariances) > LEAST_M2, axis=1)
        squared = np.sum(errors**2, axis=1)
        traces = np.trace(covariances, axis1=1, axis2=2)

        def share(flags: np.ndarray, users: np.ndarray) -> frame.Interval | None:
            # The cycles of a user are not independent.
            n_users = len(np.unique(users))
            return share_percent(float(flags.mean()) * n_users, n_users) if n_users else None
        ratio = frame.mean_interval(squared / traces.mean(), users) if len(users) else None
        return {
            'in_region': share(squares <= chdtri(dimensions, 0.05), users),
            'nees': frame.mean_interval(squares, users),
            'dimensions': float(dimensions.mean()) if len(users) else None,
            'mse_ratio': ratio, 'fix': share(fix[self.expected], self.users[self.expected]),
            'wrong_fix': share(fix[~self.expected], self.users[~self.expected]),
            'mse_m2': frame.mean_interval(squared, users),
            **self._velocities(counted, share), 'n': len(fix)}

    def _velocities(self, counted: np.ndarray, share: Callable[..., Any]) -> dict[str, Any]:
        """Return the figures of velocities, if there are any."""
        if self.states.shape[1] == 3 or not counted.any():
            return {}
        users, joint = self.users[counted], self.estimate.joint_covariance[counted]
        errors = (np.hstack([self.estimate.mean, self.estimate.velocity]) - self.states)[counted]
        inverse = np.linalg.pinv(joint, LEAST_M2, hermitian=True)
        squares = np.einsum('na,nab,nb->n', errors, inverse, errors)
        dimensions = np.linalg.matrix_rank(joint, LEAST_M2, hermitian=True)
        squared = frame.mean_interval(np.sum(errors[:, 3:]**2, axis=1), users)
        return {'velocity_rms_mps': squared and tuple(one**0.5 for one in squared),
                'both_in_region': share(squares <= chdtri(dimensions, 0.05), users)}


def run_cell(setting: Setting, n: int, rng: np.random.Generator) -> Results:
    """Locate users in about n cycles."""
    surfaces = [Surface(setting, pose) for pose in setting.poses]
    locator = SeveralSurfaces if len(surfaces) > 1 else OneSurface
    rows: list[tuple[Estimate, np.ndarray, bool, int]] = []
    for user in range(1, 1 + max(1, n // setting.n_cycles)):
        is_outside = bool(rng.random() < setting.outside)
        path = outside_path(setting, surfaces, rng) if is_outside else inside_path(setting, rng)
        links = {one: one.link(int(rng.integers(2**31)), rng.standard_normal(6))
                 for one in surfaces}
        expected = not is_outside and not all(
            link.is_blocked(user) for link in links.values())
        rows += [(estimate, place, expected, user) for estimate, place in zip(
            located(setting, locator(setting, surfaces), links, user, path, rng), path,
            strict=True)]
    estimates, positions, flags, users = zip(*rows, strict=True)
    return Results(Estimate.of_each(estimates), np.array(positions), np.array(flags),
                   np.array(users))


def located(setting: Setting, locator: OneSurface | SeveralSurfaces,
            links: Mapping[Surface, EmulatedLink], user: int, path: np.ndarray,
            rng: np.random.Generator) -> Iterator[Estimate]:
    """Yield the estimates of one user along a path, float64 [C, 3] [m] or [C, 6] [m, m/s]."""
    for cycle_id, place in enumerate(path, 1):
        time_s, std_m = setting.period_s * cycle_id, setting.prior_std_m
        centre = place[:3] + std_m * rng.standard_normal(3)
        prior = Mixture(np.zeros(1), centre[None], std_m**2 * np.eye(3)[None]) if std_m else None
        predicted = prior.moments() if prior else locator.predict(time_s)
        looks = []
        for surface, link in links.items():
            codebook = surface.codebook_at(predicted)
            looks.append(Look(surface, surface.estimator(codebook),
                              link.received(codebook, cycle_id, user, place)))
        yield locator.locate(time_s, looks, prior)


def inside_path(setting: Setting, rng: np.random.Generator) -> np.ndarray:
    """Return a walk in the region, positions [C, 3] [m] or also velocities, [C, 6] [m, m/s]."""
    low, high = setting.bounds_m
    walk = RandomWalk(Scenario(roi_center_m=(low + high) / 2, roi_size_m=setting.size_m),
                      SPEED_MPS, rng)
    states = np.array([np.hstack(walk.state(setting.period_s * cycle))
                       for cycle in range(setting.n_cycles)])
    return states if setting.walks else states[:, :3]


def outside_path(setting: Setting, surfaces: Sequence[Surface], rng: np.random.Generator
                 ) -> np.ndarray:
    """Return a place outside of the region, in front of all surfaces, as `inside_path`."""
    low, high = setting.bounds_m
    while True:
        place = rng.uniform(low - SHELL_M[1], high + SHELL_M[1])
        distance_m = np.linalg.norm(place - np.clip(place, low, high))
        if SHELL_M[0] < distance_m < SHELL_M[1] and all(
                one.scenario.pose.to_surface(place)[0] > 1 for one in surfaces):
            return np.tile(np.append(place, np.zeros(3 * setting.walks)), (setting.n_cycles, 1))


def pairs(names: Sequence[str], walking: bool = False) -> Iterator[tuple[str, str]]:
    """Yield each ingredient with itself and with those after it, if one of both is named.

    With `walking`, yield each only with itself.
    """
    for one, other in itertools.combinations_with_replacement(INGREDIENTS, 2):
        if (not names or one in names or other in names) and (one == other or not walking):
            yield one, other


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('combinations', __doc__, positions=800, has_jobs=True)
    add = parser.add_argument
    add('--only', choices=INGREDIENTS, action='append', default=[],
        help='only cells with this ingredient; may be repeated')
    add('--csv', type=output_file, help='CSV file for the table of the documentation')
    add('--walking', action='store_true', help='each ingredient with users who walk in the lab')
    add('--site', choices=SITES, default=Setting.site, help='arrangement of several surfaces')
    add('--sites', action='store_true', help='users outside of all arrangements of surfaces')
    options = parser.parse_args()
    if options.sites and (options.only or options.csv or options.walking):
        parser.error('--sites: expected without --only, --csv and --walking')
    print(f'{options.positions} positions, seed {options.seed}\n')
    results = measure(options)
    if options.csv:
        write_whole(options.csv, matrix(results) + '\n')
    for names, refused in reasons(results).items():
        print(f'{names}: {refused}')


Cells = dict[str, dict[str, dict[str, Any]]]


def measure(options: argparse.Namespace) -> Cells:
    """Measure the requested cells; pairs are stored under both orders of their ingredients."""
    common = {'n': options.positions, 'seed': options.seed}
    if options.sites:
        function: Callable[..., dict[str, Any]] = measured_site
        cells = {(plan, site): f'{plan}, {site}' for plan in PLANS for site in SITES}
        cases = {name: common | {'plan': plan, 'site': site}
                 for (plan, site), name in cells.items()}
    else:
        function, chosen = measured_cell, set(pairs(options.only, options.walking))
        cells = {(one, other): ' + '.join(dict.fromkeys((one, other)))
                 for one, other in pairs(()) if (one, other) in chosen}
        cases = {name: common | {'one': one, 'other': other, 'walking': options.walking,
                                 'site': options.site} for (one, other), name in cells.items()}
    found = frame.measured(options, 'combinations', function, cases)
    table = frame.Table(['surfaces' if options.sites else 'ingredients'], {
        'fix [%]': ('fix', 1), 'wrong fix [%]': ('wrong_fix', 1),
        'in the 95 % region [%]': ('in_region', 1), 'NEES': ('nees', 2),
        'dimensions': ('dimensions', 1), 'MSE ratio': ('mse_ratio', 2),
        **({'velocity, rms [m/s]': ('velocity_rms_mps', 2),
            'both in their region [%]': ('both_in_region', 1)} if options.walking else {})})
    results: Cells = {}
    for (one, other), name in cells.items():
        row = found[name]
        results.setdefault(one, {})[other] = row
        if not options.sites:
            results.setdefault(other, {})[one] = row
        table.row(name, **row | {'fix': row.get('refused') or row['fix']})
    frame.write_results(options.json, results)
    return results


def measured_cell(one: str, other: str, n: int, seed: int, walking: bool, site: str
                  ) -> dict[str, Any]:
    """Run a job: return the figures of a cell."""
    # The random numbers of a cell do not depend on the other cells.
    number = [*pairs(())].index((one, other))
    rng = streams.generator(seed, streams.HELD_OUT, number)
    return cell(one, other, n, rng, walking, site) | {'positions': n, 'seed': seed}


def measured_site(plan: str, site: str, n: int, seed: int) -> dict[str, Any]:
    """Run a job: return the figures of a site with as many users outside as it declares."""
    share = frame.system(plan)[0].outside_probability
    found = run_cell(Setting(plan=plan, site=site, has_site=True, outside=share), n,
                     streams.generator(seed, streams.HELD_OUT)).figures()
    return found | {'positions': n, 'seed': seed}


def cell(one: str, other: str, n: int, rng: np.random.Generator, walking: bool = False,
         site: str = Setting.site) -> dict[str, Any]:
    """Return the figures of a cell, or why the software refuses it."""
    setting = Setting(site=site)
    for name in dict.fromkeys((one, other)):
        setting = INGREDIENTS[name](setting)
    try:
        return run_cell(setting.walking() if walking else setting, n, rng).figures()
    except REFUSALS as error:
        return {'refused': str(error)}


def matrix(results: Cells) -> str:
    """Return the lower triangle of the table as CSV: share in the 95 % region [%], and NEES."""
    names = [name for name in INGREDIENTS if name in results]
    lines = [['', *names]]
    for number, one in enumerate(names, 1):
        lines.append([one])
        for other in names[:number]:
            found = results[one].get(other, {})
            covered, nees = found.get('in_region'), found.get('nees')
            lines[-1].append('refused' if 'refused' in found else
                             f'{covered[0]:.0f}; {nees[0]:.1f}' if covered and nees else '-')
    return '\n'.join(','.join(line + [''] * (len(lines[0]) - len(line))) for line in lines)


def reasons(results: Cells) -> dict[str, str]:
    """Return why cells are refused."""
    return {f'{one} + {other}': results[one][other]['refused'] for one, other in pairs(())
            if 'refused' in results.get(one, {}).get(other, {})}


if __name__ == '__main__':
    frame.run(main)
