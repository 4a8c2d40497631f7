"""Impairments of the signals: unknown gains, phases, and offsets of timing and carrier.

Given the position, the elements of the surface (see `elements`) and a few Gaussian numbers, the
signals of a cycle are Gaussian. Each of the numbers is a nuisance parameter x with an exponent P:
the signals are multiplied by ``exp(x P)``. A real exponent is a gain in nepers, an imaginary one a
phase. The factor applies to the direct path and to the multipath, but not to the thermal noise.
The exponential wraps phases: with a standard deviation of a whole turn, a phase is nearly uniform.
An unknown phase is uniform, and so is an unknown offset over the period of its phases. An unknown
gain has no distribution: simulated signals have a gain of 1, which estimators do not know.

Simulation, estimators, bounds and calibration depend only on the interface `Impairment`. A new
impairment is a plug-in of the group ``rhs_isac_ros.impairments``, or a `Factor` in `BUILT_IN` with
a field of the scenario that declares it.
"""

import dataclasses
import enum
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.model.arrays import adjoint, numbers, read_only
from rhs_isac_ros.model.constants import NEPERS_PER_DB
from rhs_isac_ros.model.elements import ElementErrors, draw_surface, has_errors
from rhs_isac_ros.model.geometry import frame_lags_s, subband_frequencies_hz
from rhs_isac_ros.model.scenario import Scenario
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.errors import translated

# Standard deviation above which a wrapped phase is treated as uniform [rad].
UNIFORM_STD_RAD = 2.0
# Standard deviation below which the tails of a wrapped phase do not overlap, points of its density
# around the circle, and smallest information relative to a Gaussian's. It keeps matrices regular.
_SEPARATE_STD_RAD, _CIRCLE, NO_INFORMATION = 0.25, 256, 1e-12
# Standard deviation of the gain below which the gain has no effect [nepers].
_MIN_GAIN_STD = 1e-9
# Share of the multipath in derivatives above which it counts as 1, to save a product.
_WHOLE_SHARE = 0.7
# Relative deviation of phases from whole multiples of the smallest one.
_ROUNDING = 1e-9


class Scope(enum.Enum):
    """When the values of an impairment are drawn: once for each user, or anew in every cycle."""

    USER = 'user'
    CYCLE = 'cycle'


class Linear(NamedTuple):
    """The exponents of an impairment and the prior of its values."""

    patterns: np.ndarray  #: Exponents per unit of each value, complex128 [q, N_B, N_SB F].
    root: np.ndarray  #: Invertible factor L of the values' covariance L L^T, float64 [q, q].
    #: Whether the likelihood of a value has several maxima within its prior. Estimators then
    #: compare values on a grid before they refine one.
    needs_search: bool = False
    #: Whether the values have no prior. L then only sets their units.
    is_unknown: bool = False


class Impairment:
    """Base class of impairments: random values that change the gain and phase of the signals.

    A subclass defines `linear`. Its values are Gaussian unless it overrides `values`; estimators
    and bounds always assume the Gaussian prior of `linear`. `scope` states how often values are
    redrawn.
    """

    scope: Scope = Scope.CYCLE

    def linear(self, scenario: Scenario) -> Linear:
        """Return the exponents and the prior."""
        raise NotImplementedError

    def values(self, scenario: Scenario, white: np.ndarray) -> np.ndarray:
        """Map standard normal numbers [n, q] to values of n independent draws, [n, q]."""
        return white @ np.transpose(self.linear(scenario).root)


class Exponents:
    """Standard normal parameters z with exponents P: signals contain the factor exp(z P)."""

    scenario: Scenario
    scaled_patterns: np.ndarray  #: The exponents P, complex128 [Q, N_B, N_SB F].
    #: Whether a parameter changes measurements of the same band relative to each other, and so
    #: moves the multipath out of the nulls of its covariance, bool [Q].
    moves_multipath: np.ndarray

    def __len__(self) -> int:
        """Return the number Q of parameters."""
        return len(self.scaled_patterns)

    def divide(self, signals: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Remove the factors of values z [..., Q] from signals [..., N_B, N_SB F]."""
        shape = *signals.shape[:-1], self.scenario.n_subbands, self.scenario.n_frames
        divided = np.broadcast_to(signals.reshape(shape), np.broadcast_shapes(
            shape, (*values.shape[:-1], 1, 1, 1)))
        for rows, patterns in self._by_axes:
            exponents = values[..., rows] @ patterns.reshape(len(rows), -1)
            divided = divided * np.exp(-exponents).reshape(
                *values.shape[:-1], *patterns.shape[1:])
        return divided.reshape(*divided.shape[:-2], signals.shape[-1])

    @functools.cached_property
    def _by_axes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Indices of parameters, [q], and their exponents, complex128 [q, N_B, N_SB, F].

        Offsets of timing and carrier are the same in all frames or sub-bands of a band, which then
        appear once.
        """
        found: dict[tuple[int | None, ...], list[int]] = {}
        scenario, n_bands = self.scenario, self.scaled_patterns.shape[1]
        patterns = self.scaled_patterns.reshape(
            len(self), n_bands, scenario.n_subbands, scenario.n_frames)
        for row in np.flatnonzero(patterns.any(axis=(1, 2, 3))).tolist():
            kept = [None if np.ptp(patterns[row], axis=axis).any() else 1 for axis in range(3)]
            found.setdefault(tuple(kept), []).append(row)
        return [(np.array(rows), patterns[rows][:, :bands, :subbands, :frames])
                for (bands, subbands, frames), rows in found.items()]

    def derivatives(self, divided: np.ndarray, mean: np.ndarray,
                    share: np.ndarray | float = 1.0) -> np.ndarray:
        """Return the derivatives of signals with respect to z, [N, Q, N_B, N_SB F].

        Takes signals after `divide`, and their mean, [N, N_B, N_SB F]. For a parameter that moves
        the multipath, the derivative contains the signals, including the received multipath, so it
        differs between positioning phases. For any other parameter, it contains only the mean.
        `share`, [Q] or a number, is the factor of the received multipath.
        """
        share = (share * self.moves_multipath)[:, None, None]
        return self.scaled_patterns * (share * divided[:, None] + (1 - share) * mean[:, None])

    def operators(self, root: np.ndarray, whitener: np.ndarray) -> np.ndarray:
        """Compute W P W^-1, which applies P to whitened signals, [Q, N_B, N_SB F, N_SB F]."""
        return np.matmul(whitener * self.scaled_patterns[:, :, None], root)

    def information_of(self, root: np.ndarray, whitener: np.ndarray) -> np.ndarray:
        """Compute the Fisher information of a covariance about the parameters, [Q, Q]."""
        # The multipath reveals gains and offsets of carrier and timing, but no phase.
        operators = self.operators(root, whitener)
        both = operators + adjoint(operators)
        return np.einsum('aimn,binm->ab', both, both, optimize=True).real

    def share_of_multipath(self, root: np.ndarray, whitener: np.ndarray) -> np.ndarray:
        """Return the factor of the received multipath in `derivatives`, float64 [Q].

        The square of a derivative then has the expected information of the covariance. Multipath
        that changes from frame to frame turns without any trace.
        """
        information = np.diagonal(self.information_of(root, whitener))
        energy = 2 * np.sum(np.abs(self.operators(root, whitener))**2, axis=(1, 2, 3))
        share = np.sqrt(information / np.where(energy, energy, 1.0))
        return self.moves_multipath * np.where(share > _WHOLE_SHARE, 1.0, share)


class Nuisance(Exponents):
    """The nuisance parameters of all impairments of a scenario.

    The parameters are x = L z with standard normal z. Bounds and estimators use z, which is
    dimensionless. `patterns` and `scaled_patterns`, complex128 [Q, N_B, N_SB F], are the exponents
    per unit of x and of z. `needs_search`, bool [Q], is the flag of `Linear` for each parameter.
    `phases`, float64 [N_B, Q], is the phase of each band per unit of z; it is 0 for every
    parameter that does more than rotate the phases of whole bands. `gains`, float64 [N_B, Q], is
    the gain of each band per unit of z [nepers], and `has_gain` is whether any is not negligible.
    `precision`, float64 [Q], is
    the information of the prior about z, from `NO_INFORMATION` to 1; see `wrapped_precision`.
    `period`, float64 [Q], is the change of z that does not change the factors; infinite if there
    is none. Parameters without information, whose effect others have as well, are left out of
    everything but `patterns`.
    """

    def __init__(self, scenario: Scenario, parts: Sequence[Linear]) -> None:
        self.scenario, none = scenario, np.zeros((0, *_shape(scenario)), complex)
        self.patterns = read_only(np.concatenate([none, *(part.patterns for part in parts)]))
        scaled = np.concatenate([none, *(
            np.tensordot(part.root.T, part.patterns, axes=1) for part in parts)])
        needs_search, is_unknown = (
            np.repeat(flags, [len(part.root) for part in parts]).astype(bool) for flags in (
                [part.needs_search for part in parts], [part.is_unknown for part in parts]))
        steps = np.array([_phase_step(pattern) for pattern in scaled])
        precision = np.where(is_unknown, 0.0, [
            wrapped_precision(step) for step in steps])
        precision = np.maximum(precision, NO_INFORMATION)
        kept = _independent(scaled, precision)
        self.scaled_patterns, self.precision = read_only(scaled[kept]), read_only(precision[kept])
        self.needs_search = needs_search[kept]
        with np.errstate(divide='ignore'):
            self.period = read_only(2 * np.pi / steps[kept])
        self.moves_multipath = np.ptp(self.scaled_patterns, axis=2).any(axis=1)
        self.gains = read_only(self.scaled_patterns.real.mean(axis=2).T)
        self.has_gain = bool(np.abs(self.gains).max(initial=0.0) > _MIN_GAIN_STD)
        turns = ~self.moves_multipath & ~self.scaled_patterns.real.any(axis=(1, 2))
        self.phases = read_only(np.where(turns, self.scaled_patterns[:, :, 0].imag.T, 0.0))

    @property
    def scaled_phases(self) -> tuple[np.ndarray, np.ndarray]:
        """The columns of `phases` that are not zero, float64 [N_B, q], and their `precision`."""
        turns = self.phases.any(axis=0)
        return self.phases[:, turns], self.precision[turns]

    def factors(self, values: np.ndarray) -> np.ndarray:
        """Compute the factors exp(x P) for values x [..., Q], complex128 [..., N_B, N_SB F]."""
        return np.exp(np.tensordot(values, self.patterns, axes=1))


def wrapped_precision(std_rad: float) -> float:
    """Return the information of a wrapped normal prior of a phase in standard deviations, 0 to 1.

    The Fisher information about the location of the density is this divided by std^2: about
    1 / std^2 for small standard deviations, and 2 exp(-std^2) for large ones.
    """
    if std_rad < _SEPARATE_STD_RAD:
        return 1.0
    # On a circle, equal weights integrate smooth functions up to rounding errors.
    angle = np.arange(_CIRCLE) * (2 * np.pi / _CIRCLE)
    order = np.arange(1, math.ceil(9 / std_rad) + 1)
    harmonic = 2 * np.exp(-(std_rad * order)**2 / 2)
    density = 1 + np.cos(np.outer(angle, order)) @ harmonic
    slope = np.sin(np.outer(angle, order)) @ (order * harmonic)
    return std_rad**2 * float(np.mean(slope**2 / np.maximum(density, np.finfo(float).eps)))


def _phase_step(pattern: np.ndarray) -> float:
    """Return the phase [rad] of which all imaginary exponents are whole multiples, or 0."""
    turns = np.abs(pattern.imag[pattern != 0])
    if not turns.size or pattern.real.any():
        return 0.0
    multiples = turns / turns.min()
    is_whole = np.abs(multiples - np.round(multiples)) <= _ROUNDING * multiples
    return float(turns.min()) if is_whole.all() else 0.0


def _independent(scaled: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Mark parameters with a prior, and a largest set of independent ones without, bool [Q]."""
    kept = precision > NO_INFORMATION
    basis: list[np.ndarray] = []
    width = math.prod(scaled.shape[1:])
    columns = np.ascontiguousarray(scaled).reshape(len(scaled), width).view(float)
    # The phases of the bands come last; the others only follow from them.
    for row in np.flatnonzero(~kept)[::-1]:
        rest = columns[row] - sum((column @ columns[row]) * column for column in basis)
        length = np.linalg.norm(rest)
        if length > _ROUNDING * np.linalg.norm(columns[row]):
            kept[row] = True
            basis.append(rest / length)
    return kept


def _carrier_offset(scenario: Scenario) -> np.ndarray:
    return 2j * np.pi * np.broadcast_to(
        np.tile(frame_lags_s(scenario), scenario.n_subbands), (1, *_shape(scenario)))


def _timing_offset(scenario: Scenario) -> np.ndarray:
    centers = np.array(scenario.center_frequencies_hz)[:, None]
    offsets = subband_frequencies_hz(scenario) - centers
    return -2j * np.pi * np.repeat(offsets, scenario.n_frames, axis=1)[None]


def _shape(scenario: Scenario) -> tuple[int, int]:
    return scenario.n_bands, scenario.n_subbands * scenario.n_frames


@dataclasses.dataclass(frozen=True)
class Factor(Impairment):
    """An impairment with independent values, whose standard deviation is a scenario field."""

    field: str
    # Function that returns the exponents per unit of the values.
    patterns: Callable[[Scenario], np.ndarray]
    # One unit of the field, expressed in the unit of the values.
    unit: float = 1.0
    needs_search: bool = False
    scope: Scope = Scope.CYCLE

    def std(self, scenario: Scenario) -> float:
        """Return the declared standard deviation in the unit of the values, or infinity."""
        return float(getattr(scenario, self.field)) * self.unit

    def linear(self, scenario: Scenario) -> Linear:
        """Return the exponents and the prior.

        The unit of an unknown value is the period of its phases, so that normal numbers are
        uniform in it, or 1.
        """
        patterns, std = self.patterns(scenario), self.std(scenario)
        is_unknown = std == math.inf
        if is_unknown:
            std = 2 * np.pi / (_phase_step(patterns[0]) or 2 * np.pi)
        return Linear(patterns, std * np.eye(len(patterns)), self.needs_search, is_unknown)

    def values(self, scenario: Scenario, white: np.ndarray) -> np.ndarray:
        """Map standard normal numbers [n, q] to values; an unknown gain is 0 dB."""
        linear = self.linear(scenario)
        has_distribution = not linear.is_unknown or linear.patterns.imag.any()
        return has_distribution * (white @ linear.root.T)


BUILT_IN: tuple[Factor, ...] = (
    Factor('user_gain_std_db', lambda scenario: np.ones((1, *_shape(scenario)), complex),
           unit=NEPERS_PER_DB, scope=Scope.USER),
    Factor('carrier_offset_std_hz', _carrier_offset, needs_search=True, scope=Scope.USER),
    Factor('phase_std_rad', lambda scenario: np.full((1, *_shape(scenario)), 1j)),
    Factor('timing_std_s', _timing_offset, needs_search=True),
    Factor('band_phase_std_rad', lambda scenario: 1j * np.eye(scenario.n_bands)[
        :, :, None] * np.ones(_shape(scenario))),
)


def impairments_of(scenario: Scenario) -> tuple[Impairment, ...]:
    """Return the impairments of the signals that a scenario declares; none for Table I.

    Raises PluginError if a plug-in cannot be loaded, fails or does not return an `Impairment`.
    """
    return (*(one for one in BUILT_IN if one.std(scenario) > 0), *_installed(scenario))


@plugins.cached
def nuisance_of(scenario: Scenario) -> Nuisance:
    """Return the nuisance parameters of all impairments that a scenario declares.

    Raises PluginError if an impairment has no valid exponents, covariance or scope.
    """
    return Nuisance(scenario, [_linear(one, scenario) for one in impairments_of(scenario)])


def _linear(one: Impairment, scenario: Scenario) -> Linear:
    with plugins.calling(f'{type(one).__name__}.linear'):
        linear = one.linear(scenario)
    with translated(ValueError, plugins.PluginError, type(one).__name__):
        if not isinstance(linear, Linear) or not isinstance(one.scope, Scope):
            raise ValueError(f'linear: {linear!r}, scope: {one.scope!r}, expected a Linear '
                             'and a Scope')
        patterns = numbers('patterns', linear.patterns, complex,
                           shapes=[('q', *_shape(scenario))])
        root = numbers('root', linear.root, shapes=[(len(patterns), len(patterns))])
    return linear._replace(patterns=patterns, root=root)


def draw_factors(
        scenario: Scenario, n: int, user: np.random.Generator, cycle: np.random.Generator
) -> np.ndarray | None:
    """Draw the factors of n signals, each of one user in one cycle, complex128 [n, N_B, N_SB F].

    The generators `user` and `cycle` draw the values of the two scopes. Values of a built-in
    impairment do not depend on the other declarations. Returns None if no impairment is declared.
    """
    declared = impairments_of(scenario)
    if not declared:
        return None
    nuisance, generators = nuisance_of(scenario), {Scope.USER: user, Scope.CYCLE: cycle}
    # A plug-in may be unhashable.
    values: dict[int, np.ndarray] = {}
    for group in (BUILT_IN, _installed(scenario)):
        for scope, rng in generators.items():
            members = [one for one in group if one.scope is scope]
            sizes = [len(_linear(one, scenario).root) for one in members]
            white = np.split(rng.standard_normal((n, sum(sizes))), np.cumsum(sizes), axis=1)
            values |= {id(one): _values(one, scenario, part)
                       for one, part in zip(members, white, strict=False) if one in declared}
    return nuisance.factors(
        np.concatenate([values[id(one)] for one in declared], axis=1))


def _values(one: Impairment, scenario: Scenario, white: np.ndarray) -> np.ndarray:
    with plugins.calling(place := f'{type(one).__name__}.values'):
        values = one.values(scenario, white)
    return numbers(place, values, error=plugins.PluginError, shapes=[white.shape])


def draw_impairments(
        scenario: Scenario, n: int, rng: np.random.Generator
) -> tuple[ElementErrors | None, np.ndarray | None]:
    """Draw a surface, and the factors of n positioning phases, complex128 [n, N_B, N_SB F].

    Each phase has a new user. The surface is None if no errors of elements are declared, and the
    factors are None if no impairment is. The numbers come from children of the generator, so that
    the multipath and noise drawn from `rng` itself do not depend on the declarations.
    """
    if not has_errors(scenario) and not impairments_of(scenario):
        return None, None
    of_surface, of_users = rng.spawn(2)
    surface = draw_surface(scenario, of_surface) if has_errors(scenario) else None
    return surface, draw_factors(scenario, n, of_users, of_users)


def _installed(scenario: Scenario) -> tuple[Impairment, ...]:
    return tuple(_load(name, strength) for name, strength in scenario.impairments)


@plugins.cached
def _load(name: str, strength: float) -> Impairment:
    return plugins.make(plugins.IMPAIRMENTS, name, Impairment, strength, in_file=True)
