"""Signals of users that walk, with multipath that is correlated between cycles."""

from typing import NamedTuple

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.mobility import RandomWalk
from rhs_isac_ros.model.multipath import complex_normal, square_root, time_correlation


class Walks(NamedTuple):
    """W walks of C cycles.

    Attributes
    ----------
    times_s
        Float64 [C] [s].
    positions
        Float64 [W, C, 3] [m].
    signals
        Complex128 [W, C, N_B, N_SB F].
    """

    times_s: np.ndarray
    positions: np.ndarray
    signals: np.ndarray


def simulate_walks(
        scenario: Scenario, codebook: Codebook, n_walks: int, n_cycles: int, period_s: float,
        speed_mps: float, seed: int) -> Walks:
    """Simulate walks between random positions of the region of interest.

    As in the channel node, the multipath of a cycle is rho times that of the previous cycle plus
    a new draw, with rho of Eq. (4) for the period. The thermal noise is independent.
    """
    model, rng = MeasurementModel(scenario, codebook), np.random.default_rng(seed)
    times_s = period_s * np.arange(n_cycles)
    positions = np.empty((n_walks, n_cycles, 3))
    for path in positions:
        walk = RandomWalk(scenario, speed_mps, rng)
        path[:] = [walk.state(time_s)[0] for time_s in times_s]
    signals = model.mean(positions.reshape(-1, 3)).reshape(n_walks, n_cycles, *model.shape)
    noise_w, n_rows = scenario.noise_power_w, model.shape[1]
    correlation = time_correlation(scenario, period_s)
    for band, (covariance, rho) in enumerate(zip(model.covariance(), correlation, strict=True)):
        root = square_root(covariance - noise_w * np.eye(n_rows))
        drawn = complex_normal((n_walks, n_cycles, root.shape[1]), rng)
        for cycle in range(1, n_cycles):
            drawn[:, cycle] = (
                rho * drawn[:, cycle - 1] + np.sqrt(1 - rho**2) * drawn[:, cycle])
        signals[:, :, band] += drawn @ root.T
        signals[:, :, band] += np.sqrt(noise_w) * complex_normal(
            (n_walks, n_cycles, n_rows), rng)
    return Walks(times_s, positions, signals)
