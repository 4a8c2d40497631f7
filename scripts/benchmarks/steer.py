"""Capacity that the beam search does not reach, and its time, in all bands.

Problem: the capacity has many local maxima. A position error costs well under one per cent of it,
so the loss can only be measured if the search finds nearly the global maximum everywhere. Two
figures test this: the capacity relative to that of a long multi-start optimisation, which only
shares the objective with the search; and the most negative loss, which occurs if the beam for an
estimate near the true position has a higher capacity there than the beam for that position itself.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from parts import frame
from scipy.optimize import minimize

from rhs_isac_ros.link import Beamformer, capacity, choose_beam, steer
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.link.steering import steer_bands
from rhs_isac_ros.model import Scenario

# Standard deviations of the estimates around the true position [m].
SPREADS_M = (0.01, 0.1, 0.3, 1.0, 3.0)
# Covariance of the estimates for which times are measured [m^2].
COVARIANCE_M2 = np.diag([0.9, 0.2, 0.12])**2
# Positions between which the calls alternate.
BLOCK = 10
# Positions of the long optimisation, its random starts at each, and the number of ascents that are
# refined element by element.
N_LONG, STARTS, REFINED = 100, 150, 5
# Pairs of true position and estimate.
PAIRS = 2000


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser('steer', __doc__, 300).parse_args()
    scenario = Scenario()
    bands = range(scenario.n_bands)
    rng = np.random.default_rng(options.seed)
    positions = scenario.sample_positions(options.positions, rng)
    print(f'{len(positions)} positions, seed {options.seed}')
    figures: dict[str, Any] = {'time_ms': compare_times(scenario, bands, positions)}
    for band in bands:
        print(f'band {band}')
        found = np.array([
            rate_bps(scenario, steer(scenario, position, band), position)
            for position in positions])
        print(f'capacity                   {np.median(found) / 1e6:.2f} Mbit/s median')
        figures[f'band {band}'] = row = {'capacity_bps': np.median(found)}
        row['to_long_percent'] = compare_with_long(
            scenario, band, positions[:N_LONG], found, rng)
        row['losses_percent'] = compare_with_estimates(scenario, band, rng)
    frame.write_results(options.json, figures)


def compare_times(scenario: Scenario, bands: Sequence[int], positions: np.ndarray
                  ) -> dict[str, float]:
    """Measure CPU times of the choice of a beam and of its beams alone; return medians [ms].

    The calls alternate every few positions, so that the load of the machine affects both.
    """
    calls = {
        'choice of the band': lambda position: choose_beam(
            scenario, position, COVARIANCE_M2, bands),
        'beams alone': lambda position: steer_bands(scenario, position, bands)}
    times_ms = {name: [] for name in calls}
    for call in calls.values():
        call(positions[0])
    for start in range(0, len(positions), BLOCK):
        for name, call in calls.items():
            for position in positions[start:start + BLOCK]:
                begin_s = time.process_time()
                call(position)
                times_ms[name].append(1e3 * (time.process_time() - begin_s))
    print(f'CPU time for {len(bands)} bands')
    for name, values in times_ms.items():
        print(f'  {name:22}   {np.median(values):.2f} ms median, '
              f'{np.quantile(values, 0.95):.2f} ms 95th percentile')
    return {name: np.median(values) for name, values in times_ms.items()}


def rate_bps(scenario: Scenario, beam: Beamformer, position: np.ndarray) -> float:
    """Return the capacity of a beam at a position [bit/s]."""
    return float(capacity(scenario, beam, position[None])[0])


def compare_with_long(
        scenario: Scenario, band: int, positions: np.ndarray, found: np.ndarray,
        rng: np.random.Generator) -> float:
    """Return the least capacity of the search relative to the long optimisation [%]."""
    best, long_s = [], []
    for position in positions:
        begin = time.process_time()
        best.append(long_optimisation(scenario, band, position, rng))
        long_s.append(time.process_time() - begin)
    print(f'CPU time of the long optimisation {np.median(long_s):.1f} s')
    share = 100 * found[:len(best)] / best
    print(f'share of the long optimum  {share.min():.4f} % minimum, {np.median(share):.4f} % '
          f'median, {share.mean():.4f} % mean of {len(share)}; {np.sum(share > 100.0001)} times '
          'above it')
    return float(share.min())


def long_optimisation(
        scenario: Scenario, band: int, position: np.ndarray, rng: np.random.Generator) -> float:
    """Return the best capacity of quasi-Newton ascents from random starts [bit/s].

    The variable is the configuration, within its bounds; the digital part is always the optimum
    for it. The best few ascents are refined by flipping single elements until no flip increases
    the capacity.
    """
    link = BandLink.to(scenario, position, [band])
    ends = []
    for number in range(STARTS):
        start = rng.uniform(size=scenario.n_elements)
        start = np.round(start) if number % 2 else start
        result = minimize(negative_capacity(link), start, jac=True, method='L-BFGS-B',
                          bounds=[(0, 1)] * len(start), options={'maxiter': 200})
        ends.append(np.clip(result.x, 0, 1))
    ends.sort(key=link.best_rate, reverse=True)
    analog = max((refine(link, end) for end in ends[:REFINED]), key=link.best_rate)
    return rate_bps(scenario, Beamformer(analog, link.best_digital(analog)[0, 0], band), position)


def negative_capacity(link: BandLink) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
    """Return the negative capacity [nat] with its gradient, from the explicit channels."""
    matrix = link.spatial.matrix[0]
    factor = np.linalg.cholesky(matrix + 1e-12 * np.trace(matrix) * np.eye(len(matrix)))
    onboard, los = link.onboard[0], link.los[0]
    # LoS channel and modes of the multipath, [N_SB, N_E, 1 + N_E].
    modes = np.concatenate([
        los[:, :, None], np.broadcast_to(factor, (len(los), *factor.shape))], axis=2)

    def evaluate(analog: np.ndarray) -> tuple[float, np.ndarray]:
        digital = link.best_digital(analog)[0, 0]
        feeding = np.matmul(digital[:, None, :], onboard)[:, 0] / np.sqrt(link.noise_power_w)
        received = np.matmul((feeding * analog)[:, None, :], modes)[:, 0]
        snr = np.sum(np.abs(received)**2, axis=1)
        back = np.matmul(modes, np.conj(received)[:, :, None])[:, :, 0]
        gradient = 2 * (feeding * back).real
        return -np.log1p(snr).sum(), -(gradient / (1 + snr)[:, None]).sum(axis=0)
    return evaluate


def refine(link: BandLink, analog: np.ndarray) -> np.ndarray:
    """Flip single elements to the other end of their range while this increases the capacity."""
    analog, rate, gained = analog.copy(), link.best_rate(analog), True
    while gained:
        gained = False
        for element in range(len(analog)):
            other = analog.copy()
            other[element] = 1 - np.round(other[element])
            if link.best_rate(other) > rate * (1 + 1e-12):
                analog, rate, gained = other, link.best_rate(other), True
    return analog


def compare_with_estimates(
        scenario: Scenario, band: int, rng: np.random.Generator) -> dict[str, float]:
    """Return the median loss by position error, and the most negative loss [%]."""
    losses = {spread: [] for spread in SPREADS_M}
    while sum(map(len, losses.values())) < PAIRS:
        position = scenario.sample_positions(1, rng)[0]
        perfect = rate_bps(scenario, steer(scenario, position, band), position)
        for spread, lost in losses.items():
            # As those of an estimator, in the region.
            estimate = np.clip(position + rng.normal(scale=spread, size=3), *scenario.roi_bounds_m)
            actual = rate_bps(scenario, steer(scenario, estimate, band), position)
            lost.append(100 * (perfect - actual) / perfect)
    for spread, lost in losses.items():
        print(f'loss at {spread:4.2f} m            {np.median(lost):.4f} % median, '
              f'{min(lost):+.4f} % minimum of {len(lost)}')
    largest = -min(0.0, *map(min, losses.values()))
    print(f'largest negative loss      {largest:.4f} %')
    return {f'{spread:g} m': np.median(lost) for spread, lost in losses.items()} | {
        'largest negative': largest}


if __name__ == '__main__':
    frame.run(main)
