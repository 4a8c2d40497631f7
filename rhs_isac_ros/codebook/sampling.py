"""Where the objectives sample the region of interest."""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS

# Steps of the finest carrier wavelength in which range lags are told apart.
_LAGS_A_WAVELENGTH = 64
# Scales of the displacement across the line of sight, in widths of the narrowest beam.
_ACROSS = 0.03, 0.3


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
    v_0)), beyond half a wavelength. Across the line of sight they lie within a beam, on scales
    from well below its width up to its side lobes.

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
    others = np.array(positions)
    left = np.arange(len(positions))
    while len(left):
        ranges = np.linalg.norm(positions[left], axis=1, keepdims=True)
        sight = positions[left] / np.maximum(ranges, 1e-9)
        n = len(left)
        lag = np.interp(rng.uniform(size=n), cumulative, lags) * rng.choice([-1, 1], size=n)
        scale = np.exp(rng.uniform(*np.log(_ACROSS), size=(n, 1))) * _beam_width(scenario) * ranges
        across = rng.normal(size=(n, 3)) * scale
        across -= sight * np.sum(across * sight, axis=1, keepdims=True)
        moved = positions[left] + across
        moved *= (ranges + lag[:, None]) / np.linalg.norm(moved, axis=1, keepdims=True)
        inside = ((moved >= low) & (moved <= high)).all(axis=1)
        others[left[inside]] = moved[inside]
        left = left[~inside]
    return others


def _lag_distribution(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Lags up to the diagonal of the region [m], and their cumulative distribution."""
    low, high = scenario.roi_bounds_m
    frequencies = np.array(scenario.center_frequencies_hz)[:, None]
    shortest = SPEED_OF_LIGHT_MPS / frequencies.max()
    lags = np.arange(shortest / 2, np.linalg.norm(high - low), shortest / _LAGS_A_WAVELENGTH)
    if not len(lags):
        raise ValueError(
            f'roi_size_m: {scenario.roi_size_m}, expected a region larger than half a wavelength '
            'for the objective ambiguity')
    mismatch = np.sum(1 - np.cos(2 * np.pi * frequencies * lags / SPEED_OF_LIGHT_MPS), axis=0)
    cumulative = np.cumsum(np.exp(-mismatch))
    return lags, cumulative / cumulative[-1]


def _beam_width(scenario: Scenario) -> float:
    """Width of the narrowest beam that the surface can form [rad]."""
    frequencies = np.array(scenario.center_frequencies_hz)
    side = (scenario.elements_per_side * scenario.element_interval_wavelengths
            * np.mean(SPEED_OF_LIGHT_MPS / frequencies))
    return float(min(SPEED_OF_LIGHT_MPS / frequencies.max() / side, 1.0))
