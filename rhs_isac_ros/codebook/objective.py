"""Objectives of the codebook optimisation.

`tick` is called repeatedly while the parts of an objective that do not depend on the codebook are
computed; an exception ends the computation.
"""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.bounds import AverageCrlb, PairwiseErrorCost
from rhs_isac_ros.bounds.average import Average
from rhs_isac_ros.bounds.rows import Tick, no_tick
from rhs_isac_ros.codebook.sampling import WIDE, confusable_volumes, draw_confusable
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import checked_positions

# Relative error of an objective's rows. The error of its value is then below 0.1 %, far less than
# the sampling error, and the gradient is exact for that value.
ROW_TOLERANCE = 3e-5
# Confusable positions for each sampled position: many, because a few close pairs dominate the
# mean.
_PAIRS_PER_POSITION = 128
# Power of the volumes as weights of pairs. With 1, few pairs that are unlikely to be drawn would
# have most of the weight.
_VOLUME_POWER = 0.6


def average_bound(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        tick: Tick = no_tick) -> Average:
    """Implements Eq. (17). Objective of P1 [m^2] on sampled positions, float64 [N_sam, 3] [m].

    Raise ValueError if `positions` is empty or not a finite [N, 3] array. `rng` is unused.
    """
    return AverageCrlb(scenario, positions, ROW_TOLERANCE, tick=tick)


def nuisance(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        tick: Tick = no_tick) -> Average:
    """Objective [m^2]: average bound with unknown phases of the bands and the region as prior.

    A phase is unknown in effect even where the signals carry it, because the same phase occurs in
    each wavelength of range. The information of the region keeps positions that the rest of the
    signals does not determine from dominating the average. Further nuisance parameters are those
    that the scenario declares.

    The positions are float64 [N_sam, 3] [m]. Raise ValueError if `positions` is empty or not a
    finite [N, 3] array. `rng` is unused.
    """
    uniform = dataclasses.replace(
        scenario, band_phase_std_rad=max(scenario.band_phase_std_rad, 2 * np.pi))
    return AverageCrlb(uniform, positions, ROW_TOLERANCE, region_prior=True, tick=tick)


def ambiguity(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        tick: Tick = no_tick) -> Average:
    """Objective [m^2]: mean cost of confusing sampled positions with similar-looking ones.

    The positions are float64 [N_sam, 3] [m]; `rng` draws those that they may be confused with.
    Raise ValueError if `positions` is empty or not a finite [N, 3] array.
    """
    first_positions = np.repeat(positions, _PAIRS_PER_POSITION, axis=0)
    second_positions = draw_confusable(scenario, first_positions, rng)
    return PairwiseErrorCost(
        scenario, first_positions, second_positions, tolerance=ROW_TOLERANCE, tick=tick)


def error(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        tick: Tick = no_tick) -> Average:
    """Objective [m^2]: the cost of `ambiguity`, with weights close to those of the squared error.

    Pairs extend farther across the line of sight, up to the far side lobes. Their weights grow
    with the volume that each represents, see `confusable_volumes`: with the volumes themselves,
    the cost would be proportional to the union bound on the mean squared error.

    The positions are float64 [N_sam, 3] [m]; `rng` draws those that they may be confused with.
    Raise ValueError if `positions` is empty or not a finite [N, 3] array.
    """
    first_positions = np.repeat(checked_positions(positions), _PAIRS_PER_POSITION, axis=0)
    second_positions = draw_confusable(scenario, first_positions, rng, WIDE)
    weights = confusable_volumes(
        scenario, first_positions, second_positions, WIDE)**_VOLUME_POWER
    if len(weights):
        weights /= weights.mean()
    return PairwiseErrorCost(
        scenario, first_positions, second_positions, weights, ROW_TOLERANCE, tick)


OBJECTIVES: Mapping[str, Callable[..., Average]] = {
    'ambiguity': ambiguity, 'crlb': average_bound, 'error': error,
    'nuisance': nuisance}
