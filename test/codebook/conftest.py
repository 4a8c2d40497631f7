"""A small scenario that is fast to optimise, and problems with a known minimum."""

import dataclasses
import math

import numpy as np
import pytest

from rhs_isac_ros.codebook.optimize import _Report
from rhs_isac_ros.codebook.problem import Search
from rhs_isac_ros.model import Scenario

N_ANALOG = 10


class Quadratic:
    """A separable quadratic of 20 variables, the first 10 of them bounded; records its points.

    Like `Problem`, it clips the bounded variables.

    Attributes
    ----------
    best
        Position of the minimum, whose value is `floor`.
    points
        Points at which it was evaluated.
    """

    n_analog = N_ANALOG
    bounds = [(0.0, 1.0)] * N_ANALOG + [(None, None)] * N_ANALOG

    def __init__(self, seed: int, floor: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        self.weights, self.center = rng.uniform(1, 50, 20), rng.normal(size=20)
        clipped = np.clip(self.center, 0, 1)
        self.best = np.where(np.arange(20) < N_ANALOG, clipped, self.center)
        self.points: list[np.ndarray] = []
        self._constant = floor - float(np.sum(self.weights * (self.best - self.center)**2))

    def value(self, variables: np.ndarray) -> float:
        self.points.append(np.array(variables))
        return self._constant + float(np.sum(self.weights * self._offset(variables)**2))

    def value_and_gradient(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        return self.value(variables), 2 * self.weights * self._offset(variables)

    def _offset(self, variables: np.ndarray) -> np.ndarray:
        inside = np.where(np.arange(20) < N_ANALOG, np.clip(variables, 0, 1), variables)
        return inside - self.center


class Flat(Quadratic):
    """A constant function."""

    def value(self, variables: np.ndarray) -> float:
        self.points.append(np.array(variables))
        return 3.0

    def value_and_gradient(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        return self.value(variables), np.zeros(20)


@pytest.fixture(scope='package', autouse=True)
def no_ticks():
    """Report only steps: on a busy machine, the set-up can take longer than a tick."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Report, '_TICK_S', math.inf)
        yield


@pytest.fixture(scope='session')
def scenario(small) -> Scenario:
    return dataclasses.replace(small.scenario, roi_center_m=(4, 0, 0), roi_size_m=(2, 4, 2))


@pytest.fixture
def quadratic():
    """Callable that takes a seed and returns a quadratic."""
    return Quadratic


@pytest.fixture
def flat() -> Quadratic:
    return Flat(0)


@pytest.fixture
def search_of():
    """Callable that creates a search for a problem, by default from the middle of the bounds."""
    def make(problem, max_steps=10, *, start=None, seed=0) -> Search:
        start = np.full(20, 0.5) if start is None else start
        return Search(problem, start, max_steps, None, np.random.default_rng(seed), None)
    return make
