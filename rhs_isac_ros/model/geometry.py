"""Positions of the elements and feeds, and centre frequencies of the sub-bands."""

import functools

import numpy as np

from rhs_isac_ros.model.arrays import read_only
from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario


def mean_wavelength_m(scenario: Scenario) -> float:
    """Return lambda_avr [m], the mean wavelength of the bands' centres (Section V)."""
    return float(np.mean(SPEED_OF_LIGHT_MPS / np.array(scenario.center_frequencies_hz)))


def element_interval_m(scenario: Scenario) -> float:
    """Return the spacing Delta_E [m] of neighbouring elements."""
    return scenario.element_interval_wavelengths * mean_wavelength_m(scenario)


@functools.lru_cache(maxsize=16)
def element_positions(scenario: Scenario) -> np.ndarray:
    """Compute the positions of the elements in the plane x = 0, centred on the origin.

    Returns float64 [N_E, 3] [m], read-only. The index of an element is row * n_columns + column;
    a row runs along y, a column along z.
    """
    y, z = ((np.arange(n) - (n - 1) / 2) * element_interval_m(scenario)
            for n in (scenario.n_columns, scenario.n_rows))
    lattice = np.zeros((scenario.n_rows, scenario.n_columns, 3))
    lattice[..., 1], lattice[..., 2] = y, z[:, None]
    return read_only(lattice.reshape(-1, 3))


def feed_positions(scenario: Scenario) -> np.ndarray:
    """Return the positions of the feeds, float64 [K, 3] [m].

    Unless the scenario specifies them, they are evenly spaced on the horizontal centre line.
    """
    if scenario.feed_positions_m is not None:
        return np.array(scenario.feed_positions_m)
    n_feeds = scenario.n_feeds
    length = scenario.n_columns * element_interval_m(scenario)
    positions = np.zeros((n_feeds, 3))
    positions[:, 1] = ((np.arange(n_feeds) + 0.5) / n_feeds - 0.5) * length
    return positions


@functools.lru_cache(maxsize=16)
def subband_frequencies_hz(scenario: Scenario) -> np.ndarray:
    """Compute the sub-bands' centre frequencies f_{i,j}, float64 [N_B, N_SB] [Hz], read-only."""
    centers = np.array(scenario.center_frequencies_hz)[:, None]
    offsets = np.arange(scenario.n_subbands) - (scenario.n_subbands - 1) / 2
    return read_only(centers + offsets * scenario.subband_width_hz)
