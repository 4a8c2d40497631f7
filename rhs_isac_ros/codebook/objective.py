"""What a codebook can be optimised for."""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.bounds import AverageCrlb, PairwiseErrorCost
from rhs_isac_ros.bounds.average import Average
from rhs_isac_ros.codebook.sampling import confusable
from rhs_isac_ros.model import Scenario

# Relative error of the rows of an objective: the value then errs by less than a thousandth, far
# less than the sampling does, and gradients belong to that value.
ROW_TOLERANCE = 3e-5
# Confusable positions for each sampled one: rare close pairs make most of the mean.
_PAIRS_A_POSITION = 128


def average_bound(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator) -> Average:
    """Implements Eq. (17). Objective of P1 on sampled positions.

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Samples of the user's position, float64 [N_sam, 3] [m].
    rng
        Not needed here.

    Returns
    -------
    Average
        A function of the codebook: value [m^2] and gradients.

    Raises
    ------
    ValueError
        If `positions` is empty or not a finite [N, 3] array.
    """
    return AverageCrlb(scenario, positions, ROW_TOLERANCE)


def ambiguity(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator) -> Average:
    """Mean confusion of sampled positions with others that look alike.

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Samples of the user's position, float64 [N_sam, 3] [m].
    rng
        Draws the others.

    Returns
    -------
    Average
        A function of the codebook: value [m^2] and gradients.

    Raises
    ------
    ValueError
        If `positions` is empty or not a finite [N, 3] array.
    """
    firsts = np.repeat(positions, _PAIRS_A_POSITION, axis=0)
    return PairwiseErrorCost(
        scenario, firsts, confusable(scenario, firsts, rng), tolerance=ROW_TOLERANCE)


OBJECTIVES: Mapping[str, Callable] = {'ambiguity': ambiguity, 'crlb': average_bound}
