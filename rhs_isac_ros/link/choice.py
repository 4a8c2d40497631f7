"""The choice of the band: the beam of the best expected capacity."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rhs_isac_ros.link.capacity import Beam
from rhs_isac_ros.link.expected import expected_capacity
from rhs_isac_ros.link.steer import steer
from rhs_isac_ros.model import Scenario


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """A beam, and what it is expected to carry.

    Attributes
    ----------
    beam
        The beam, steered to the mean of the position.
    expected_bps
        Its capacity, averaged over the posterior of the position [bit/s].
    """

    beam: Beam
    expected_bps: float


def choose_beam(
        scenario: Scenario, mean: np.ndarray, covariance: np.ndarray | None = None,
        bands: Sequence[int] | None = None) -> Choice:
    """Steer each band to the mean of a position and take the best on average over its posterior.

    A band whose beam is higher but narrower may lose more to an error of the position than it
    gains where there is none, so that the capacity at the mean alone would be misleading.

    Parameters
    ----------
    scenario
        The scenario.
    mean
        Mean of the position, float64 [3] [m].
    covariance
        Its covariance, float64 [3, 3] [m^2]; none: the position is known.
    bands
        Indices of the bands to choose from, from 0; none: all.

    Returns
    -------
    Choice
        The beam of the highest expected capacity; of equals the first.

    Raises
    ------
    ValueError
        If mean or covariance have another shape or are not finite, or there is no such band.
    """
    covariance = np.zeros((3, 3)) if covariance is None else covariance
    choices = []
    for band in range(scenario.n_bands) if bands is None else bands:
        beam = steer(scenario, mean, band)
        choices.append(Choice(beam, expected_capacity(scenario, beam, mean, covariance)))
    return max(choices, key=lambda choice: choice.expected_bps)
