"""Objectives of the codebook optimisation, and the samples of the region that they average over.

Each function in `OBJECTIVES` takes a scenario, positions sampled from a prior, float64 [N_sam, 3]
[m], a random generator, `tick` and the prior, and returns an `Average`. It raises ValueError
unless the positions are a finite [N_sam, 3] array with at least one row. During computations that
do not depend on the codebook, it calls `tick` repeatedly, which may end them with an exception.
"""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.bounds import AverageCrlb, PairwiseErrorCost
from rhs_isac_ros.bounds.average import Average
from rhs_isac_ros.bounds.rows import Tick, no_tick
from rhs_isac_ros.codebook.cell import REGION, Prior
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import checked_positions
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.geometry import surface_sides_m
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.fields import whole

# Relative error of the rows (see `bounds.rows`) of an objective. The error of the objective is
# then below 0.1 %, far less than the sampling error. The gradient is exact for the value returned.
ROW_TOLERANCE = 3e-5
# Number of confusable positions for each sampled position: large, because a few pairs with very
# similar signals dominate the mean.
_PAIRS_PER_POSITION = 128
# Exponent of the volumes in the weights of pairs. With 1, a few pairs that are rarely drawn would
# have most of the weight.
_VOLUME_POWER = 0.6


def average_bound(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        tick: Tick = no_tick, prior: Prior = REGION) -> Average:
    """Implements Eq. (17). Objective of P1 [m^2] on sampled positions; only these are used."""
    return AverageCrlb(scenario, positions, ROW_TOLERANCE, tick=tick)


def nuisance(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        tick: Tick = no_tick, prior: Prior = REGION) -> Average:
    """Objective [m^2]: average bound with unknown band phases and with the region as prior.

    Even a known phase would determine the range only up to whole wavelengths, so phases are
    treated as unknown. With the region as prior, positions that the signals do not determine
    cannot dominate the average. The scenario may declare further nuisance parameters. `rng` and
    `prior` are unused.
    """
    unknown = dataclasses.replace(scenario, band_phase_std_rad=np.inf)
    # Without phases, the bound is a small difference of large numbers.
    return AverageCrlb(unknown, positions, ROW_TOLERANCE / 30, region_prior=True, tick=tick)


def ambiguity(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        tick: Tick = no_tick, prior: Prior = REGION) -> Average:
    """Objective [m^2]: mean cost of mistaking sampled positions for ones with similar signals."""
    first_positions = np.repeat(checked_positions(positions), _PAIRS_PER_POSITION, axis=0)
    second_positions = draw_confusable(prior.box(scenario), first_positions, rng)
    return PairwiseErrorCost(
        scenario, first_positions, second_positions,
        prior.ratios(first_positions, second_positions), ROW_TOLERANCE, tick)


def error(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        tick: Tick = no_tick, prior: Prior = REGION) -> Average:
    """Objective [m^2]: like `ambiguity`, but weighted almost as in the mean squared error.

    Across the line of sight, pairs extend farther than in `ambiguity`, beyond the first side
    lobes. Their weights grow with the volumes that they represent (`confusable_volumes`). With the
    volumes themselves as weights, the cost would be proportional to the union bound on the mean
    squared error.
    """
    first_positions = np.repeat(checked_positions(positions), _PAIRS_PER_POSITION, axis=0)
    box = prior.box(scenario)
    second_positions = draw_confusable(box, first_positions, rng, WIDE)
    weights = confusable_volumes(
        box, first_positions, second_positions, WIDE)**_VOLUME_POWER
    weights *= prior.ratios(first_positions, second_positions)
    if len(weights):
        weights /= weights.mean()
    return PairwiseErrorCost(
        scenario, first_positions, second_positions, weights, ROW_TOLERANCE, tick)


OBJECTIVES: Mapping[str, Callable[..., Average]] = {
    'ambiguity': ambiguity, 'crlb': average_bound, 'error': error, 'nuisance': nuisance}


def sobol(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw scrambled Sobol points in the region of interest, float64 [n, 3] [m].

    They are more evenly spread than independent points, and most evenly if `n` is a power of two.
    They are scrambled with a child of the seed of the generator, not with its next numbers: a
    second call gives other points, but numbers drawn in between make no difference.
    """
    n = whole('n', n)
    points = streams.sobol(3, max(n - 1, 0).bit_length(), rng)[:n]
    low, high = scenario.roi_bounds_m
    return low + (high - low) * points


# The paper draws independent uniform positions.
SAMPLINGS: Mapping[str, Callable[[Scenario, int, np.random.Generator], np.ndarray]] = {
    'monte_carlo': Scenario.sample_positions, 'sobol': sobol}

# Grid points of the range lag per shortest carrier wavelength.
_LAGS_PER_WAVELENGTH = 64
# Limits of the scale of transverse displacements, in widths of the narrowest beam. Displacements
# reach the first side lobes with `NEAR`, and go beyond them with `WIDE`.
NEAR, WIDE = (0.03, 0.3), (0.03, 0.6)
# Share of pairs that differ only in direction.
_ZERO_LAG_FRACTION = 0.3
# Lags [rad] and squared displacements [squared beam widths] below this are rounding errors.
_ROUNDING = 1e-7
# Maximum number of attempts to draw a position inside the region.
_MAX_DRAWS = 200


def draw_confusable(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator,
        scales: tuple[float, float] = NEAR) -> np.ndarray:
    """For each of N positions, draw another one with similar signals, float64 [N, 3] [m].

    Two positions are hard to distinguish if their ranges differ by about a whole number of
    wavelengths in every band. Range lags are therefore drawn with a density proportional to
    exp(-sum_i (1 - cos 2 pi f_i lag / v_0)), with the centre frequencies f_i and the speed of
    light v_0. Some lags are 0, so that the pair differs only in direction. Displacements across
    the line of sight range from well below the beam width up to the side lobes. Their scale is
    log-uniform; `scales` are its limits, in widths of the narrowest beam.
    """
    low, high = scenario.roi_bounds_m
    lags, density = _lag_density(scenario)
    cumulative = np.cumsum(density)
    cumulative = (cumulative - cumulative[0]) / (cumulative[-1] - cumulative[0])
    lagging = rng.uniform(size=len(positions)) >= _ZERO_LAG_FRACTION
    others = np.array(positions)
    pending = np.arange(len(positions))
    for _ in range(_MAX_DRAWS):
        lag = np.interp(rng.uniform(size=len(pending)), cumulative, lags) * lagging[pending]
        moved = _displaced(scenario, positions[pending], lag, rng, scales)
        # Clipping matters for regions so thin, compared with a beam, that no draw is inside.
        others[pending] = np.clip(moved, low, high)
        pending = pending[~((moved >= low) & (moved <= high)).all(axis=1)]
    return others


def confusable_volumes(
        scenario: Scenario, positions: np.ndarray, others: np.ndarray,
        scales: tuple[float, float]) -> np.ndarray:
    """Compute the volumes that positions from `draw_confusable` represent, float64 [N].

    A volume is the reciprocal density of a draw, so that weighted sums over draws approximate
    integrals over the region. Each volume is divided by r^5, where r is the range of the position
    in `positions`. The volume of the posterior of this position is proportional to r^5 if the
    amplitude of the signals is inversely proportional to r.
    """
    # Lags of zero represent all lags below a phase of one radian.
    shortest = SPEED_OF_LIGHT_MPS / (2 * np.pi * max(scenario.center_frequencies_hz))
    ranges, other_ranges = (
        np.maximum(np.linalg.norm(points, axis=1), shortest) for points in (positions, others))
    lags, density = _lag_density(scenario)
    lag = np.abs(other_ranges - ranges)
    by_lag = np.where(lag < _ROUNDING * shortest, _ZERO_LAG_FRACTION / shortest,
                      (1 - _ZERO_LAG_FRACTION) * np.interp(lag, lags, density))
    cosine = np.sum(positions * others, axis=1) / (ranges * other_ranges)
    # The squared displacement in beam widths; its density is an average of Gaussians.
    square = np.maximum(
        (1 / np.clip(cosine, 0.01, 1)**2 - 1) / _beam_width(scenario)**2, _ROUNDING)
    narrow, wide = (np.exp(-square / (2 * scale**2)) for scale in scales)
    by_direction = (wide - narrow) / (2 * np.pi * square * np.log(scales[1] / scales[0]))
    return other_ranges**2 / (
        ranges**5 * np.maximum(by_lag * by_direction, np.finfo(float).tiny))


def _displaced(scenario: Scenario, positions: np.ndarray, lags: np.ndarray,
               rng: np.random.Generator, scales: tuple[float, float]) -> np.ndarray:
    """Move positions by range lags of random sign, and at random across the line of sight."""
    n, (low, high) = len(positions), scenario.roi_bounds_m
    free = high > low
    ranges = np.linalg.norm(positions, axis=1, keepdims=True)
    sight = positions / np.maximum(ranges, 1e-9)
    least, most = np.log(scales)
    scale = np.exp(rng.uniform(least, most, size=(n, 1))) * _beam_width(scenario) * ranges
    transverse = rng.normal(size=(n, 3)) * scale
    transverse -= sight * np.sum(transverse * sight, axis=1, keepdims=True)
    lags = lags * rng.choice([-1, 1], size=n)
    moved = positions + free * transverse
    # Coordinates in which the region has no extent are kept; the others are scaled to the range.
    wanted = ranges[:, 0] + lags
    within = np.sqrt(np.maximum(wanted**2 - np.sum(moved[:, ~free]**2, axis=1), 0))
    within = np.copysign(within, wanted) / np.linalg.norm(moved[:, free], axis=1)
    moved[:, free] *= within[:, None]
    return moved


def _lag_density(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return lags up to the diagonal of the region [m] and their probability density [1/m]."""
    low, high = scenario.roi_bounds_m
    frequencies = np.array(scenario.center_frequencies_hz)[:, None]
    shortest = SPEED_OF_LIGHT_MPS / frequencies.max()
    longest = np.linalg.norm(high - low)
    lags = np.linspace(0, longest, 2 + int(longest / shortest * _LAGS_PER_WAVELENGTH))
    mismatch = np.sum(1 - np.cos(2 * np.pi * frequencies * lags / SPEED_OF_LIGHT_MPS), axis=0)
    density = np.exp(-mismatch)
    return lags, density / (density.mean() * longest)


def _beam_width(scenario: Scenario) -> float:
    """Return the width of the narrowest beam that the surface can form, at most 1 [rad]."""
    shortest = SPEED_OF_LIGHT_MPS / max(scenario.center_frequencies_hz)
    return float(min(shortest / surface_sides_m(scenario).max(), 1.0))
