"""The one entry to all optimisers, with what they share: sampling, start, history."""

import dataclasses
import time
from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.codebook.lbfgs import minimize_lbfgs
from rhs_isac_ros.codebook.problem import Problem, sampled_objective
from rhs_isac_ros.codebook.start import random_codebook
from rhs_isac_ros.model import Scenario, streams

# Each takes (function, start, bounds, max_steps, on_step) and returns why it stopped.
METHODS: Mapping[str, Callable] = {'lbfgs': minimize_lbfgs}
DEFAULT_POSITIONS = 1200
DEFAULT_STEPS = 400


@dataclasses.dataclass(frozen=True)
class Progress:
    """State of an optimisation after a step.

    Attributes
    ----------
    step
        Update steps so far.
    evaluations
        Evaluations of value and gradient so far.
    value_m2
        Lowest objective so far [m^2].
    elapsed_s
        Time since the start [s].
    """

    step: int
    evaluations: int
    value_m2: float
    elapsed_s: float


@dataclasses.dataclass(frozen=True)
class OptimizeResult:
    """Outcome of an optimisation.

    Attributes
    ----------
    codebook
        The best codebook met; its `average_crlb_m2` is the objective on the sampled positions.
    history
        Progress after each step, the start being step 0.
    reason
        Why the method stopped.
    """

    codebook: Codebook
    history: tuple[Progress, ...]
    reason: str


def optimize(
        scenario: Scenario, positions: np.ndarray | None = None, method: str = 'lbfgs', *,
        n_positions: int = DEFAULT_POSITIONS, seed: int = 0, start: Codebook | None = None,
        max_steps: int = DEFAULT_STEPS,
        progress: Callable[[Progress], None] | None = None) -> OptimizeResult:
    """Find a codebook with a low average Cramer-Rao bound.

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Samples of the user's position, float64 [N_sam, 3] [m]; by default uniform ones.
    method
        One of `METHODS`.
    n_positions
        How many samples to draw if none are given.
    seed
        Seeds the samples and the start.
    start
        Codebook to start from; by default the paper's, with random configurations.
    max_steps
        Limit of update steps.
    progress
        Called after each step.

    Returns
    -------
    OptimizeResult
        The best codebook, the history and why the method stopped.

    Raises
    ------
    ValueError
        If the method is unknown, positions are malformed, or no signals determine them.
    CodebookError
        If `start` does not fit the scenario.
    """
    if method not in METHODS:
        raise ValueError(f'method: {method!r}, expected one of {sorted(METHODS)}')
    if positions is None:
        positions = scenario.sample_positions(
            n_positions, streams.generator(seed, streams.SAMPLES))
    if start is None:
        start = random_codebook(scenario, streams.generator(seed, streams.START))
    start.check(scenario)
    problem = Problem(scenario, sampled_objective(scenario, positions))
    record = _Record(problem, progress)
    first = problem.pack(start)
    value, _ = record(first)
    if not np.isfinite(value):
        raise ValueError(
            f'positions: average CRLB {value} at the start, expected a finite one: the signals '
            'of the scenario do not determine the position')
    record.on_step()
    reason = METHODS[method](record, first, problem.bounds, max_steps, record.on_step)
    provenance = f'method {method}, seed {seed}, {len(positions)} positions'
    codebook = dataclasses.replace(
        problem.unpack(record.best), average_crlb_m2=record.value, provenance=provenance)
    return OptimizeResult(codebook, tuple(record.history), reason)


class _Record:
    """The objective as a method sees it; remembers the best point and the history."""

    def __init__(self, problem: Problem, progress: Callable[[Progress], None] | None) -> None:
        self._problem, self._progress = problem, progress
        self._begin = time.perf_counter()
        self._evaluations = 0
        self.value, self.best = np.inf, None
        self.history: list[Progress] = []

    def __call__(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = self._problem.value_and_gradient(variables)
        self._evaluations += 1
        if value < self.value:
            self.value, self.best = value, np.array(variables)
        return value, gradient

    def on_step(self) -> None:
        elapsed = time.perf_counter() - self._begin
        entry = Progress(len(self.history), self._evaluations, self.value, elapsed)
        self.history.append(entry)
        if self._progress:
            self._progress(entry)
