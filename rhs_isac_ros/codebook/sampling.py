"""Where the objectives sample the region of interest."""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS

# Steps of the finest carrier wavelength in which range lags are told apart.
_LAGS_A_WAVELENGTH = 64
# Scales of the displacement across the line of sight, in widths of the narrowest beam.
_ACROSS = 0.03, 0.3
# Share of the pairs that differ in direction alone.
_NO_LAG = 0.3
# How often to draw again what is outside of the region.
_ROUNDS = 200


def monte_carlo(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Independent uniform positions, as in the paper.

    Parameters
    ----------
    scenario
        The scenario.
    n
        How many.
    rng
        Source of randomness.

    Returns
    -------
    numpy.ndarray
        Float64 [n, 3] [m].
    """
    return scenario.sample_positions(n, rng)


def sobol(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Scrambled Sobol points: uniform, and spread more evenly than independent ones.

    Parameters
    ----------
    scenario
        The scenario.
    n
        How many; a power of two is spread best.
    rng
        Source of the scrambling.

    Returns
    -------
    numpy.ndarray
        Float64 [n, 3] [m].
    """
    # Here: a slow import, and most that use a codebook do not sample for one.
    from scipy.stats import qmc

    points = qmc.Sobol(3, scramble=True, seed=rng).random_base2(max(n - 1, 0).bit_length())[:n]
    low, high = scenario.roi_bounds_m
    return low + (high - low) * points


SAMPLINGS: Mapping[str, Callable] = {'monte_carlo': monte_carlo, 'sobol': sobol}


def confusable(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """For each position, draw another one that its signals may be taken for.

    Two positions are hard to tell apart where their ranges differ by about a whole number of
    wavelengths in every band: lags are drawn with a density of exp(-sum_i (1 - cos 2 pi f_i lag /
    v_0)). Of a share of the positions the lag is 0: these differ in direction alone. Across the
    line of sight the others lie within a beam, on scales from well below its width up to its side
    lobes.

    Parameters
    ----------
    scenario
        The scenario.
    positions
        Positions in the region of interest, float64 [N, 3] [m].
    rng
        Source of randomness.

    Returns
    -------
    numpy.ndarray
        Positions in the region, float64 [N, 3] [m].
    """
    low, high = scenario.roi_bounds_m
    lags, cumulative = _lag_distribution(scenario)
    lagging = rng.uniform(size=len(positions)) >= _NO_LAG
    others = np.array(positions)
    left = np.arange(len(positions))
    for _ in range(_ROUNDS):
        lag = np.interp(rng.uniform(size=len(left)), cumulative, lags) * lagging[left]
        moved = _displaced(scenario, positions[left], lag, rng)
        # What is never inside ends at the rim: a region may be much thinner than a beam.
        others[left] = np.clip(moved, low, high)
        left = left[~((moved >= low) & (moved <= high)).all(axis=1)]
    return others


def _displaced(scenario: Scenario, positions: np.ndarray, lags: np.ndarray,
               rng: np.random.Generator) -> np.ndarray:
    """Move positions by range lags of either sign, and at random across the line of sight."""
    n = len(positions)
    ranges = np.linalg.norm(positions, axis=1, keepdims=True)
    sight = positions / np.maximum(ranges, 1e-9)
    scale = np.exp(rng.uniform(*np.log(_ACROSS), size=(n, 1))) * _beam_width(scenario) * ranges
    across = rng.normal(size=(n, 3)) * scale
    across -= sight * np.sum(across * sight, axis=1, keepdims=True)
    lags = lags * rng.choice([-1, 1], size=n)
    moved = positions + across
    return moved * (ranges + lags[:, None]) / np.linalg.norm(moved, axis=1, keepdims=True)


def _lag_distribution(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Lags up to the diagonal of the region [m], and their cumulative distribution."""
    low, high = scenario.roi_bounds_m
    frequencies = np.array(scenario.center_frequencies_hz)[:, None]
    shortest = SPEED_OF_LIGHT_MPS / frequencies.max()
    longest = np.linalg.norm(high - low)
    lags = np.linspace(0, longest, 2 + int(longest / shortest * _LAGS_A_WAVELENGTH))
    mismatch = np.sum(1 - np.cos(2 * np.pi * frequencies * lags / SPEED_OF_LIGHT_MPS), axis=0)
    cumulative = np.cumsum(np.exp(-mismatch))
    return lags, (cumulative - cumulative[0]) / (cumulative[-1] - cumulative[0])


def _beam_width(scenario: Scenario) -> float:
    """Width of the narrowest beam that the surface can form [rad]."""
    frequencies = np.array(scenario.center_frequencies_hz)
    side = (scenario.elements_per_side * scenario.element_interval_wavelengths
            * np.mean(SPEED_OF_LIGHT_MPS / frequencies))
    return float(min(SPEED_OF_LIGHT_MPS / frequencies.max() / side, 1.0))
