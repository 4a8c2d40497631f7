"""How much capacity the search for a beam leaves on the table, and how long it takes.

Problem: the capacity has many maxima. A wrong position costs well under one per cent of it, so a
loss can only be measured if the search finds nearly the highest maximum everywhere. Three figures
tell: the share of what a long multi-start optimisation finds, which shares nothing with the search
but the objective; the latency; and whether the beam for an estimate near a true position ever
carries more at the true position than the beam for that position itself, a negative loss.
"""

import os

# One thread, as in the transmission node. This must come before NumPy is loaded.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from rhs_isac_ros.link import Beam, capacity, steer
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import matched_configuration

# Standard deviations of the estimates around the true position [m].
SPREADS_M = (0.01, 0.1, 0.3, 1.0, 3.0)
# Ascents of the long optimisation that go on with single elements.
FLIPPED = 5


def main() -> None:
    """Steer, compare, and print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--scenario', type=Path)
    parser.add_argument('--band', type=int, default=0)
    parser.add_argument('--positions', type=int, default=100)
    parser.add_argument('--starts', type=int, default=150,
                        help='random starts of the long optimisation at each position')
    parser.add_argument('--pairs', type=int, default=2000,
                        help='pairs of a true position and an estimate')
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    rng = np.random.default_rng(options.seed)
    positions = scenario.sample_positions(options.positions, rng)
    print(f'{options.positions} positions, band {options.band}, seed {options.seed}')
    found = compare_with_long(scenario, options.band, positions, options.starts, rng)
    compare_with_matched(scenario, options.band, positions, found)
    compare_with_estimates(scenario, options.band, options.pairs, rng)


def rate_bps(scenario: Scenario, beam: Beam, position: np.ndarray) -> float:
    """Capacity of a beam at a position."""
    return float(capacity(scenario, beam, position[None])[0])


def compare_with_long(
        scenario: Scenario, band: int, positions: np.ndarray, n_starts: int,
        rng: np.random.Generator) -> np.ndarray:
    """Print share and latency; return the capacities found [bit/s]."""
    steer(scenario, positions[0], band)
    found, best, times_s, long_s = [], [], [], []
    for position in positions:
        begin = time.perf_counter()
        beam = steer(scenario, position, band)
        times_s.append(time.perf_counter() - begin)
        found.append(rate_bps(scenario, beam, position))
        begin = time.perf_counter()
        best.append(long_optimisation(scenario, band, position, n_starts, rng))
        long_s.append(time.perf_counter() - begin)
    share = 100 * np.divide(found, best)
    print(f'share of the long optimum  {share.min():.4f} % least, {np.median(share):.4f} % '
          f'median, {share.mean():.4f} % mean; {np.sum(share > 100.0001)} times above it')
    print(f'capacity                   {np.median(found) / 1e6:.2f} Mbit/s median')
    print(f'latency                    {1e3 * np.median(times_s):.2f} ms median, '
          f'{1e3 * np.quantile(times_s, 0.95):.2f} ms 95th percentile; the long optimisation '
          f'{np.median(long_s):.1f} s')
    return np.array(found)


def long_optimisation(
        scenario: Scenario, band: int, position: np.ndarray, n_starts: int,
        rng: np.random.Generator) -> float:
    """Best capacity of quasi-Newton ascents within the box from random starts [bit/s].

    The configuration is the variable; at each the digital part is the best there is. The best few
    ascents go on with single elements at the other end of their range until none gains.
    """
    link = BandLink.to(scenario, position, band)
    ends = []
    for number in range(n_starts):
        start = rng.uniform(size=scenario.n_elements)
        start = np.round(start) if number % 2 else start
        descent = minimize(slope_of(link), start, jac=True, method='L-BFGS-B',
                           bounds=[(0, 1)] * len(start), options={'maxiter': 200})
        ends.append(np.clip(descent.x, 0, 1))
    ends.sort(key=link.best_rate, reverse=True)
    analog = max((flip(link, end) for end in ends[:FLIPPED]), key=link.best_rate)
    return rate_bps(scenario, Beam(analog, link.best_digital(analog), band), position)


def slope_of(link: BandLink) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
    """Negative capacity [nat] and its slope, from the channels written out."""
    factor = np.linalg.cholesky(
        link.spatial + 1e-12 * np.trace(link.spatial) * np.eye(len(link.spatial)))
    # Waves in the air, [N_SB, N_E, 1 + N_E]: every mode of the multipath.
    waves = np.concatenate([
        link.los[:, :, None], np.broadcast_to(factor, (len(link.los), *factor.shape))], axis=2)

    def descent(analog: np.ndarray) -> tuple[float, np.ndarray]:
        digital = link.best_digital(analog)
        board = np.matmul(digital[:, None, :], link.onboard)[:, 0] / np.sqrt(link.noise_w)
        through = np.matmul((board * analog)[:, None, :], waves)[:, 0]
        ratio = np.sum(np.abs(through)**2, axis=1)
        back = np.matmul(waves, np.conj(through)[:, :, None])[:, :, 0]
        slope = 2 * (board * back).real
        return -np.log1p(ratio).sum(), -(slope / (1 + ratio)[:, None]).sum(axis=0)
    return descent


def flip(link: BandLink, analog: np.ndarray) -> np.ndarray:
    """Bring single elements to the other end of their range while that gains."""
    analog, rate, gained = analog.copy(), link.best_rate(analog), True
    while gained:
        gained = False
        for element in range(len(analog)):
            other = analog.copy()
            other[element] = 1 - np.round(other[element])
            if link.best_rate(other) > rate * (1 + 1e-12):
                analog, rate, gained = other, link.best_rate(other), True
    return analog


def compare_with_matched(
        scenario: Scenario, band: int, positions: np.ndarray, found: np.ndarray) -> None:
    """Print the gain over the holographic principle with the best digital part."""
    gains = []
    for position, rate in zip(positions, found, strict=True):
        link = BandLink.to(scenario, position, band)
        analog = matched_configuration(link.los, link.onboard)
        matched = rate_bps(scenario, Beam(analog, link.best_digital(analog), band), position)
        gains.append(100 * (rate / matched - 1))
    print(f'gain over matched filter   {np.median(gains):.2f} % median, {min(gains):.2f} % least')


def compare_with_estimates(
        scenario: Scenario, band: int, n_pairs: int, rng: np.random.Generator) -> None:
    """Print the loss by errors of the position, and the largest negative loss."""
    losses = {spread: [] for spread in SPREADS_M}
    while sum(map(len, losses.values())) < n_pairs:
        position = scenario.sample_positions(1, rng)[0]
        perfect = rate_bps(scenario, steer(scenario, position, band), position)
        for spread, lost in losses.items():
            estimate = position + rng.normal(scale=spread, size=3)
            actual = rate_bps(scenario, steer(scenario, estimate, band), position)
            lost.append(100 * (perfect - actual) / perfect)
    for spread, lost in losses.items():
        print(f'loss at {spread:4.2f} m            {np.median(lost):.4f} % median, '
              f'{min(lost):+.4f} % least of {len(lost)}')
    print(f'largest negative loss      {-min(0.0, *map(min, losses.values())):.4f} %')


if __name__ == '__main__':
    main()
