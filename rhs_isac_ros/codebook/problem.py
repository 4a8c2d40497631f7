"""The optimisation problem: objective, constraints and variables."""

import numpy as np

from rhs_isac_ros.bounds import PairwiseErrorCost
from rhs_isac_ros.bounds.average import Average
from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import on_levels


class Problem:
    """Implements Eq. (16). Problem P1: average bound, fixed power, configurations in [0, 1].

    Solvers work on one real vector: the configurations, followed by the real and the imaginary
    parts of unscaled combining vectors. Scaling these to P_max eliminates the power constraint;
    the solver enforces the bounds of the configurations.
    """

    def __init__(self, scenario: Scenario, objective: Average) -> None:
        self.scenario = scenario
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

    def unpack(self, variables: np.ndarray) -> Codebook:
        """Return the codebook of variables from `pack`; it satisfies all constraints.

        Configurations are rounded to the amplitudes that the elements can take.
        """
        return self._codebook(variables, relaxed=False)

    @property
    def n_pairs(self) -> int:
        """Number of pairs of the objective that samples are drawn from; 0 if it has no pairs."""
        cost = self.objective
        return cost.rows.n_items if isinstance(cost, PairwiseErrorCost) else 0

    def sample(self, variables: np.ndarray, n_pairs: int, rng: np.random.Generator) -> 'Problem':
        """Return the problem with a sample of the pairs, see `PairwiseErrorCost.sample`.

        Raise ValueError if the objective has fewer pairs.
        """
        cost = self.objective
        if not isinstance(cost, PairwiseErrorCost):
            raise ValueError('objective: expected one of pairs to draw a sample of')
        return Problem(self.scenario, cost.sample(self.unpack(variables), n_pairs, rng))

    def value(self, variables: np.ndarray) -> float:
        """Return the objective [m^2] for variables as `pack` returns them."""
        return self.objective.value(self.unpack(variables))

    def value_and_gradient(
            self, variables: np.ndarray, *, relaxed: bool = False) -> tuple[float, np.ndarray]:
        """Return the objective [m^2] and its gradient, float64, shaped like `variables`.

        Both are those of the codebook of `unpack`. If relaxed, configurations are not rounded.
        """
        _, raw, norm = self._split(variables)
        value, by_analog, by_digital = self.objective(self._codebook(variables, relaxed=relaxed))
        # d(raw / norm) has no component along raw.
        radial = np.sum((np.conj(raw) * by_digital).real, axis=(1, 3), keepdims=True)
        by_raw = np.sqrt(self.scenario.max_power_w) / norm * (by_digital - raw * radial / norm**2)
        return value, np.concatenate(
            [by_analog.ravel(), by_raw.real.ravel(), by_raw.imag.ravel()])

    def _codebook(self, variables: np.ndarray, *, relaxed: bool) -> Codebook:
        analog, raw, norm = self._split(variables)
        if not relaxed:
            analog = on_levels(self.scenario, analog)
        return Codebook(analog, raw * (np.sqrt(self.scenario.max_power_w) / norm))

    def _split(self, variables: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return configurations, unscaled combining vectors, and their norm in each frame."""
        analog = np.clip(variables[:self.n_analog], 0.0, 1.0).reshape(self._analog_shape)
        real, imag = np.split(variables[self.n_analog:], 2)
        raw = (real + 1j * imag).reshape(self._digital_shape)
        norm = np.sqrt(np.sum(np.abs(raw)**2, axis=(1, 3), keepdims=True))
        return analog, raw, norm
