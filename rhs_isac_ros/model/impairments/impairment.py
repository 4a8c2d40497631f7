"""The interface of an impairment of the signals, and the nuisance parameters of all of them.

Every nuisance parameter x has an exponent P of the signals of a cycle: they are multiplied by
``exp(x P)``. A real exponent is a gain in nepers, an imaginary one a phase. The factor applies to
the direct path and to the multipath, but not to the thermal noise. The exponential wraps phases,
so that a phase whose standard deviation is a turn is uniform.
"""

import enum
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.scenario import Scenario

# Standard deviation from which a wrapped phase is treated as uniform [rad].
UNIFORM_STD_RAD = 2.0


class Scope(enum.Enum):
    """How long the value of an impairment lasts."""

    USER = 'user'
    CYCLE = 'cycle'


class Linear(NamedTuple):
    """The exponents of an impairment and the prior of its values.

    Attributes
    ----------
    patterns
        Exponent of the signals per unit of each value, complex128 [q, N_B, N_SB F].
    root
        Factor L of the covariance L L^T of the values, float64 [q, q], regular.
    needs_search
        Whether the likelihood of a value has several maxima within its prior, so that estimators
        compare values on a grid before they refine one.
    """

    patterns: np.ndarray
    root: np.ndarray
    needs_search: bool = False


class Impairment:
    """An impairment of the signals.

    A subclass defines `size` and `linear`. Its values are Gaussian unless it overrides `values`;
    estimators and bounds always assume the Gaussian prior of `linear`.

    Attributes
    ----------
    scope
        When the values are drawn anew.
    """

    scope: Scope = Scope.CYCLE

    def size(self, scenario: Scenario) -> int:
        """Return the number q of values."""
        raise NotImplementedError

    def linear(self, scenario: Scenario) -> Linear:
        """Return exponents and prior."""
        raise NotImplementedError

    def values(self, scenario: Scenario, white: np.ndarray) -> np.ndarray:
        """Map standard normal numbers [n, q] to values of n independent draws, [n, q]."""
        return white @ self.linear(scenario).root.T


class Nuisance:
    """The nuisance parameters of a scenario: those of all impairments together.

    The parameters are x = L z with standard normal z. Bounds and estimators use z, which needs no
    units.

    Attributes
    ----------
    patterns, scaled_patterns
        Exponent of the signals per unit of x and of z, complex128 [Q, N_B, N_SB F].
    needs_search
        As in `Linear`, bool [Q].
    moves_multipath
        Which of z change measurements of one band relative to each other, bool [Q]. These move the
        multipath out of the nulls of its covariance.
    phases
        Phase of each band per unit of those z that only turn whole bands, and 0 for all others,
        float64 [N_B, Q].
    """

    def __init__(self, scenario: Scenario, parts: Sequence[Linear]) -> None:
        shape = scenario.n_bands, scenario.n_subbands * scenario.n_frames
        self.patterns = np.concatenate(
            [np.zeros((0, *shape), complex), *(part.patterns for part in parts)])
        sizes = [len(part.patterns) for part in parts]
        starts = np.cumsum([0, *sizes])
        root = np.zeros((starts[-1], starts[-1]))
        for start, part in zip(starts, parts, strict=False):
            block = slice(start, start + len(part.root))
            root[block, block] = part.root
        self.scaled_patterns: np.ndarray = np.tensordot(root.T, self.patterns, axes=1)
        self.needs_search = np.repeat([part.needs_search for part in parts], sizes).astype(bool)
        self.moves_multipath = np.ptp(self.scaled_patterns, axis=2).any(axis=1)
        turns = ~self.moves_multipath & ~self.scaled_patterns.real.any(axis=(1, 2))
        self.phases = np.where(turns, self.scaled_patterns[:, :, 0].imag.T, 0.0)
        for array in (self.patterns, self.scaled_patterns, self.phases):
            array.flags.writeable = False

    def __len__(self) -> int:
        """Return the number Q of parameters."""
        return len(self.patterns)

    @property
    def scaled_phases(self) -> np.ndarray:
        """The columns of `phases` that are not zero, float64 [N_B, q]."""
        return self.phases[:, self.phases.any(axis=0)]

    def factors(self, values: np.ndarray) -> np.ndarray:
        """Compute the factors exp(x P) for values x [..., Q], complex128 [..., N_B, N_SB F]."""
        return np.exp(np.tensordot(values, self.patterns, axes=1))
