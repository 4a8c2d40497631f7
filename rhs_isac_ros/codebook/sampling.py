"""Samples of the region of interest for the objectives."""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS

# Grid points of the range lag per shortest carrier wavelength.
_LAGS_PER_WAVELENGTH = 64
# Range of the scale of transverse displacements, in widths of the narrowest beam.
_TRANSVERSE_SCALES = 0.03, 0.3
# Fraction of the pairs that differ in direction only.
_ZERO_LAG_FRACTION = 0.3
# Number of attempts to draw a position inside the region.
_MAX_DRAWS = 200


def monte_carlo(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw independent uniform positions, as the paper does, float64 [n, 3] [m]."""
    return scenario.sample_positions(n, rng)


def sobol(scenario: Scenario, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw scrambled Sobol points, which are more evenly spread, float64 [n, 3] [m].

    A power of two for `n` gives the most even spread.
    """
    # A slow import, which loading a codebook does not need.
    from scipy.stats import qmc

    points = qmc.Sobol(3, scramble=True, seed=rng).random_base2(max(n - 1, 0).bit_length())[:n]
    low, high = scenario.roi_bounds_m
    samples: np.ndarray = low + (high - low) * points
    return samples


SAMPLINGS: Mapping[str, Callable[[Scenario, int, np.random.Generator], np.ndarray]] = {
    'monte_carlo': monte_carlo, 'sobol': sobol}


def draw_confusable(
        scenario: Scenario, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw for each position another one in the region of interest that has similar signals.

    Two positions are hard to distinguish if their ranges differ by about a whole number of
    wavelengths in every band, so range lags are drawn with a density proportional to
    exp(-sum_i (1 - cos 2 pi f_i lag / v_0)). For a fraction of the positions the lag is 0: these
    pairs differ in direction only. Across the line of sight, the displacement ranges from well
    below the beam width up to the side lobes. Positions are float64 [N, 3] [m].
    """
    low, high = scenario.roi_bounds_m
    lags, cumulative = _lag_distribution(scenario)
    lagging = rng.uniform(size=len(positions)) >= _ZERO_LAG_FRACTION
    others = np.array(positions)
    pending = np.arange(len(positions))
    for _ in range(_MAX_DRAWS):
        lag = np.interp(rng.uniform(size=len(pending)), cumulative, lags) * lagging[pending]
        moved = _displaced(scenario, positions[pending], lag, rng)
        # Clipping covers regions so thin, compared with a beam, that no draw is inside.
        others[pending] = np.clip(moved, low, high)
        pending = pending[~((moved >= low) & (moved <= high)).all(axis=1)]
    return others


def _displaced(scenario: Scenario, positions: np.ndarray, lags: np.ndarray,
               rng: np.random.Generator) -> np.ndarray:
    """Move positions by range lags of random sign and randomly across the line of sight."""
    n = len(positions)
    ranges = np.linalg.norm(positions, axis=1, keepdims=True)
    sight = positions / np.maximum(ranges, 1e-9)
    least, most = np.log(_TRANSVERSE_SCALES)
    scale = np.exp(rng.uniform(least, most, size=(n, 1))) * _beam_width(scenario) * ranges
    transverse = rng.normal(size=(n, 3)) * scale
    transverse -= sight * np.sum(transverse * sight, axis=1, keepdims=True)
    lags = lags * rng.choice([-1, 1], size=n)
    moved = positions + transverse
    rescaled: np.ndarray = (
        moved * (ranges + lags[:, None]) / np.linalg.norm(moved, axis=1, keepdims=True))
    return rescaled


def _lag_distribution(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return lags up to the diagonal of the region [m] and their cumulative distribution."""
    low, high = scenario.roi_bounds_m
    frequencies = np.array(scenario.center_frequencies_hz)[:, None]
    shortest = SPEED_OF_LIGHT_MPS / frequencies.max()
    longest = np.linalg.norm(high - low)
    lags = np.linspace(0, longest, 2 + int(longest / shortest * _LAGS_PER_WAVELENGTH))
    mismatch = np.sum(1 - np.cos(2 * np.pi * frequencies * lags / SPEED_OF_LIGHT_MPS), axis=0)
    cumulative = np.cumsum(np.exp(-mismatch))
    return lags, (cumulative - cumulative[0]) / (cumulative[-1] - cumulative[0])


def _beam_width(scenario: Scenario) -> float:
    """Return the width of the narrowest beam that the surface can form [rad]."""
    frequencies = np.array(scenario.center_frequencies_hz)
    side = (scenario.elements_per_side * scenario.element_interval_wavelengths
            * np.mean(SPEED_OF_LIGHT_MPS / frequencies))
    return float(min(SPEED_OF_LIGHT_MPS / frequencies.max() / side, 1.0))
