"""Steering: the beam of the highest capacity at a position."""

import numpy as np

from rhs_isac_ros.link.ascent import ascend
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.link.capacity import Beam
from rhs_isac_ros.link.search import promising
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import matched_configuration

# Configurations of the search that are compared over all sub-bands and modes, and of those that
# are improved.
_COMPARED = 8
_IMPROVED = 4


def steer(scenario: Scenario, position: np.ndarray, band: int = 0) -> Beam:
    """Find a beam that maximises Eq. (10) for a user at a position.

    A search from many starts finds promising configurations. The best few of these and of the
    matched filter's are then improved together with the digital part, so that the outcome is never
    worse than the matched filter. The same position always gives the same beam.

    Parameters
    ----------
    scenario
        The scenario.
    position
        Position of the user, float64 [3] [m].
    band
        Index of the band, from 0.

    Returns
    -------
    Beam
        The beam, with the power P_max over all sub-bands.

    Raises
    ------
    ValueError
        If the position is not a finite [3] array, or there is no such band.
    """
    if not 0 <= band < scenario.n_bands:
        raise ValueError(f'band: {band}, expected 0 to {scenario.n_bands - 1}')
    link = BandLink.to(scenario, position, band)
    starts = [matched_configuration(link.los, link.onboard), *promising(link, _COMPARED)]
    starts.sort(key=link.best_rate, reverse=True)
    ends = [ascend(link, start) for start in starts[:_IMPROVED]]
    return Beam(*max(ends, key=lambda end: link.best_rate(end[0])), band)
