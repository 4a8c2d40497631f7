"""Steering: the beam of the highest capacity at a position."""

import numpy as np

from rhs_isac_ros.link.capacity import Beam, capacity
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import checked_positions, los_gain
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.model.surface import matched_configuration, onboard_matrix

# Rounds at most; five are usual.
_ROUNDS = 20


def steer(
        scenario: Scenario, position: np.ndarray, band: int = 0, *,
        rival: np.ndarray | None = None) -> Beam:
    """Find a beam that maximises Eq. (11) for a user at a position.

    Starts from the matched filter (analog by the holographic principle) and improves analog and
    digital part in turn, so that it never does worse.

    Parameters
    ----------
    scenario
        The scenario.
    position
        Position of the user, float64 [3] [m].
    band
        Index of the band, from 0.
    rival
        A configuration, float64 [N_E], from which the search starts as well; the better outcome
        counts. The maximum has neighbours of nearly its height, and a comparison with the beam
        of that configuration must not depend on which of them was found.

    Returns
    -------
    Beam
        The beam, with the power P_max over all sub-bands.

    Raises
    ------
    ValueError
        If the position is not a finite [3] array, or there is no such band.
    """
    if not 0 <= band < scenario.n_bands:
        raise ValueError(f'band: {band}, expected 0 to {scenario.n_bands - 1}')
    positions = checked_positions(np.asarray(position, dtype=float)[None])
    los = los_gain(scenario, positions, band)[0]
    beam = _climb(scenario, los, matched_configuration(los, onboard_matrix(scenario)[band]), band)
    if rival is None:
        return beam
    return max(beam, _climb(scenario, los, rival, band),
               key=lambda found: capacity(scenario, found, positions)[0])


def _climb(scenario: Scenario, los: np.ndarray, analog: np.ndarray, band: int) -> Beam:
    """Improve analog and digital part in turn until nothing gains."""
    onboard = onboard_matrix(scenario)[band]
    spatial = multipath_covariance(scenario)[band]
    digital = _best_digital(scenario, analog, los, spatial, onboard)
    for _ in range(_ROUNDS):
        better = _ascend(scenario, analog, digital, los, spatial, onboard)
        if better is analog:
            break
        analog = better
        digital = _best_digital(scenario, analog, los, spatial, onboard)
    return Beam(analog, digital, band)


def _best_digital(
        scenario: Scenario, analog: np.ndarray, los: np.ndarray, spatial: np.ndarray,
        onboard: np.ndarray) -> np.ndarray:
    """Principal directions of the K x K channels, the power shared out by water-filling."""
    configured = onboard * analog
    toward = np.einsum('jkm,jm->jk', configured, los)
    channel = toward[:, :, None] * np.conj(toward[:, None, :])
    channel += np.matmul(configured @ spatial, np.conj(np.swapaxes(configured, 1, 2)))
    gains, directions = np.linalg.eigh(channel)
    power = water_filling(gains[:, -1] / scenario.noise_power_w, scenario.max_power_w)
    # s is a row: s M s^H is largest along the conjugate of the eigenvector.
    return np.conj(directions[:, :, -1]) * np.sqrt(power)[:, None]


def water_filling(gains: np.ndarray, power: float) -> np.ndarray:
    """Share power over parallel channels so that the sum of log(1 + gain * share) is highest.

    Parameters
    ----------
    gains
        Gain over noise of each channel, float64 [N] [1/W]. Without a positive one, all get the
        same.
    power
        Power to share [W].

    Returns
    -------
    numpy.ndarray
        Shares, float64 [N] [W], none negative, with the sum `power`.
    """
    useful = gains > 0
    if not useful.any():
        return np.full(len(gains), power / len(gains))
    floors = np.sort(1 / gains[useful])
    levels = (power + np.cumsum(floors)) / np.arange(1, len(floors) + 1)
    level = levels[np.nonzero(levels > floors)[0][-1]]
    shares = np.zeros(len(gains))
    shares[useful] = np.maximum(level - 1 / gains[useful], 0.0)
    return shares


def _ascend(
        scenario: Scenario, analog: np.ndarray, digital: np.ndarray, los: np.ndarray,
        spatial: np.ndarray, onboard: np.ndarray) -> np.ndarray:
    """Raise the capacity by the configuration, or return it where that fails.

    The received power is convex in the configuration, so its linear model at a point lies below
    it, and the best corner of the box by that model is at least as good as the point. The sum of
    logarithms follows the power closely but not always, so the outcome is compared.
    """
    weights = np.einsum('jk,jkm->jm', digital, onboard) / np.sqrt(scenario.noise_power_w)
    toward = weights * los

    def evaluate(configuration: np.ndarray) -> tuple[float, np.ndarray]:
        direct = toward @ configuration
        patterns = weights * configuration
        diffuse = np.conj(patterns @ spatial)
        ratios = np.abs(direct)**2 + np.sum(patterns * diffuse, axis=1).real
        slopes = (np.conj(direct)[:, None] * toward + weights * diffuse).real
        return np.log1p(ratios).sum(), 2 / (1 + ratios) @ slopes

    value, slope = evaluate(analog)
    corner = (slope > 0).astype(float)
    return corner if evaluate(corner)[0] > value else analog
