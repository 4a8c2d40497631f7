"""Modes of the posterior as a mixture over sets of failed elements.

`ElementErrorModel` replaces the mixture by one Gaussian, which discards what the signals reveal
about the set: a single failure is far above the nulls of the multipath. The sets with a
substantial weight are found by adding elements to the most probable sets, one at a time.
"""

from typing import TypeAlias

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning.failure_model import FailureModel, Site, Weighed
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.region import offset_to_roi
from rhs_isac_ros.positioning.table import TemplateTable, separate
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Largest expected number of failures for which sets are searched, and the largest set.
_MAX_EXPECTED = 2.0
_MAX_FAILURES = 6
# Probability that an intact surface has a higher residual than the usual one, and the number of
# modes from which sets are searched below that residual.
_UNUSUAL = 0.01
_N_USUAL = 2
# Hypotheses to extend, in total, of each set, and of each site.
_N_EXTENDED = 8
_MAX_PER_SET = 3
_MAX_PER_SITE = 4
# Sets to try at all sites.
_N_SETS = 4
# Points of a second search, under the most probable set.
_N_PEAKS = 16
# Hypotheses whose log-probability is lower than the best by more than this are dropped, before
# and after the first exact step, and the number of those that remain.
_MARGIN = 9.0
_FIRST_MARGIN = 27.0
_MAX_HYPOTHESES = 48
_N_STEPS = 2
# Hypotheses with the same set that are closer than this in (r [m], u, v) have converged to the
# same mode.
_MIN_SEPARATION = 0.01

# A set of failed elements and the index of a site.
_Key: TypeAlias = tuple[tuple[int, ...], int]


def can_enumerate(scenario: Scenario) -> bool:
    """Return whether a scenario declares failures so rare that their sets can be searched."""
    return 0 < scenario.failed_element_share * scenario.n_elements <= _MAX_EXPECTED


class FailedElements:
    """The posterior of positions if a few elements of the surface may have failed.

    Attributes
    ----------
    search_margin
        Extra margin of the search for modes, whose average over sets misjudges each set.
    """

    search_margin = 10.0

    def __init__(self, model: WhitenedModel, table: TemplateTable) -> None:
        # Half a chi-square variable of 2 n degrees of freedom is a gamma variable of shape n.
        from scipy.special import gammainccinv

        scenario = model.scenario
        self._search_model, self._table = model, table
        self._model = FailureModel(model)
        self._usual_residual = float(gammainccinv(np.prod(model.shape), _UNUSUAL))
        roots = np.linalg.cholesky(MeasurementModel(scenario, model.codebook).covariance())
        self._offset = 2 * np.log(np.diagonal(roots, axis1=1, axis2=2).real).sum()
        self._offset += scenario.n_elements * float(np.log1p(-scenario.failed_element_share))

    def refine(self, modes: Modes, received: np.ndarray) -> tuple[Modes, np.ndarray]:
        """Return a mode for every probable set, and the energy of their residuals, float64 [M].

        The most likely comes first. Likelihoods are relative to those of the search, as from
        `ElementErrorModel.refine`. Signals are complex128 [N_B, N_SB F].
        """
        order = np.argsort(-modes.roi_log_likelihood)
        sites = [self._model.site(point, received) for point in modes.roi_points[order]]
        intact = self._model.surface(())
        weighed = [self._model.weigh(intact, site) for site in sites]
        values: dict[_Key, float] = {
            ((), index): float(one.value[0]) for index, one in enumerate(weighed)}
        parents = sorted(values, key=lambda key: -values[key])
        if weighed[parents[0][1]].residual[0] <= self._usual_residual:
            parents = parents[:_N_USUAL]
        self._grow(values, sites, parents)
        failed = max(values, key=lambda key: values[key])[0]
        if failed:
            self._search_again(values, sites, failed, received)
        return self._converge(values, sites, received)

    def _grow(self, values: dict[_Key, float], sites: list[Site], parents: list[_Key]) -> None:
        """Add failures to hypotheses as long as the result is probable."""
        best = max(values.values())
        for _ in range(_MAX_FAILURES):
            children: dict[_Key, float] = {}
            for failed, index in parents:
                further = self._model.weigh_further(self._model.surface(failed), sites[index])
                for element, value in enumerate(further.tolist()):
                    if element not in failed:
                        children[tuple(sorted((*failed, element))), index] = value
            ranked = sorted(children, key=lambda key: -children[key])
            values |= {key: children[key] for key in ranked[:_MAX_HYPOTHESES]}
            if children[ranked[0]] < best - _MARGIN:
                break
            best = max(best, children[ranked[0]])
            parents = _diverse(ranked)

    def _search_again(self, values: dict[_Key, float], sites: list[Site],
                      failed: tuple[int, ...], received: np.ndarray) -> None:
        """Add sites that are probable under a set, which the average over sets may miss."""
        points = self._table.peaks_under(
            self._search_model.whiten(received[None])[0], self._model.search_factor(failed),
            _N_PEAKS)
        surface, first = self._model.surface(failed), len(sites)
        sites += [self._model.site(point, received) for point in points]
        found: dict[_Key, float] = {
            (failed, index): float(self._model.weigh(surface, sites[index]).value[0])
            for index in range(first, len(sites))}
        values |= found
        self._grow(values, sites, sorted(found, key=lambda key: -found[key])[:_MAX_PER_SET])

    def _converge(self, values: dict[_Key, float], sites: list[Site],
                  received: np.ndarray) -> tuple[Modes, np.ndarray]:
        """Take exact steps from the most probable hypotheses."""
        best = max(values.values())
        keys = sorted((key for key in values if values[key] >= best - _MARGIN),
                      key=lambda key: -values[key])[:_MAX_HYPOTHESES]
        # The most probable sets are tried at the other sites, too.
        sets = list(dict.fromkeys(failed for failed, _ in keys))
        keys += [(failed, index) for failed in sets[:_N_SETS] for index in range(len(sites))
                 if (failed, index) not in keys]
        converged = []
        for failed, index in keys:
            surface, site = self._model.surface(failed), sites[index]
            weighed = self._model.weigh(surface, site)
            if weighed.value[0] < best - _FIRST_MARGIN:
                continue
            for _ in range(_N_STEPS):
                site = self._model.site(self._moved(site, weighed), received)
                weighed = self._model.weigh(surface, site)
            converged.append((sets.index(failed), site.point, weighed))
        labels, points, parts = zip(*converged, strict=True)
        weighed = Weighed(*(np.concatenate(field) for field in zip(*parts, strict=True)))
        moved = np.stack(points) + weighed.step
        offset = offset_to_roi(moved, weighed.curvature, self._model.scenario.roi_bounds_m)
        refined = Modes(moved, weighed.curvature, weighed.value + self._offset, offset)
        order = np.argsort(-refined.roi_log_likelihood)
        scaled = np.column_stack([refined.roi_points / _MIN_SEPARATION, labels])
        chosen = order[separate(scaled[order], _MAX_HYPOTHESES)]
        return refined.select(chosen), weighed.residual[chosen]

    def _moved(self, site: Site, weighed: Weighed) -> np.ndarray:
        """Return the point after the step, moved into the region of interest."""
        moved = site.point + weighed.step
        offset = offset_to_roi(moved, weighed.curvature, self._model.scenario.roi_bounds_m)
        inside: np.ndarray = (moved + offset)[0]
        return inside


def _diverse(ranked: list[_Key]) -> list[_Key]:
    """Choose the first hypotheses to extend, few of each set and of each site."""
    chosen: list[_Key] = []
    for failed, index in ranked:
        if (sum(other == failed for other, _ in chosen) < _MAX_PER_SET
                and sum(other == index for _, other in chosen) < _MAX_PER_SITE):
            chosen.append((failed, index))
        if len(chosen) == _N_EXTENDED:
            break
    return chosen
