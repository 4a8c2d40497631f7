"""Modes of the posterior as a mixture over sets of failed elements.

`ElementErrorModel` replaces the mixture by one Gaussian, which discards what the signals reveal
about the set: a single failure is far above the nulls of the multipath. The sets with a
substantial weight are found by adding elements to the most probable sets, one at a time.
"""

import numpy as np

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning.failure_model import FailureModel, Site, Weighed
from rhs_isac_ros.positioning.failure_search import FailureSearch, Key
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.region import offset_to_roi
from rhs_isac_ros.positioning.separation import separate
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.whitened import WhitenedModel

# Largest expected number of failures for which sets are searched.
_MAX_EXPECTED = 2.0
# Probability that an intact surface has a higher residual than the usual one, and the number of
# modes from which sets are searched below that residual.
_UNUSUAL = 0.01
_N_USUAL = 2
# Points of the table and their margin, besides the modes, and sites to search from otherwise.
_MAX_POINTS = 64
_POINT_MARGIN = 30.0
_N_SITES = 64
# Shares of further failures that order the sets, and numbers of sets of the same size to extend,
# in a first search and in those that follow while the most probable set is large: almost all sets
# that the first search finds instead of the true one are large.
_SEARCHES = ((0.3, 8), (1.0, 16), (0.1, 16))
_LARGE_SET = 3
# Largest number of further searches, each under the most probable set, and their points.
_MAX_SEARCHES = 2
_N_PEAKS = 16
_N_GROWN = 3
# Sets to try at all sites.
_N_SETS = 4
# Hypotheses whose log-probability is lower than the best by more than this are dropped, before
# and after the first exact step, and the number of those that remain.
_MARGIN = 9.0
_FIRST_MARGIN = 27.0
_MAX_HYPOTHESES = 48
_N_STEPS = 2
# Hypotheses with the same set that are closer than this in (r [m], u, v) have converged to the
# same mode.
_MIN_SEPARATION = 0.01


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
        search = self._search(modes, received)
        return self._converge(search.values, search.sites, received)

    def _search(self, modes: Modes, received: np.ndarray) -> FailureSearch:
        """Search for probable sets at the modes and elsewhere."""
        order = np.argsort(-modes.roi_log_likelihood)
        search = FailureSearch(self._model, received, _MARGIN, self._usual_residual)
        keys = search.add(modes.roi_points[order])
        if search.explains(keys):
            search.grow(keys[:_N_USUAL])
        else:
            whitened = self._search_model.whiten(received[None])[0]
            keys = [((), index) for index in range(len(search.sites))]
            keys += search.add(self._table.modes(whitened, _MAX_POINTS, _POINT_MARGIN))
            for remainder, n_extended in _SEARCHES:
                search.grow(keys[:_N_SITES], remainder, n_extended)
                self._search_again(search, whitened)
                if len(search.best[0]) < _LARGE_SET:
                    break
        search.try_neighbours(search.best)
        return search

    def _search_again(self, search: FailureSearch, whitened: np.ndarray) -> None:
        """Add sites that are probable under a set, which the average over sets may miss."""
        for _ in range(_MAX_SEARCHES):
            failed, _ = search.best
            points = self._table.peaks_under(
                whitened, self._model.search_factor(failed), _N_PEAKS)
            search.grow(search.add(points, failed)[:_N_GROWN])
            if search.best[0] == failed:
                break

    def _converge(self, values: dict[Key, float], sites: list[Site],
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
