"""Sweeps: measures in many settings, with one result for each setting and measure."""

import csv
import dataclasses
import functools
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.bounds import global_bound
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.codebook.optimize import optimised
from rhs_isac_ros.codebook.unoptimised import STARTS
from rhs_isac_ros.experiments.resampling import Interval
from rhs_isac_ros.experiments.sweep_settings import FIELDS, MEASURES, Setting, measured, plain
from rhs_isac_ros.link import capacity as capacity_of
from rhs_isac_ros.link import capacity_report, choose_beam
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import Estimator, EstimatorKind, make_estimator
from rhs_isac_ros.positioning.estimate import estimate_of
from rhs_isac_ros.support import plugins, streams
from rhs_isac_ros.support.fields import whole
from rhs_isac_ros.support.jobs import Job, Strand, Workers
from rhs_isac_ros.system import System

# Kinds of codebooks that are made for a scenario.
OPTIMIZE, RANDOM = 'optimize', 'random'
KINDS = (OPTIMIZE, 'directional', RANDOM)
# Kinds of codebooks that use an option of a sweep.
_KINDS_USING = {**dict.fromkeys(('objective', 'steps', 'optimize_for'), (OPTIMIZE,)),
          'repeats': (OPTIMIZE, RANDOM)}
# Number of positions in a job. Another size would change the positions of the global bound.
BLOCK = 250
# Number of sample positions in an optimisation.
_SAMPLES = 64
# Above this coarseness of its lattice, a global bound is too loose.
_MAX_COARSENESS = 3.0
# Largest relative error of the power that is not corrected; `Codebook.check` allows a larger one.
_POWER_TOLERANCE = 1e-9
# Families of quantities that a job computes. LOSS includes CAPACITY, which includes ERROR.
CRLB, BOUND, ERROR, CAPACITY, LOSS = 'crlb', 'bound', 'error', 'capacity', 'loss'
_QUANTITIES = {
    CRLB: ('crlb_m2',), BOUND: ('bound_m2',), ERROR: ('squared_error_m2', 'inside', 'fix'),
    CAPACITY: ('capacity_bps',), LOSS: ('perfect_bps', 'loss_bps')}
_INCLUSIVE = (ERROR, CAPACITY, LOSS)


def families(quantities: Iterable[str]) -> list[str]:
    """Return the smallest set of families whose jobs compute the given quantities."""
    wanted = set(quantities)
    found = [family for family, names in _QUANTITIES.items() if wanted.intersection(names)]
    return [family for family in found if family not in _INCLUSIVE] + [
        family for family in found if family in _INCLUSIVE][-1:]


def with_power(codebook: Codebook, power_w: float) -> Codebook:
    """Scale the combining vectors so that each frame has a given power.

    A codebook that already has this power is returned unchanged, with its id.
    """
    power = np.sum(np.abs(codebook.digital)**2, axis=(1, 3), keepdims=True)
    if np.allclose(power, power_w, rtol=_POWER_TOLERANCE, atol=0):
        return codebook
    return Codebook(codebook.analog, codebook.digital * np.sqrt(power_w / power))


def design(scenario: Mapping[str, Any], kind: str, seed: int, objective: str = '',
           steps: int = 0) -> dict[str, Any]:
    """Run a job: make a codebook of one of `KINDS`, and return its ROS parameters.

    `scenario` contains the fields that differ from Table I. `objective` and `steps` apply only to
    an optimisation.
    """
    if kind in STARTS:
        generator = streams.generator(seed, streams.START)
        return STARTS[kind](Scenario(**scenario), generator, None).to_parameters()
    found = optimised(scenario, objective=objective, n_positions=_SAMPLES, seed=seed,
                      max_steps=steps)
    return dict(found['codebook'])


def evaluate(family: str, scenario: Mapping[str, Any], codebook: Mapping[str, Any], seed: int,
             first: int, n: int, estimator: str = '', max_coarseness: float = _MAX_COARSENESS
             ) -> dict[str, list[float]]:
    """Run a job: compute a family of quantities at `n` positions, beginning with number `first`.

    The seed and the region determine the sequence of positions, except for the global bound, which
    draws its own, and is NaN above a coarseness of its lattice. Each list of the result has one
    value per position.
    """
    world, book = Scenario(**scenario), Codebook.from_parameters(dict(codebook))
    system = System(world, book)
    if family == BOUND:
        # The bound needs at least two phases.
        bound = global_bound(
            system, streams.generator(seed, streams.HELD_OUT, first), max(n, 2))
        loose = bound.coarseness > max_coarseness
        return {'bound_m2': [np.nan] * n if loose else bound.squared_errors[:n].tolist()}
    positions, received = system.pairs(n, seed, first)
    if family == CRLB:
        return {'crlb_m2': system.crlb(positions).tolist()}
    located = estimate_of(
        _estimator(estimator, json.dumps(scenario), json.dumps(codebook)), received)
    fix = located.fix
    from scipy.special import chdtri
    # Without a fix, only the region is known.
    mean = np.where(fix[:, None], located.mean, world.roi_center_m)
    covariance = np.where(
        fix[:, None, None], located.covariance, np.diag(np.square(world.roi_size_m) / 12))
    error = mean - positions
    distance = np.einsum('na,nab,nb->n', error, np.linalg.pinv(covariance, hermitian=True), error)
    # The 95 % region has as many dimensions as that of interest.
    radius = chdtri(np.count_nonzero(world.roi_size_m), 0.05)
    result = {'squared_error_m2': np.sum(error**2, axis=1), 'fix': fix.astype(float),
              'inside': (fix & (distance <= radius)).astype(float)}
    if family in (CAPACITY, LOSS):
        beams = [choose_beam(world, *known).beam for known in zip(mean, covariance, strict=True)]
        pairs = list(zip(beams, positions, strict=True))
        if family == CAPACITY:
            result['capacity_bps'] = np.array(
                [capacity_of(world, beam, position[None])[0] for beam, position in pairs])
        else:
            reports = [capacity_report(world, beam, position) for beam, position in pairs]
            result['capacity_bps'] = np.array([report.actual_bps for report in reports])
            result['perfect_bps'] = np.array([report.perfect_bps for report in reports])
            result['loss_bps'] = np.array([report.loss_bps for report in reports])
    return {name: values.tolist() for name, values in result.items()}


@functools.partial(plugins.cached, maxsize=1)
def _estimator(name: str, scenario: str, codebook: str) -> Estimator:
    """Return an estimator for a scenario and codebook in JSON; successive jobs share it."""
    return make_estimator(name, Scenario(**json.loads(scenario)),
                          Codebook.from_parameters(json.loads(codebook)))


# Fields that decide whether a codebook fits a scenario.
_STRUCTURE = ('center_frequencies_hz', 'n_subbands', 'n_frames', 'elements_per_side',
              'element_positions_m', 'n_feeds',
              'feed_positions_m', 'amplitude_levels')


class Results(NamedTuple):
    """Quantities of a setting at all positions, by name, float64 [codebooks, positions]."""

    setting: Setting
    codebooks: tuple[Codebook, ...]
    quantities: Mapping[str, np.ndarray]


class Point(NamedTuple):
    """The value of a measure in a setting, with the ids of the codebooks."""

    setting: Setting
    measure: str
    interval: Interval
    codebook_ids: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Sweep:
    """The measures of a sweep, its settings, and the options of its codebooks.

    Raises ValueError if a measure is unknown, a number is out of range, an option would have no
    effect, a file has no codebook that fits its settings, or fields of `base` contradict those
    that an optimisation takes from a setting.
    """

    base: Scenario  #: Scenario with the values that are not varied.
    settings: Sequence[Setting]  #: Result of `settings_of`.
    measures: Sequence[str]  #: Keys of `MEASURES`.
    n_positions: int = 2000  #: Number of positions in each setting.
    seed: int = 0  #: Seed of positions, signals and codebooks.
    objective: str = 'ambiguity'  #: Objective of an optimisation.
    steps: int = 300  #: Maximum number of steps of an optimisation.
    #: Fields whose values the optimisation of a codebook takes from the setting; None for all.
    #: Other fields have their base values, except those that decide whether a codebook fits.
    optimize_for: Sequence[str] | None = None
    repeats: int = 1  #: Codebooks in each setting, with successive seeds, if optimised or random.

    def __post_init__(self) -> None:
        """Check names, numbers and codebooks."""
        for name in self.measures:
            if name not in MEASURES:
                raise ValueError(f'measures: {name!r}, expected some of {", ".join(MEASURES)}')
        for name, low in (('n_positions', 1), ('repeats', 1), ('steps', 1), ('seed', 0)):
            whole(name, getattr(self, name), low)
        for name in self.optimize_for or ():
            if name not in FIELDS:
                raise ValueError(f'optimize_for: {name!r}, expected names of fields of a scenario')
        for name in sorted({setting.estimator for setting in self.settings}):
            # An estimator with a file would have to be trained for each codebook.
            if needed := EstimatorKind(name).readers:
                raise ValueError(f'estimator: {name!r}, expected one without {", ".join(needed)}')
        files, kinds = self._files, {setting.codebook for setting in self.settings}
        for name, using in _KINDS_USING.items():
            if getattr(self, name) != getattr(Sweep, name) and not kinds.intersection(using):
                raise ValueError(
                    f'{name}: no effect, expected a codebook of the kind {" or ".join(using)}')
        for setting in self.settings:
            if setting.codebook in KINDS:
                self.scenario_of_codebook(setting)
                continue
            try:
                _fitted(files[setting.codebook], setting)
            except CodebookError as error:
                varied = ', '.join(f'{name} = {plain(v)}' for name, v in setting.varied.items())
                raise CodebookError(f'{setting.codebook}: {error}; setting {varied}') from None

    @functools.cached_property
    def _files(self) -> dict[str, Codebook]:
        names = sorted({setting.codebook for setting in self.settings} - {*KINDS})
        for name in names:
            if not Path(name).is_file():
                raise ValueError(f'codebook: {name!r}, expected {", ".join(sorted(KINDS))} or a '
                                 'file')
        return {name: Codebook.load(name) for name in names}

    def scenario_of_codebook(self, setting: Setting) -> Scenario:
        """Return the scenario for which the codebook of a setting is made."""
        if self.optimize_for is None or setting.codebook != OPTIMIZE:
            return setting.scenario
        taken = {name: getattr(setting.scenario, name)
                 for name in (*_STRUCTURE, *self.optimize_for) if name in FIELDS}
        return dataclasses.replace(self.base, **taken)

    def designs(self, setting: Setting) -> list[Job]:
        """Return the jobs that make a setting's codebooks; none if the codebook is a file."""
        if setting.codebook not in KINDS:
            return []
        arguments: dict[str, Any] = {
            'scenario': self.scenario_of_codebook(setting).changes(), 'kind': setting.codebook}
        if setting.codebook == OPTIMIZE:
            arguments |= {'objective': self.objective, 'steps': self.steps}
        repeats = self.repeats if setting.codebook in (OPTIMIZE, RANDOM) else 1
        return [Job.of('codebook', {**arguments, 'seed': self.seed + repeat})
                for repeat in range(repeats)]

    def blocks(self, setting: Setting, codebook: Codebook) -> dict[str, list[Job]]:
        """Return the jobs that evaluate a codebook in a setting, by family of quantities."""
        quantities = [MEASURES[measure].quantity for measure in self.measures]
        common = {'scenario': setting.scenario.changes(), 'codebook': codebook.to_parameters(),
                  'seed': self.seed}
        return {family: [Job.of(family, {
            **common, 'family': family, 'first': first, 'n': min(BLOCK, self.n_positions - first),
            **({} if family in (CRLB, BOUND) else {'estimator': setting.estimator})})
            for first in range(0, self.n_positions, BLOCK)] for family in families(quantities)}

    def codebook(self, setting: Setting, made: Mapping[str, Any] | None) -> Codebook:
        """Return a codebook of a setting, from the result of a job of `designs`, if any."""
        return _fitted(Codebook.from_parameters(dict(made)) if made
                       else self._files[setting.codebook], setting)


def run_sweep(sweep: Sweep, folder: str | Path, n_jobs: int = -1, dask: str | None = None
              ) -> list[Point]:
    """Run a sweep with `run_blocks`; return the measures of each setting, with their intervals."""
    return [Point(results.setting, name,
                  measured(MEASURES[name], results.quantities[MEASURES[name].quantity]),
                  tuple(codebook.id for codebook in results.codebooks))
            for results in run_blocks(sweep, folder, n_jobs, dask) for name in sweep.measures]


def run_blocks(sweep: Sweep, folder: str | Path, n_jobs: int = -1, dask: str | None = None
               ) -> list[Results]:
    """Run the jobs of a sweep that have no stored result; return the results of each setting.

    Several sweeps may share a folder. `run_jobs` describes the other arguments and the errors.
    """
    found = iter(Workers(n_jobs, dask, Path(folder), 'sweep').run(
        [_evaluated(sweep, setting, job) for setting in sweep.settings
         for job in sweep.designs(setting) or (None,)]))
    results = []
    for setting in sweep.settings:
        parts = [next(found) for _ in sweep.designs(setting) or (None,)]
        results.append(Results(setting, tuple(codebook for codebook, _ in parts), {
            name: np.array([quantities[name] for _, quantities in parts])
            for name in parts[0][1]}))
    return results


def _evaluated(sweep: Sweep, setting: Setting, job: Job | None
               ) -> Strand[tuple[Codebook, dict[str, np.ndarray]]]:
    """Make a codebook of a setting, and compute its quantities at all positions, [positions]."""
    made = (yield design, [job])[0] if job else None
    codebook = sweep.codebook(setting, made)
    blocks = sweep.blocks(setting, codebook)
    found = iter((yield evaluate, [one for jobs in blocks.values() for one in jobs]))
    quantities: dict[str, np.ndarray] = {}
    for jobs in blocks.values():
        parts = [next(found) for _ in jobs]
        quantities |= {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return codebook, quantities


def table(sweep: Sweep, points: Sequence[Point]) -> str:
    """Return the points as CSV, with one row for each point and all fields of its setting."""
    stream = io.StringIO()
    rows = csv.writer(stream, lineterminator='\n')
    rows.writerow(['measure', 'value', 'low', 'high', 'unit', 'estimator', 'codebook',
                   'codebook_ids', 'codebook_scenario', 'objective', 'steps', 'repeats',
                   'positions', 'seed', 'version', 'scenario', *FIELDS])
    for point in points:
        setting = point.setting
        optimised = setting.codebook == OPTIMIZE
        origin = sweep.scenario_of_codebook(setting).changes()
        rows.writerow([
            point.measure, *(f'{number:.9g}' for number in point.interval),
            MEASURES[point.measure].unit, setting.estimator, setting.codebook,
            ' '.join(point.codebook_ids), plain(origin) if setting.codebook in KINDS else '',
            sweep.objective if optimised else '', sweep.steps if optimised else '',
            len(point.codebook_ids), sweep.n_positions, sweep.seed, __version__,
            setting.scenario.id,
            *map(plain, setting.scenario.fields().values())])
    return stream.getvalue()


def _fitted(codebook: Codebook, setting: Setting) -> Codebook:
    """Scale a codebook to the power of a setting; raise CodebookError if it does not fit."""
    fitted = with_power(codebook, setting.scenario.max_power_w)
    fitted.check(setting.scenario)
    return fitted
