"""The optimisation problem of a codebook, and the search that a method performs on it."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from rhs_isac_ros.bounds import PairwiseErrorCost
from rhs_isac_ros.bounds.average import Average
from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import on_levels


class Problem:
    """Implements Eq. (16). Problem P1, with any `Average` as the objective to minimise.

    Solvers operate on one real vector: the configurations, then the real and the imaginary parts
    of unscaled combining vectors. `unpack` scales those of each frame to the power P_max, which
    eliminates the power constraint. Solvers must keep the configurations in [0, 1]. Elements that
    are not `used`, bool [N_E], are 0 whatever their variables.
    """

    def __init__(self, scenario: Scenario, objective: Average,
                 used: np.ndarray | bool = True) -> None:
        self.scenario, self._used = scenario, used
        self.objective = objective
        sizes = scenario.sizes
        self._analog_shape = tuple(sizes[s] for s in ('N_B', 'F', 'N_E'))
        self._digital_shape = tuple(sizes[s] for s in ('N_B', 'N_SB', 'F', 'K'))
        self.n_analog = int(np.prod(self._analog_shape))

    @property
    def bounds(self) -> list[tuple[float, float] | tuple[None, None]]:
        """Bounds of each variable, in SciPy's format."""
        n_digital = 2 * int(np.prod(self._digital_shape))
        return [(0.0, 1.0)] * self.n_analog + [(None, None)] * n_digital

    def pack(self, codebook: Codebook) -> np.ndarray:
        """Return the variables of a codebook, float64 [N_B F N_E + 2 N_B N_SB F K]."""
        digital = codebook.digital / np.sqrt(self.scenario.max_power_w)
        return np.concatenate(
            [codebook.analog.ravel(), digital.real.ravel(), digital.imag.ravel()])

    def unpack(self, variables: np.ndarray, *, relaxed: bool = False) -> Codebook:
        """Return the codebook for variables ordered as in `pack`, with the power P_max.

        Unless `relaxed`, configurations are rounded to the amplitudes that elements can take.
        """
        analog, raw, norm = self._split(variables)
        if not relaxed:
            analog = on_levels(self.scenario, analog)
        return Codebook(analog, raw * (np.sqrt(self.scenario.max_power_w) / norm))

    @property
    def n_pairs(self) -> int:
        """Number of pairs in the objective; 0 if it does not consist of pairs."""
        cost = self.objective
        return cost.rows.n_items if isinstance(cost, PairwiseErrorCost) else 0

    def sample(self, variables: np.ndarray, n_pairs: int, rng: np.random.Generator) -> 'Problem':
        """Return the problem with a sample of its pairs; see `PairwiseErrorCost.sample`."""
        cost = self.objective
        assert isinstance(cost, PairwiseErrorCost)
        sample = cost.sample(self.unpack(variables), n_pairs, rng)
        return Problem(self.scenario, sample, self._used)

    def value(self, variables: np.ndarray) -> float:
        """Return the objective [m^2] for variables ordered as in `pack`."""
        return self.objective.value(self.unpack(variables))

    def value_and_gradient(
            self, variables: np.ndarray, *, relaxed: bool = False) -> tuple[float, np.ndarray]:
        """Return the objective [m^2] and its gradient, float64 [n]; see `unpack` for `relaxed`."""
        _, raw, norm = self._split(variables)
        value, by_analog, by_digital = self.objective(self.unpack(variables, relaxed=relaxed))
        # Scaling to a fixed norm removes the component of the gradient along `raw`.
        radial = np.sum((np.conj(raw) * by_digital).real, axis=(1, 3), keepdims=True)
        by_raw = np.sqrt(self.scenario.max_power_w) / norm * (by_digital - raw * radial / norm**2)
        return value, np.concatenate(
            [(self._used * by_analog).ravel(), by_raw.real.ravel(), by_raw.imag.ravel()])

    def _split(self, variables: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return configurations, unscaled combining vectors, and their norm in each frame."""
        analog = self._used * np.clip(variables[:self.n_analog], 0.0, 1.0).reshape(
            self._analog_shape)
        real, imag = np.split(variables[self.n_analog:], 2)
        raw = (real + 1j * imag).reshape(self._digital_shape)
        norm = np.sqrt(np.sum(np.abs(raw)**2, axis=(1, 3), keepdims=True))
        return analog, raw, norm


@dataclasses.dataclass(frozen=True)
class Progress:
    """Numbers of steps and evaluations so far, lowest objective, and time since the start."""

    step: int
    evaluations: int
    value_m2: float
    elapsed_s: float


class BudgetSpent(Exception):
    """No evaluation is left; methods must not catch this exception."""


class Search:
    """The objective that a method minimises, with a count of evaluations and the best point.

    Each method defines its own update steps. `done` contains the numbers of steps and evaluations
    of a resumed search, which count towards the limits. The attribute `start`, float64 [n], is the
    first point, and `max_steps` is the limit less the steps in `done`. `value_m2` is the lowest
    objective so far, at the point `best`. `history` has an entry for the start and for each step.
    """

    def __init__(
            self, problem: Problem, start: np.ndarray, max_steps: int,
            max_evaluations: int | None, rng: np.random.Generator,
            progress: Callable[[Progress], None] | None,
            done: tuple[int, int] = (0, 0)) -> None:
        self._first_step, self._evaluations = done
        self.start, self.max_steps, self.rng = start, max_steps - self._first_step, rng
        self.problem, self.bounds, self.n_analog = problem, problem.bounds, problem.n_analog
        self._progress, self._max_evaluations = progress, max_evaluations
        self._begin = time.perf_counter()
        self.value_m2, self.best = np.inf, start
        self.history: list[Progress] = []
        self._last: tuple[np.ndarray, float, np.ndarray] | None = None

    def begin(self) -> float:
        """Evaluate the objective [m^2] at the start, and record the first entry of the history.

        In a resumed search, the evaluation does not count, because the earlier search counted it.
        """
        if self._evaluations:
            self._evaluations -= 1
        value, _ = self.value_and_gradient(self.start)
        self.on_step()
        return value

    def finish(self) -> None:
        """Record a last step if none is recorded yet, or evaluations followed the latest one."""
        if not self.history or self._evaluations > self.history[-1].evaluations:
            self.on_step()

    def value(self, variables: np.ndarray) -> float:
        """Evaluate the objective [m^2] at a point, float64 [n], or raise BudgetSpent."""
        self._count()
        value = self.problem.value(variables)
        self._keep_best(value, variables)
        return value

    def value_and_gradient(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        """Evaluate the objective [m^2] and its gradient, float64 [n], or raise BudgetSpent."""
        # The last result is kept, because a solver often begins where another one ended.
        if self._last is None or not np.array_equal(self._last[0], variables):
            self._count()
            value, gradient = self.problem.value_and_gradient(variables)
            self._keep_best(value, variables)
            self._last = np.array(variables), value, gradient
        return self._last[1:]

    def relaxed_value_and_gradient(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        """Evaluate both with continuous amplitudes; never record the point as the best one."""
        self._count()
        return self.problem.value_and_gradient(variables, relaxed=True)

    def sample(
            self, variables: np.ndarray, n_pairs: int
    ) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
        """Return a function that estimates `value_and_gradient` from a sample of `n_pairs` pairs.

        The sample is for codebooks near `variables`. The function never records the best point. It
        raises BudgetSpent if no evaluation would be left for the final point.
        """
        problem = self.problem.sample(variables, n_pairs, self.rng)

        def evaluate(point: np.ndarray) -> tuple[float, np.ndarray]:
            self._count(reserve=1)
            return problem.value_and_gradient(point)
        return evaluate

    def on_step(self) -> None:
        """Record a step; methods call this after each of their steps."""
        elapsed = time.perf_counter() - self._begin
        step = self._first_step + len(self.history)
        entry = Progress(step, self._evaluations, self.value_m2, elapsed)
        self.history.append(entry)
        if self._progress:
            self._progress(entry)

    def _count(self, reserve: int = 0) -> None:
        if (self._max_evaluations is not None
                and self._evaluations + reserve >= self._max_evaluations):
            raise BudgetSpent
        self._evaluations += 1

    def _keep_best(self, value: float, variables: np.ndarray) -> None:
        if value < self.value_m2:
            self.value_m2, self.best = value, np.array(variables)
