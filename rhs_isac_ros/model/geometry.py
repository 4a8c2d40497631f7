"""Where elements and feeds lie, and the frequencies of the sub-bands."""

import functools

import numpy as np

from rhs_isac_ros.model.scenario import SPEED_OF_LIGHT_MPS, Scenario


def mean_wavelength_m(scenario: Scenario) -> float:
    """Mean wavelength of the bands' centre frequencies.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    float
        lambda_avr [m], the paper's Section V.
    """
    return float(np.mean(SPEED_OF_LIGHT_MPS / np.array(scenario.center_frequencies_hz)))


def element_interval_m(scenario: Scenario) -> float:
    """Interval between neighbouring elements.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    float
        Delta_E [m].
    """
    return scenario.element_interval_wavelengths * mean_wavelength_m(scenario)


@functools.lru_cache(maxsize=16)
def element_positions(scenario: Scenario) -> np.ndarray:
    """Positions of the elements in the plane x = 0, centred on the origin.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    numpy.ndarray
        Float64 [N_E, 3] [m], read-only; element row * side + column, columns along y, rows
        along z.
    """
    side = scenario.elements_per_side
    line = (np.arange(side) - (side - 1) / 2) * element_interval_m(scenario)
    z, y = np.meshgrid(line, line, indexing='ij')
    positions = np.stack([np.zeros(side**2), y.ravel(), z.ravel()], axis=1)
    positions.flags.writeable = False
    return positions


def feed_positions(scenario: Scenario) -> np.ndarray:
    """Positions of the feeds.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    numpy.ndarray
        Float64 [K, 3] [m]: the scenario's, or K places spread evenly over the horizontal centre
        line of the board.
    """
    if scenario.feed_positions_m is not None:
        return np.array(scenario.feed_positions_m)
    n_feeds = scenario.n_feeds
    length = scenario.elements_per_side * element_interval_m(scenario)
    positions = np.zeros((n_feeds, 3))
    positions[:, 1] = ((np.arange(n_feeds) + 0.5) / n_feeds - 0.5) * length
    return positions


@functools.lru_cache(maxsize=16)
def subband_frequencies_hz(scenario: Scenario) -> np.ndarray:
    """Centre frequencies of the sub-bands.

    Parameters
    ----------
    scenario
        The scenario.

    Returns
    -------
    numpy.ndarray
        f_{i,j}, float64 [N_B, N_SB] [Hz], read-only.
    """
    centers = np.array(scenario.center_frequencies_hz)[:, None]
    offsets = np.arange(scenario.n_subbands) - (scenario.n_subbands - 1) / 2
    frequencies = centers + offsets * scenario.subband_width_hz
    frequencies.flags.writeable = False
    return frequencies
