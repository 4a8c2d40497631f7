"""Steering one band after the other, each from many random starts: slow, and easy to check.

This is the plain reference for the time and the capacity of `steer`. It improves 320 random pairs
of waves with all modes of the multipath. The ascent then starts from the best four configurations,
or from the matched filter, one after the other.
"""

import functools

import numpy as np

from rhs_isac_ros.link import Beam
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import matched_configuration

N_STARTS = 320
# Number of starts that remain after each round.
N_KEPT = (320, 320, 160, 80, 80, 80, 80, 80, 80)
N_CANDIDATES, N_ASCENTS = 8, 4
MAX_OMITTED = 0.02
MAX_ROUNDS = 50
MIN_GAIN = 1e-9


def steer_sequentially(scenario: Scenario, position: np.ndarray, band: int) -> Beam:
    """Find a beam for a position, float64 [3] [m], in a band with hardly different sub-bands."""
    link = BandLink.to(scenario, position, band)
    starts = [matched_configuration(link.los, link.onboard),
              *candidates(link, modes_of(scenario, band))]
    starts.sort(key=link.best_rate, reverse=True)
    ends = [ascend(link, start) for start in starts[:N_ASCENTS]]
    best = max(ends, key=link.best_rate)
    return Beam(best, link.best_digital(best), band)


@functools.lru_cache(maxsize=16)
def modes_of(scenario: Scenario, band: int) -> np.ndarray:
    """Return the strongest modes G of the multipath, float64 [N_E, r]."""
    spatial = BandLink.to(scenario, np.array(scenario.roi_center_m), band).spatial.matrix
    powers, directions = np.linalg.eigh(spatial)
    powers, directions = np.maximum(powers[::-1], 0), directions[:, ::-1]
    rank = 1 + np.searchsorted(np.cumsum(powers), (1 - MAX_OMITTED) * powers.sum())
    return directions[:, :rank] * np.sqrt(powers[:rank])


def candidates(link: BandLink, modes: np.ndarray) -> list[np.ndarray]:
    """Return configurations of high capacity in the middle sub-band."""
    n_subbands, n_feeds, n_elements = link.onboard.shape
    in_air = np.concatenate([link.los[n_subbands // 2][None], modes.T])
    scale = np.sqrt(link.power_w / n_subbands / link.noise_power_w)
    paths = scale * link.onboard[n_subbands // 2][:, None] * in_air
    matrix = paths.reshape(-1, n_elements).T.copy().view(float)
    rng = np.random.default_rng(0)
    on_board = rng.normal(size=(N_STARTS, n_feeds, 2)) @ [1, 1j]
    pairs = on_board[:, :, None] * (rng.normal(size=(N_STARTS, 1, len(in_air), 2)) @ [1, 1j])
    for n_kept in N_KEPT:
        products = np.conj(pairs).reshape(len(pairs), -1).view(float)
        analog = (products @ matrix.T > 0).astype(float)
        configured = (analog @ matrix).view(complex).reshape(pairs.shape)
        air = np.conj(np.matmul(on_board[:, None], configured))
        on_board = np.conj(np.matmul(configured, np.swapaxes(air, 1, 2))[..., 0])
        on_board /= np.maximum(np.linalg.norm(on_board, axis=-1, keepdims=True), 1e-300)
        air = np.conj(np.matmul(on_board[:, None], configured))[:, 0]
        pairs, snr = on_board[:, :, None] * air[:, None], np.sum(np.abs(air)**2, axis=1)
        best = np.argsort(-snr, kind='stable')[:n_kept]
        analog, on_board, pairs = analog[best], on_board[best], pairs[best]
    return list({row.tobytes(): row for row in analog}.values())[:N_CANDIDATES]


def ascend(link: BandLink, analog: np.ndarray) -> np.ndarray:
    """Increase the capacity by corners and single elements until neither increases it."""
    spread = np.abs(link.los)**2 + link.spatial.power
    for _ in range(MAX_ROUNDS):
        digital = link.best_digital(analog) / np.sqrt(link.noise_power_w)
        weights = np.einsum('jk,jkm->jm', digital, link.onboard)

        def received(other: np.ndarray, weights: np.ndarray = weights) -> tuple:
            radiation = weights * other
            direct, diffuse = np.sum(radiation * link.los, axis=1), link.spatial.scatter(radiation)
            power = np.abs(direct)**2 + np.sum(np.conj(radiation) * diffuse, axis=1).real
            return power, direct, diffuse

        snr, direct, diffuse = received(analog)
        rate = np.log1p(snr).sum()
        slope = 2 * (weights * (np.conj(direct)[:, None] * link.los + np.conj(diffuse))).real
        corner = np.where(link.fixed, 1.0, 1 / (1 + snr) @ slope > 0)
        if np.log1p(received(corner)[0]).sum() - rate > MIN_GAIN * rate:
            analog = corner
            continue
        steps = np.stack([-analog, 1 - analog])[:, None] * ~link.fixed
        changed = snr[:, None] + steps * slope + steps**2 * np.abs(weights)**2 * spread
        rates = np.log1p(np.maximum(changed, 0)).sum(axis=1)
        end, element = np.unravel_index(rates.argmax(), rates.shape)
        if rates.max() - rate <= MIN_GAIN * rate:
            break
        analog = analog.copy()
        analog[element] = end
    return analog
