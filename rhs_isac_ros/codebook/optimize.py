"""Optimisation of a codebook by any method: sampling, start, limits and provenance.

`optimize` runs in this process. The functions at the end run optimisations as jobs, with arguments
and results that are plain values.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.bounds import crlb_of
from rhs_isac_ros.bounds.average import Average
from rhs_isac_ros.calibration import Calibration
from rhs_isac_ros.codebook import methods
from rhs_isac_ros.codebook.cell import REGION, Cell, Prior
from rhs_isac_ros.codebook.codebook import Codebook, CodebookError, Provenance
from rhs_isac_ros.codebook.objective import OBJECTIVES, SAMPLINGS
from rhs_isac_ros.codebook.problem import BudgetSpent, Problem, Progress, Search
from rhs_isac_ros.codebook.unoptimised import STARTS, random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import checked_positions
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.surface import on_levels, ports_of
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.fields import whole
from rhs_isac_ros.support.jobs import Job, Strand
from rhs_isac_ros.support.threads import one_blas_thread

# Number of Sobol points: for Table I, about as good as 1200 independent positions.
DEFAULT_POSITIONS = 256
# Reason for stopping after Ctrl-C.
INTERRUPTED = 'interrupted'


class Method(NamedTuple):
    """An optimisation method with its default limit on update steps.

    The function `minimize` takes a `Search` and returns the reason for stopping. It is None for a
    method that returns its start without a search.
    """

    minimize: Callable[[Search], str] | None
    steps: int = 1


METHODS: Mapping[str, Method] = {
    'alternating': Method(methods.minimize_alternating, 400),
    'direct': Method(methods.minimize_direct, 400),
    'directional': Method(None),
    'genetic': Method(methods.minimize_genetic, 10),
    'lbfgs': Method(methods.minimize_lbfgs, 3000),
    'random': Method(None),
}


@dataclasses.dataclass(frozen=True)
class OptimizeResult:
    """Result of an optimisation."""

    codebook: Codebook  #: The best one found; `average_crlb_m2` is for the sampled positions.
    #: Progress at the start and after each step.
    history: tuple[Progress, ...] = dataclasses.field(repr=False)
    reason: str  #: The reason for stopping.


@one_blas_thread
def optimize(
        scenario: Scenario, positions: np.ndarray | None = None, method: str = 'lbfgs', *,
        objective: str = 'crlb', sampling: str = 'sobol', n_positions: int = DEFAULT_POSITIONS,
        seed: int = 0, start: Codebook | None = None, resume: Codebook | None = None,
        calibration: Calibration | None = None, max_steps: int | None = None,
        max_evaluations: int | None = None, progress: Callable[[Progress], None] | None = None,
        keep: Callable[[OptimizeResult], None] | None = None, prior: Prior = REGION
) -> OptimizeResult:
    """Find a codebook that minimises an objective.

    After a KeyboardInterrupt during the search, the best codebook so far is returned. Raises
    ValueError if a name is unknown, a number is out of range, `positions` is empty, not a finite
    [N_sam, 3] array, or given beside `sampling` or `n_positions`, `resume` was made with other
    arguments or is given beside `start`, a codebook or the calibration does not fit the scenario,
    the objective is infinite at the start, or the amplitudes are discrete and the method is
    ``alternating`` or ``direct``. Raises MissingLibraryError if the method needs a missing
    library.

    Parameters
    ----------
    positions
        Samples of the user's position, float64 [N_sam, 3] [m]; by default `n_positions` drawn by
        `sampling`.
    method
        One of `METHODS`.
    objective
        One of `OBJECTIVES`: ``crlb``, the average bound; ``ambiguity``, the confusion of distant
        positions, which a local bound ignores; ``error``, this confusion weighted almost as in the
        mean squared error; or ``nuisance``, the bound with unknown phases of the bands and the
        region as prior.
    sampling
        One of `SAMPLINGS`: ``sobol``, or ``monte_carlo`` as in the paper.
    seed
        Seed of the samples, the start and the method.
    start
        Codebook to start from; by default random, or directional with the method ``directional``.
        Elements that are off in all frames of all bands stay off.
    resume
        Codebook of an earlier call with the same arguments, to continue from in place of `start`;
        the earlier steps and evaluations count towards the limits.
    calibration
        Calibration of the surface, treated as exact; by default the scenario's surface.
    max_steps
        Maximum number of update steps; the default depends on the method.
    max_evaluations
        Maximum number of evaluations of the objective; by default unlimited.
    progress
        Called at the start and after each step. During the set-up of the objective, it is called
        at most once a second, with an infinite value. An exception from `progress` ends the
        optimisation; with a KeyboardInterrupt during the set-up, the result is the start.
    keep
        Called at most every ten seconds with the result so far.
    prior
        Where the user may be: the region, or a `Cell` of it.

    Examples
    --------
    >>> result = optimize(Scenario(), n_positions=16, max_steps=5)
    >>> result.history[-1].value_m2 < 0.6 * result.history[0].value_m2
    True
    """
    design = _Design.of(
        scenario, positions, method, objective, sampling, n_positions, seed, start, resume,
        calibration, max_steps, max_evaluations, prior)
    report = _Report(progress, Progress(
        design.done.steps, design.done.evaluations, np.inf, 0.0))
    minimize = METHODS[method].minimize
    if minimize is None:
        return _unsearched(design, report, 'nothing to optimise')
    try:
        average = design.average(report.tick)
    except KeyboardInterrupt:
        return _unsearched(design, report, INTERRUPTED)
    problem = Problem(scenario, average, design.used)
    search = design.search(problem, report)
    if keep:
        report.keep = lambda: keep(
            design.result(problem.unpack(search.best), search.history, 'not finished'))
    reason = _run(search, minimize)
    return design.result(problem.unpack(search.best), search.history, reason)


@dataclasses.dataclass(frozen=True)
class _Design:
    """Checked arguments of an optimisation: everything that determines its result."""

    scenario: Scenario
    positions: np.ndarray  # Samples of the user's position, float64 [N_sam, 3] [m].
    first: Codebook  # Start of the search.
    surface: SurfaceEstimate | None
    provenance: Provenance  # Of a result before the first step.
    done: Provenance  # Steps and evaluations of the resumed result.
    max_steps: int
    max_evaluations: int | None
    prior: Prior
    used: np.ndarray  # Elements that the search changes, bool [N_E].

    @classmethod
    def of(cls, scenario: Scenario, positions: np.ndarray | None, method: str, objective: str,
           sampling: str, n_positions: int, seed: int, start: Codebook | None,
           resume: Codebook | None, calibration: Calibration | None, max_steps: int | None,
           max_evaluations: int | None, prior: Prior) -> '_Design':
        """Check the arguments of `optimize`, and replace None by the defaults."""
        for name, value, known in (
                ('method', method, METHODS), ('objective', objective, OBJECTIVES),
                ('sampling', sampling, SAMPLINGS)):
            if value not in known:
                raise ValueError(f'{name}: {value!r}, expected one of {sorted(known)}')
        if (levels := scenario.amplitude_levels) and method in ('alternating', 'direct'):
            raise ValueError(f'method: {method!r} with amplitude_levels = {levels}, expected '
                             "'lbfgs' or 'genetic'")
        for name, number, low in (('n_positions', n_positions, 1), ('seed', seed, 0),
                                  ('max_evaluations', max_evaluations, 1),
                                  ('max_steps', max_steps, 1)):
            if number is not None or not name.startswith('max_'):
                whole(name, number, low)
        if start and resume:
            raise ValueError('start: not allowed with resume, which continues from a codebook')
        if positions is None:
            positions = prior.positions(scenario, SAMPLINGS[sampling](
                scenario, n_positions, streams.generator(seed, streams.SAMPLES)))
        else:
            positions = checked_positions(positions)
            if not len(positions):
                raise ValueError('positions: none, expected at least one')
            if sampling != 'sobol' or n_positions not in (DEFAULT_POSITIONS, len(positions)):
                raise ValueError('sampling and n_positions: not allowed with positions')
            sampling = 'given'
        provenance = Provenance(
            method=method, objective=objective, seed=int(seed), sampling=sampling,
            positions=len(positions), scenario=scenario.changes(),
            calibration=calibration.id if calibration else '')
        done = provenance.resumed(resume.provenance) if resume else provenance
        if calibration:
            calibration.check(scenario)
        surface = calibration.surface if calibration else None
        first = resume or start or STARTS[method if method in STARTS else 'random'](
            scenario, streams.generator(seed, streams.START), surface)
        # Even a search over levels begins with continuous amplitudes.
        first.check(scenario, discrete=False)
        return cls(scenario, positions, first, surface, provenance, done,
                   max_steps or METHODS[method].steps, max_evaluations, prior,
                   used_elements(scenario, resume or start))

    def average(self, tick: Callable[[], None]) -> Average:
        """Set up the objective."""
        average = OBJECTIVES[self.provenance.objective](
            self.scenario, self.positions, self._rng(streams.PAIRS), tick,
            self.prior)
        average.surface = self.surface
        return average

    def search(self, problem: Problem, report: Callable[[Progress], None]) -> Search:
        """Return the search for the best variables of a problem."""
        return Search(
            problem, problem.pack(self.first), self.max_steps, self.max_evaluations,
            self._rng(streams.METHOD), report, (self.done.steps, self.done.evaluations))

    def bound_m2(self, codebook: Codebook) -> float:
        """Compute the average Cramer-Rao bound of a codebook."""
        model = MeasurementModel(self.scenario, codebook, self.surface)
        return float(crlb_of(model, self.positions).mean())

    def result(self, best: Codebook, history: Sequence[Progress], reason: str) -> OptimizeResult:
        """Return a result with its provenance."""
        end = history[-1]
        provenance = dataclasses.replace(
            self.provenance, steps=end.step, evaluations=end.evaluations,
            value_m2=float(end.value_m2), reason=reason)
        codebook = dataclasses.replace(
            best, average_crlb_m2=self.bound_m2(best), provenance=provenance.to_text())
        return OptimizeResult(codebook, tuple(history), reason)

    def _rng(self, stream: int) -> np.random.Generator:
        return streams.generator(self.provenance.seed, stream)


def _unsearched(design: _Design, report: '_Report', reason: str) -> OptimizeResult:
    """Return the start as the result."""
    best = dataclasses.replace(
        design.first, analog=on_levels(design.scenario, design.first.analog))
    # Only the bound is known, and it is the objective only for 'crlb'.
    value_m2 = (_determined(design.bound_m2(best)) if design.provenance.objective == 'crlb'
                else np.nan)
    entry = Progress(design.done.steps, design.done.evaluations, value_m2, 0.0)
    report(entry)
    return design.result(best, [entry], reason)


def used_elements(scenario: Scenario, start: Codebook | None) -> np.ndarray:
    """Return the elements that a search changes, bool [N_E]; without a given start, all.

    An element is masked if its tuning is 0 in all frames of all bands, and has no effect there.
    """
    if start is None:
        return np.ones(scenario.n_elements, bool)
    off = np.zeros((scenario.n_bands, 1, scenario.n_elements))
    in_effect = scenario.board.transfer(ports_of(scenario), off).any(axis=(0, 1, 2, 4))
    return np.logical_or(in_effect, start.analog.any(axis=(0, 1)))


def _determined(value_m2: float) -> float:
    """Return the objective at the start; raise ValueError if it is not finite."""
    if not np.isfinite(value_m2):
        raise ValueError(
            f'positions: objective {value_m2} at the start, expected a finite one: the signals '
            'of the scenario do not determine the position')
    return value_m2


def _run(search: Search, minimize: Callable[[Search], str]) -> str:
    """Evaluate the start, run a method, and return why it stopped."""
    try:
        _determined(search.begin())
        return 'max_steps reached' if search.max_steps < 1 else minimize(search)
    except BudgetSpent:
        search.finish()
        return 'max_evaluations reached'
    except KeyboardInterrupt:
        search.finish()
        return INTERRUPTED


class _Report:
    """Progress callback, also for the set-up, that calls `keep` at most every ten seconds."""

    _TICK_S, _KEEP_S = 1.0, 10.0

    def __init__(self, progress: Callable[[Progress], None] | None, before: Progress) -> None:
        self.keep: Callable[[], None] | None = None
        self._progress, self._before = progress, before
        self._begin, self._is_searching, self._kept_s = time.perf_counter(), False, 0.0

    def __call__(self, entry: Progress) -> None:
        self._is_searching = True
        if self._progress:
            self._progress(entry)
        if self.keep and entry.elapsed_s >= self._kept_s + self._KEEP_S:
            self._kept_s = entry.elapsed_s
            self.keep()

    def tick(self) -> None:
        """Report the elapsed time before the search, at most once a second."""
        elapsed_s = time.perf_counter() - self._begin
        if not (self._is_searching or elapsed_s < self._before.elapsed_s + self._TICK_S):
            self._before = dataclasses.replace(self._before, elapsed_s=elapsed_s)
            if self._progress:
                self._progress(self._before)


def optimisation(
        scenario: Scenario, *, start: Codebook | None = None, cell: Cell | None = None,
        calibration: Path | None = None, **options: Any) -> Job:
    """Return a job of `optimised`; the options are those of `optimize`.

    Every worker must be able to read the file of a calibration.
    """
    given = {'start': start and start.to_parameters(), 'cell': cell and dataclasses.astuple(cell),
             'calibration': calibration and (
                 str(calibration.resolve()), Calibration.load(calibration).id)}
    return Job.of('optimisation', {
        'scenario': scenario.changes(), **options,
        **{name: value for name, value in given.items() if value}})


def optimised(
        scenario: Mapping[str, Any], start: Mapping[str, Any] | None = None,
        cell: Sequence[Any] | None = None, calibration: Sequence[str] | None = None,
        **options: Any) -> dict[str, Any]:
    """Run a job: optimise a codebook, and return it with the history and the reason for the end.

    Raises KeyboardInterrupt after Ctrl-C: an unfinished optimisation is no result; and
    CodebookError if the file of the calibration has changed.
    """
    surface = Calibration.load(calibration[0]) if calibration else None
    if surface and calibration and surface.id != calibration[1]:
        raise CodebookError(f'{calibration[0]}: {surface.id}, expected {calibration[1]}')
    result = optimize(
        Scenario(**scenario), start=Codebook.from_parameters(dict(start)) if start else None,
        prior=Cell(*cell) if cell else REGION,
        calibration=surface, **options)
    if result.reason == INTERRUPTED:
        raise KeyboardInterrupt
    return {'codebook': result.codebook.to_parameters(), 'reason': result.reason,
            'history': [dataclasses.astuple(entry) for entry in result.history]}


def result_of(found: Mapping[str, Any]) -> OptimizeResult:
    """Return the result of a job of `optimised`."""
    return OptimizeResult(
        Codebook.from_parameters(dict(found['codebook'])),
        tuple(Progress(*entry) for entry in found['history']), found['reason'])


def restarted(scenario: Scenario, n: int, seed: int = 0, **options: Any) -> Strand[OptimizeResult]:
    """Optimise with the same samples from `n` random starts; return the result of lowest value.

    The first start is that of `optimize`, whose options the others are.
    """
    starts = [None, *(random_codebook(scenario, streams.generator(seed, streams.START, number))
                      for number in range(1, n))]
    jobs = [optimisation(scenario, **options | ({'start': start} if start else {}), seed=seed)
            for start in starts]
    results = map(result_of, (yield optimised, jobs))
    return min(results, key=lambda result: result.history[-1].value_m2)
