"""Modes of the posterior as a mixture over sets of failed elements.

`DispersedLikelihood` replaces the mixture by one Gaussian for each number of failures. It ignores
what the signals reveal about the set of failed elements. Yet even a single failure has an effect
far above the multipath in the nulls of its covariance. This module finds the sets with a
substantial weight by adding elements to the most probable sets, one at a time.

A failed element is stuck at an amplitude that is uniform in [0, 1]. If its amplitude is treated as
Gaussian, with mean 1/2 and variance 1/12, the signals are Gaussian. In the direct path, the
amplitude is one more unknown, in which the mean is linear. In the multipath, the variance of the
amplitude adds to the covariance. The search for sets uses the average covariance of the elements'
errors, and the likelihood of a set uses their covariance at each point.
"""

import collections
import copy
import dataclasses
import functools
import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import adjoint, blocks, n_sufficient
from rhs_isac_ros.model.elements import DeclaredElements, ElementErrors
from rhs_isac_ros.model.gaussian import energy_limit
from rhs_isac_ros.model.los import frame_gains
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.surface import radiation_matrix
from rhs_isac_ros.positioning.dispersed import (
    DispersedLikelihood,
    InterpolatedCovariance,
    LocatedStates,
)
from rhs_isac_ros.positioning.grid import Starts, TemplateTable
from rhs_isac_ros.positioning.likelihood import (
    Columns,
    Conditional,
    Factors,
    Likelihood,
    Signals,
    assemble,
)
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.search import Modes, OneState, Refinement, ascend, predict
from rhs_isac_ros.positioning.segments import concatenate, select
from rhs_isac_ros.support.recent import Recent

# Largest expected number of failures for which sets are searched.
_MAX_EXPECTED = 2.0
# Number of sets whose covariance is kept, their memory, and that of their extensions [bytes], of
# which a block is computed at a time.
_MAX_SURFACES, _SURFACE_BYTES = 256, 1 << 25
_EXTENSION_BYTES, _BLOCK_BYTES = 1 << 26, 1 << 24
# Bounds of places elsewhere, among them those without a direct path.
_ANYWHERE_M = np.array([[0.0, -2e7, -2e7], [2e7, 2e7, 2e7]])
# Number of places at which all elements are compared at a time.
_PLACES = 8
# The residual of an intact surface exceeds the usual residual with this probability. If the
# observed residual does not exceed it, sets grow from this number of modes.
_UNUSUAL = 0.01
_USUAL_MODES = 2
# If it does: largest number of grid points besides the modes, their margin, and number of places.
_POINTS = 64
_POINT_MARGIN = 30.0
_SEARCHED = 64
# Factor of the share of further failures while sets are ranked.
_REMAINDER = 0.3
# Number of hypotheses to extend, in all, of the same set, and of the same place.
_EXTENDED = 16
_PER_SET = 3
_PER_PLACE = 4
# Number of extended hypotheses to weigh exactly.
_EXACT = 16
# Largest number of elements by which a set grows.
_GROWTH = 6
# Number of sets to try at all places.
_TRIED_EVERYWHERE = 4
# Hypotheses are dropped if their log-probability is below the best by more than these margins,
# before and during the exact steps.
_MARGIN = 9.0
_STEP_MARGIN = 27.0
# Smallest number of hypotheses to keep, and share of those left out: signals that say little
# about the position agree with hundreds of them.
_HYPOTHESES, _LEFT_OUT = 48, 0.01
# Number of exact steps.
_STEPS = 2

# A set of failed elements in ascending order, and a hypothesis: a set with the index of a place.
Failed: TypeAlias = tuple[int, ...]
Key: TypeAlias = tuple[Failed, int]


def can_enumerate(scenario: Scenario) -> bool:
    """Return whether failures are declared, and so rare that their sets can be searched."""
    return 0 < scenario.failed_element_share * scenario.n_elements <= _MAX_EXPECTED


def refinement_of(likelihood: Likelihood) -> Refinement:
    """Return the refinement for what a likelihood does not contain about the elements."""
    if likelihood.surface is None and can_enumerate(likelihood.scenario):
        return FailedElements(likelihood)
    return OneState(likelihood)


class FailedElements:
    """Refinement if a few elements of the surface may have failed: a `Refinement`."""

    # The search for modes averages over sets, and so misjudges each of them.
    margin, is_exact = 10.0, False

    def __init__(self, likelihood: Likelihood) -> None:
        self._likelihood, self._model = likelihood, FailureModel(likelihood)
        self._average = DispersedLikelihood(likelihood)
        # The likelihood of users anywhere in front of the surface.
        self._elsewhere = copy.copy(likelihood)
        self._elsewhere.resolution = likelihood.resolution._replace(bounds_m=_ANYWHERE_M)

    def refine(self, modes: Modes, signals: Signals, table: TemplateTable
               ) -> tuple[Modes, dict[int, Sequence[Conditional]]]:
        """Return modes for all probable sets, and the sets' likelihoods, by shot."""
        parts, conditionals = [], {}
        for shot in np.unique(modes.shots).tolist():
            one = select(signals, [shot])
            part, conditionals[shot] = self._modes(
                self._search(modes.of_shot(shot), one, table), self._likelihood, one)
            # Each part counts its shots from 0.
            parts.append(part._replace(shots=np.full(len(part.shots), shot)))
        return concatenate(*parts), conditionals

    def same(self, other: Conditional) -> Conditional:
        """Return the likelihood for the failed elements of another one; see `Refinement.same`."""
        assert isinstance(other, FailedSet)
        return self._model.failed_set(other.failed)

    def gain(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> float:
        """Return how much sets at points elsewhere explain one shot; see `Refinement.gain`."""
        search = FailureSearch(self._model, signals)
        self._grow(search, search.add(points, values))
        modes, _ = self._modes(search, self._elsewhere, signals)
        averaged = ascend(
            self._average, self._elsewhere, Starts(np.zeros(len(points), int), points, values),
            signals, _STEPS, _STEP_MARGIN)
        return max(modes.log_mass - averaged.log_mass, 0.0)

    def _search(self, modes: Modes, signals: Signals, table: TemplateTable) -> 'FailureSearch':
        """Search for probable sets of failed elements at the modes and, if needed, elsewhere."""
        order = modes.order
        search = FailureSearch(self._model, signals)
        keys = search.add(modes.points[order], modes.values[order])
        if not search.explains(keys):
            # The search on the grid needs the parameters that move the multipath.
            aligned = modes.values[order[0]] * self._likelihood.nuisance.moves_multipath
            found = table.starts(
                self._likelihood.whitened(aligned, signals), self._likelihood.nuisance,
                _POINT_MARGIN)
            search.add(found.points[:_POINTS], found.values[:_POINTS] + aligned)
        self._grow(search, keys)
        return search

    def _grow(self, search: 'FailureSearch', keys: list[Key]) -> None:
        """Grow sets at the best of the first places or, if none explains the signals, at all."""
        if search.explains(keys):
            search.grow(keys[:_USUAL_MODES])
        else:
            chosen = first_places(
                np.stack([place.point for place in search.places]),
                self._likelihood.resolution.separation(self._likelihood.nuisance.is_coarse))
            search.grow([((), index) for index in chosen], _REMAINDER)
        search.try_neighbours(search.best)

    def _modes(self, search: 'FailureSearch', likelihood: Likelihood, signals: Signals
               ) -> tuple[Modes, Sequence[Conditional]]:
        """Return the modes of the probable sets of one shot, and the sets' likelihoods."""
        values, best = search.log_probabilities, max(search.log_probabilities.values())
        keys = sorted((key for key in values if values[key] >= best - _MARGIN),
                      key=lambda key: -values[key])
        keys = keys[:max(_HYPOTHESES, n_sufficient([values[key] for key in keys], _LEFT_OUT))]
        # Predictions favour sets that imitate the signals, so no failure is always tried.
        sets = list(dict.fromkeys([(), *(failed for failed, _ in keys)]))
        conditionals = [self._model.failed_set(failed) for failed in sets]
        parts = []
        for number, failed in enumerate(sets):
            # The most probable sets are tried at the other places, too.
            places = search.places if number < _TRIED_EVERYWHERE else [
                search.places[index] for one, index in keys if one == failed]
            starts = Starts(np.zeros(len(places), int), np.stack([one.point for one in places]),
                            np.stack([one.values for one in places]))
            parts.append(ascend(conditionals[number], likelihood, starts, signals,
                                _STEPS, _STEP_MARGIN, number))
        modes = concatenate(*parts)
        order = modes.order
        n = max(_HYPOTHESES, n_sufficient(modes.log_likelihood[order], _LEFT_OUT))
        return select(modes, order[:n]), conditionals


def first_places(points: np.ndarray, radii: np.ndarray) -> list[int]:
    """Return indices of points (r, u, v), float64 [P, 3], from which sets of failures grow.

    Half of them are the first points. The others are the first points of as many directions as
    possible, because the ranges in one direction have nearly the same probable sets. Directions
    differ by the `radii`, float64 [3].
    """
    seen = collections.Counter[tuple[int, ...]]()
    turns = np.empty(len(points))
    for index, cell in enumerate(map(tuple, np.floor(points[:, 1:] / radii[1:]).tolist())):
        turns[index] = seen[cell]
        seen[cell] += 1
    turns[:_SEARCHED // 2] = -1
    return np.argsort(turns, kind='stable')[:_SEARCHED].tolist()


class FailedSurface(NamedTuple):
    """Moments of the signals from a surface with failed elements."""

    scattered: np.ndarray  # Radiation times multipath covariance, complex128 [N_B, N_SB F, N_E].
    # Covariance of the signals, given the amplitudes in the direct path, [N_B, N_SB F, N_SB F].
    covariance: np.ndarray


class FailureEffects(NamedTuple):
    """Changes of the signals due to the failure of each element."""

    # Change of the weight of the element's direct path, and change per standard deviation of its
    # amplitude, complex128 [N_E, N_B, N_SB F].
    shift: np.ndarray
    amplitude: np.ndarray
    spatial: np.ndarray  # Covariance of the multipath at the elements, [N_B, N_E, N_E].
    correlation: np.ndarray  # Correlation between measurements, [N_B, N_SB F, N_SB F].

    @classmethod
    def of(cls, scenario: Scenario, codebook: Codebook) -> 'FailureEffects':
        """Compute the effects on the signals of a codebook."""
        shift, amplitude = (
            np.ascontiguousarray(np.moveaxis(one, 2, 0)) for one in (
                radiation_matrix(scenario, codebook, (-1.0, 0.5, 1.0)),
                radiation_matrix(scenario, codebook, (0.0, 1.0, 1.0)) / np.sqrt(12)))
        return cls(shift, amplitude, multipath_covariance(scenario),
                   measurement_correlation(scenario))

    def with_failure(self, surface: FailedSurface, element: int) -> FailedSurface:
        """Return a surface with one more failed element."""
        scattered = surface.scattered + (
            self.shift[element, ..., None] * self.spatial[:, None, element])
        growth = self.growth(surface, slice(element, element + 1))[0]
        return FailedSurface(scattered, surface.covariance + growth)

    def growth(self, surface: FailedSurface, elements: slice = slice(None)) -> np.ndarray:
        """Return how each failure changes a surface's covariance, [N_E, N_B, N_SB F, N_SB F]."""
        shift, spread = self.shift[elements], self.amplitude[elements]
        power = np.diagonal(self.spatial, axis1=1, axis2=2).real.T[elements, :, None]
        cross = np.moveaxis(surface.scattered[..., elements], 2, 0) + power / 2 * shift
        # A product of two vectors plus its conjugate transpose, and a product of the amplitudes.
        left = np.stack([shift, cross, power * spread], axis=-1)
        right = np.stack([cross, shift, spread], axis=-1)
        return self.correlation * np.matmul(left, adjoint(right))


class Whitening(NamedTuple):
    """The covariances of H sets of failed elements."""

    factors: Factors  # Of H covariances.
    information: np.ndarray  # Information of one covariance about parameters, float64 [Q, Q].

    @classmethod
    def of(cls, covariance: np.ndarray, prior: NuisancePrior, parent: 'Whitening | None' = None
           ) -> 'Whitening':
        """Factorise covariances [H, N_B, N_SB F, N_SB F]; a parent provides the information."""
        factors = Factors.of(prior, covariance)
        one = factors.whitener[0]
        return cls(factors, parent.information if parent
                   else prior.information_of(np.linalg.inv(one), one))


class FailedSurfaces:
    """Moments of the signals for sets of failed elements.

    `surface` and `whitening` are functions of a set that keep their recent values. Failures have
    the share that the scenario of the likelihood declares.
    """

    def __init__(self, likelihood: Likelihood) -> None:
        scenario, codebook = likelihood.scenario, likelihood.codebook
        self.likelihood, self.effects = likelihood, FailureEffects.of(scenario, codebook)
        self.intact = MeasurementModel(
            dataclasses.replace(scenario, failed_element_share=0.0), codebook).prepare()
        self._intact_at = InterpolatedCovariance.of(self.intact)
        # Covariance of the errors that all failures together cause on average.
        failing = dataclasses.replace(scenario, element_error_rms=0.0)
        self._error = DeclaredElements(failing).error_covariance(failing, codebook)
        self._n_bytes = self.intact.covariance().nbytes
        #: Blocks of the elements.
        self.parts = blocks(scenario.n_elements, max(_BLOCK_BYTES // self._n_bytes, 1))
        # The same set is often probable in successive shots.
        self.n_kept = min(max(_SURFACE_BYTES // self._n_bytes, 1), _MAX_SURFACES)
        self.surface = Recent(self._surface, self.n_kept)
        self.whitening = Recent(self._whitening, self.n_kept)
        # Extensions of the intact surface serve all shots. Others often serve successive ones.
        n_extended = _EXTENSION_BYTES // (self._n_bytes * scenario.n_elements)
        self._of_intact = Recent(self._extensions, 2)
        self._of_failed = Recent(self._extensions, max(n_extended, 1))

    def _surface(self, failed: Failed) -> FailedSurface:
        if failed:
            return self.effects.with_failure(self.surface(failed[:-1]), failed[-1])
        return FailedSurface(np.matmul(self.intact.radiation, self.effects.spatial),
                       self.intact.covariance())

    def _whitening(self, failed: Failed) -> Whitening:
        return Whitening.of(self.surface(failed).covariance[None], self.likelihood.nuisance)

    def extensions(self, failed: Failed, remainder: float) -> list[Whitening]:
        """Return the factors for a set with each element of each block added in turn.

        `remainder` times the covariance of the errors of all failures is added to the covariance
        of each extended set.
        """
        return (self._of_failed if failed else self._of_intact)((failed, remainder))

    def _extensions(self, key: tuple[Failed, float]) -> list[Whitening]:
        failed, remainder = key
        surface, parent = self.surface(failed), self.whitening(failed)
        covariance = surface.covariance + remainder * self._error
        return [Whitening.of(covariance + self.effects.growth(surface, part),
                             self.likelihood.nuisance, parent) for part in self.parts]

    @property
    def log_odds(self) -> float:
        """Logarithm of the odds that an element has failed."""
        share = self.likelihood.scenario.failed_element_share
        return float(np.log(share / (1 - share)))

    def factors_at(self, failed: Failed, positions: np.ndarray) -> Factors:
        """Return factors of the covariance with the element errors at positions."""
        excess = self._intact_at(positions) - self.surface(()).covariance
        return Factors.of(
            self.likelihood.nuisance, self.surface(failed).covariance + excess)


@dataclasses.dataclass(eq=False)
class Place:
    """A point at which the signals of a shot are evaluated."""

    point: np.ndarray  # (r [m], u, v), float64 [3].
    values: np.ndarray  # Nuisance parameters, float64 [Q].
    # Residual of an intact surface, and derivatives of the mean with respect to the point and the
    # parameters, complex128 [4 + Q, N_B, N_SB F].
    columns: np.ndarray
    # Those of `frame_gains` by point and velocity, [1 + U, N_B, N_SB, F, N_E], once they are used.
    gains: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0))


def of_elements(gains: np.ndarray, n_frames: int) -> np.ndarray:
    """Return gains [..., N_SB, 1 or F, n] of n elements in each measurement, [n, ..., N_SB F]."""
    by_element = np.moveaxis(gains, -1, 0)
    whole = np.broadcast_to(by_element, (*by_element.shape[:-1], n_frames))
    return whole.reshape(*whole.shape[:-2], whole.shape[-2] * n_frames)


class FailedSet(Conditional):
    """The likelihood of positions for a set of failed elements: a `Conditional`.

    Its value includes the prior of the set, and omits the same constant as that of `Likelihood`.
    """

    def __init__(self, surfaces: FailedSurfaces, failed: Failed) -> None:
        self._surfaces, self.failed = surfaces, failed
        likelihood, scenario = surfaces.likelihood, surfaces.likelihood.scenario
        stuck = np.full(scenario.n_elements, np.nan)
        stuck[[*failed]] = 0.5
        self._mean_model = MeasurementModel(
            scenario, likelihood.codebook, ElementErrors(np.ones(len(stuck)), stuck))
        intact = scenario.n_elements * float(np.log1p(-scenario.failed_element_share))
        self._offset = len(failed) * surfaces.log_odds + intact + likelihood.log_det
        self._amplitudes = surfaces.effects.amplitude[[*failed]]

    def at(self, points: np.ndarray, values: np.ndarray, *, moves: bool = True,
           turns: bool = True) -> LocatedStates:
        """Return the likelihood at points; see `Conditional.at`."""
        surfaces, scenario = self._surfaces, self._surfaces.likelihood.scenario
        users, by_unknown = surfaces.likelihood.nuisance.states(points, values, moves, turns)
        mean, slopes = self._mean_model.mean_and_jacobian(users, by_unknown)
        gains = frame_gains(scenario, users, by_unknown[..., :0], [*self.failed])
        amplitudes = of_elements(gains[:, 0], scenario.n_frames).swapaxes(0, 1) * self._amplitudes
        whitening = surfaces.whitening(self.failed)
        factors = (whitening.factors if surfaces.intact.elements.is_exact
                   else surfaces.factors_at(self.failed, users[:, :3]))
        return LocatedStates(surfaces.likelihood.nuisance, mean, slopes, amplitudes, [
            (factors, self._offset - factors.log_det, whitening.information)])


class FailureModel:
    """Likelihood of positions and sets of failed elements at given points, for one shot."""

    def __init__(self, likelihood: Likelihood) -> None:
        self.likelihood, self.surfaces = likelihood, FailedSurfaces(likelihood)
        self.failed_set = Recent(
            functools.partial(FailedSet, self.surfaces), self.surfaces.n_kept)

    def places(self, points: np.ndarray, values: np.ndarray, signals: Signals) -> list[Place]:
        """Return places at points [P, 3] with parameters [P, Q], for the signals of one shot."""
        prior = self.likelihood.nuisance
        mean, slopes = self.surfaces.intact.mean_and_jacobian(*prior.states(points, values))
        divided = prior.divide(signals.received, values)
        columns = np.concatenate([
            (divided - mean)[:, None], slopes,
            prior.derivatives(divided, mean, prior.multipath_share)[
                :, prior.velocity.shape[1]:]], axis=1)
        return [Place(*each) for each in zip(points, values, columns, strict=True)]

    def gains_at(self, places: Sequence[Place]) -> np.ndarray:
        """Return `Place.gains` of P places, complex128 [P, 1 + U, N_B, N_SB, F, N_E]."""
        if new := [place for place in places if not place.gains.size]:
            states = self.likelihood.nuisance.states(
                np.stack([place.point for place in new]), np.stack([one.values for one in new]))
            for place, gains in zip(
                    new, frame_gains(self.likelihood.scenario, *states), strict=True):
                place.gains = gains
        return np.stack([place.gains for place in places])

    def effects_of(self, elements: slice | list[int], places: Sequence[Place]
                   ) -> tuple[np.ndarray, np.ndarray]:
        """Return the effects of the failure of each of n elements at P places.

        They are the change of `Place.columns`, complex128 [n, P, 4 + Q, N_B, N_SB F], and the
        derivative of the mean with respect to the normalised amplitude, [n, P, N_B, N_SB F].
        """
        prior, effects = self.likelihood.nuisance, self.surfaces.effects
        gains = of_elements(self.gains_at(places)[..., elements],
                            self.likelihood.scenario.n_frames)
        changes = gains * effects.shift[elements][:, None, None]
        fixed = (prior.scaled_patterns * (1 - prior.multipath_share)[:, None, None])[
            prior.velocity.shape[1]:]
        return np.concatenate(
            [-changes[:, :, :1], changes[:, :, 1:], fixed * changes[:, :, :1]], axis=2
        ), gains[:, :, 0] * effects.amplitude[elements][:, None]

    def _columns(self, failed: Failed, places: Sequence[Place]) -> tuple[np.ndarray, np.ndarray]:
        """Return the columns with failed elements, [P, ...], and those for their amplitudes."""
        columns = np.stack([place.columns for place in places])
        if not failed:
            return columns, columns[:, :0]
        changes, amplitudes = self.effects_of([*failed], places)
        return columns + changes.sum(axis=0), amplitudes.swapaxes(0, 1)

    def weigh(self, failed: Failed, places: Sequence[Place]) -> tuple[np.ndarray, np.ndarray]:
        """Return a set's log-probability and deviance, [P] each, after a step at each of P places.

        The log-probability is relative to the prior of an intact surface. The deviance, here
        without the usual factor 2, is the energy of the residual plus the cost of the parameters,
        because an unknown gain can lower any energy.
        """
        whitening = self.surfaces.whitening(failed)
        columns = np.concatenate(self._columns(failed, places), axis=1)
        (value,) = self._predicted(np.stack([place.values for place in places]), columns[None],
                                   whitening, len(failed))
        log_prior = len(failed) * self.surfaces.log_odds
        return log_prior - whitening.factors.log_det + value, -value

    def weigh_extensions(self, failed: Failed, places: Sequence[Place], remainder: float = 0.0
                         ) -> np.ndarray:
        """Weigh a set, as `weigh` does, with each element added in turn, float64 [P, N_E].

        Further elements are assumed to fail with a probability of `remainder` times the declared
        share; these failures add to the covariance. With a `remainder`, an element that explains
        part of the signals has a higher value than one that imitates the sum of several failures.
        """
        values, found = np.stack([place.values for place in places]), []
        columns, own = self._columns(failed, places)
        for part, extended in zip(
                self.surfaces.parts, self.surfaces.extensions(failed, remainder), strict=True):
            # In the order of the fields of `Columns`. The mean is linear in the amplitudes of
            # failed elements.
            changes, amplitudes = self.effects_of(part, places)
            value = self._predicted(values, np.concatenate(
                [columns + changes, np.broadcast_to(own, (len(changes), *own.shape)),
                 amplitudes[:, :, None]], axis=2), extended, len(failed) + 1)
            found.append((len(failed) + 1) * self.surfaces.log_odds
                         - extended.factors.log_det[:, None] + value)
        return np.concatenate(found).T

    def _predicted(self, values: np.ndarray, columns: np.ndarray, whitening: Whitening,
                   n_failed: int) -> np.ndarray:
        """Predict log-likelihoods [H, P] of H sets after a Newton step at each of P places.

        Takes the parameters, [P, Q], and columns, [H, P, C, N_B, N_SB F].
        """
        (n_sets, n_places, n_columns), prior = columns.shape[:3], self.likelihood.nuisance
        # In one product for each set.
        white = whitening.factors.whiten(columns.reshape(n_sets, -1, *columns.shape[3:]))
        noise = whitening.factors.noise
        local = assemble(
            prior, np.tile(values, (n_sets, 1)),
            Columns.of(white.reshape(n_sets * n_places, n_columns, -1), len(prior), n_failed),
            whitening.information, noise if noise is None else np.repeat(noise, n_places, axis=0))
        return predict(local, self.likelihood).reshape(n_sets, n_places)


class FailureSearch:
    """Search for sets of failed elements at several places, for the signals of one shot.

    Sets grow by one element at a time. Extended sets are ranked by a likelihood that admits a few
    more failures; see `FailureModel.weigh_extensions`. If it did not, and two elements had failed,
    the first element added would often be a third one that imitates the sum of both.

    Growth ends when all new sets are less probable than the best set by a margin, and the deviance
    of some hypothesis is as low as usual, or else after `_GROWTH` elements.
    """

    def __init__(self, model: FailureModel, signals: Signals) -> None:
        self._model, self._signals = model, signals
        self._usual = energy_limit(int(np.prod(model.likelihood.model.shape)), _UNUSUAL)
        self.places: list[Place] = []
        # Logarithm of prior times likelihood of each hypothesis.
        self.log_probabilities: dict[Key, float] = {}
        self._deviances: dict[Key, float] = {}

    @property
    def best(self) -> Key:
        """The most probable hypothesis."""
        return max(self.log_probabilities, key=lambda key: self.log_probabilities[key])

    def explains(self, keys: list[Key]) -> bool:
        """Return whether the deviance of any of these hypotheses is no higher than usual."""
        return any(self._deviances[key] <= self._usual for key in keys)

    def add(self, points: np.ndarray, values: np.ndarray) -> list[Key]:
        """Add a place at each point [P, 3] with parameters [P, Q]; return keys, the best first."""
        first = len(self.places)
        self.places += self._model.places(points, values, self._signals)
        return self._weigh(((), index) for index in range(first, len(self.places)))

    def grow(self, parents: list[Key], remainder: float = 0.0) -> None:
        """Add failures to hypotheses until the results are improbable; see `FailureSearch`.

        `remainder` is the argument of `FailureModel.weigh_extensions`.
        """
        # Earlier growth does not count: it may have ended with a set that is less probable.
        found = self._weigh(parents)
        for _ in range(_GROWTH):
            ranked = self._weigh_children(parents, remainder)
            if not ranked:
                # All elements have failed.
                break
            exact = self._weigh(ranked[:_EXACT])
            limit = max(self.log_probabilities[key] for key in found) - _MARGIN
            if self.log_probabilities[exact[0]] < limit and self.explains(found):
                break
            found += exact
            parents = _diverse(ranked)

    def try_neighbours(self, key: Key) -> None:
        """Weigh the sets in which one element is added, removed or replaced."""
        failed, index = key
        smaller = [tuple(sorted(set(failed) - {element})) for element in failed]
        self._weigh((one, index) for one in smaller)
        for parent in (failed, *smaller):
            self._weigh(self._weigh_children([(parent, index)])[:_EXACT])

    def _weigh(self, keys: Iterable[Key]) -> list[Key]:
        """Weigh hypotheses, and return them, the most probable first."""
        keys = list(keys)
        for failed, group in itertools.groupby(
                sorted(set(keys) - self.log_probabilities.keys()), key=lambda key: key[0]):
            new = list(group)
            value, deviance = self._model.weigh(failed, [self.places[index] for _, index in new])
            self.log_probabilities.update(zip(new, value.tolist(), strict=True))
            self._deviances.update(zip(new, deviance.tolist(), strict=True))
        return sorted(keys, key=lambda key: -self.log_probabilities[key])

    def _weigh_children(self, parents: list[Key], remainder: float = 0.0) -> list[Key]:
        """Return the hypotheses with one more failed element, the most probable first."""
        children: dict[Key, float] = {}
        # In this order, the covariances of a set are computed once.
        for failed, group in itertools.groupby(sorted(parents), key=lambda key: key[0]):
            indices = [index for _, index in group]
            for part in blocks(len(indices), _PLACES):
                places = [self.places[index] for index in indices[part]]
                values = self._model.weigh_extensions(failed, places, remainder)
                for index, of_place in zip(indices[part], values.tolist(), strict=True):
                    for element, value in enumerate(of_place):
                        if element not in failed:
                            children[tuple(sorted((*failed, element))), index] = value
        return sorted(children, key=lambda key: -children[key])


def _diverse(ranked: list[Key]) -> list[Key]:
    """Choose the best hypotheses to extend, but only a few per set and per place."""
    chosen: list[Key] = []
    for failed, index in ranked:
        if (sum(other == failed for other, _ in chosen) < _PER_SET
                and sum(other == index for _, other in chosen) < _PER_PLACE):
            chosen.append((failed, index))
        if len(chosen) == _EXTENDED:
            break
    return chosen
