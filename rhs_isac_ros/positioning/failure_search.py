"""The search for probable sets of failed elements, for the signals of one positioning phase."""

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np

from rhs_isac_ros.positioning.failure_model import FailureModel, Site

# Hypotheses to extend, of each set and of each site.
_MAX_PER_SET = 3
_MAX_PER_SITE = 4
# Of the extended sets, those to weigh exactly.
_N_EXACT = 16
# Largest number of elements by which a set grows.
_MAX_GROWTH = 6

# A set of failed elements and the index of a site.
Key: TypeAlias = tuple[tuple[int, ...], int]


class FailureSearch:
    """Adds failed elements to sets, one at a time, at several sites.

    The order of the extended sets follows from a likelihood that admits a few more failures; see
    `FailureModel.weigh_extensions`. Without them, the best first element of two would often be
    one that imitates the sum of both.

    Parameters
    ----------
    received
        Signals, complex128 [N_B, N_SB F].
    margin
        Growth ends with sets that are less probable than the best by this, in log-probability.
    usual_residual
        The growth continues while no hypothesis has less residual energy.

    Attributes
    ----------
    sites
        The sites.
    values
        Logarithm of prior times likelihood of each hypothesis.
    """

    def __init__(self, model: FailureModel, received: np.ndarray, margin: float,
                 usual_residual: float) -> None:
        self._model, self._received, self._margin = model, received, margin
        self._usual_residual = usual_residual
        self.sites: list[Site] = []
        self.values: dict[Key, float] = {}
        self._residuals: dict[Key, float] = {}

    @property
    def best(self) -> Key:
        """The most probable hypothesis."""
        return max(self.values, key=lambda key: self.values[key])

    def explains(self, keys: list[Key]) -> bool:
        """Whether a hypothesis has no more residual energy than usual."""
        return any(self._residuals[key] <= self._usual_residual for key in keys)

    def add(self, points: np.ndarray, failed: tuple[int, ...] = ()) -> list[Key]:
        """Add sites at points, float64 [P, 3], with a set; the most probable come first."""
        first = len(self.sites)
        self.sites += [self._model.site(point, self._received) for point in points]
        return self._weigh((failed, index) for index in range(first, len(self.sites)))

    def grow(self, parents: list[Key], remainder: float = 0.0, n_extended: int = 8) -> None:
        """Add failures to hypotheses as long as the result is probable.

        Parameters
        ----------
        remainder
            Share of further failures, relative to the declared one, with which the sets are
            ordered; see `FailureModel.weigh_extensions`.
        n_extended
            Number of sets of the same size to extend.
        """
        # Earlier growth does not count: it may have ended with a set that is less probable.
        found = self._weigh(parents)
        for _ in range(_MAX_GROWTH):
            ranked = self._weigh_children(parents, remainder)
            if not ranked:
                # All elements have failed.
                break
            exact = self._weigh(ranked[:_N_EXACT])
            limit = max(self.values[key] for key in found) - self._margin
            if self.values[exact[0]] < limit and self.explains(found):
                break
            found += exact
            parents = _diverse(ranked, n_extended)

    def try_neighbours(self, key: Key) -> None:
        """Weigh the sets with one element more, less, or exchanged."""
        failed, index = key
        smaller = [tuple(sorted(set(failed) - {element})) for element in failed]
        self._weigh((one, index) for one in smaller)
        for parent in (failed, *smaller):
            self._weigh(self._weigh_children([(parent, index)])[:_N_EXACT])

    def _weigh(self, keys: Iterable[Key]) -> list[Key]:
        """Weigh hypotheses, and return them, the most probable first."""
        keys = list(keys)
        for key in keys:
            if key not in self.values:
                failed, index = key
                weighed = self._model.weigh(self._model.surface(failed), self.sites[index])
                self.values[key] = float(weighed.value[0])
                self._residuals[key] = float(weighed.residual[0])
        return sorted(keys, key=lambda key: -self.values[key])

    def _weigh_children(self, parents: list[Key], remainder: float = 0.0) -> list[Key]:
        """Return the sets with one more element, the most probable first."""
        children: dict[Key, float] = {}
        # The covariances of a set are computed once.
        for failed, index in sorted(parents):
            values = self._model.weigh_extensions(
                self._model.surface(failed), self.sites[index], remainder)
            for element, value in enumerate(values.tolist()):
                if element not in failed:
                    children[tuple(sorted((*failed, element))), index] = value
        return sorted(children, key=lambda key: -children[key])


def _diverse(ranked: list[Key], n_extended: int) -> list[Key]:
    """Choose the first hypotheses to extend, few of each set and of each site."""
    chosen: list[Key] = []
    for failed, index in ranked:
        if (sum(other == failed for other, _ in chosen) < _MAX_PER_SET
                and sum(other == index for _, other in chosen) < _MAX_PER_SITE):
            chosen.append((failed, index))
        if len(chosen) == n_extended:
            break
    return chosen
