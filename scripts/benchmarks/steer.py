"""Capacity that the beam search does not reach, and its time, in all bands.

Problem: the capacity has many local maxima. A position error costs well under one per cent of it,
so the loss can only be measured if the search finds nearly the global maximum everywhere. Four
figures test this: the capacity relative to that of a plain search, one band after the other, and
the CPU time of both; the capacity relative to that of a long multi-start optimisation, which only
shares the objective with the search; and the most negative loss, which occurs if the
beam for an estimate near the true position has a higher capacity there than the beam for that
position itself.
"""

import os

# One thread, as in the transmission node. This must be set before NumPy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np
from parts.sequential_steering import steer_sequentially
from scipy.optimize import minimize

from rhs_isac_ros.executables import exit_code_of
from rhs_isac_ros.link import Beam, capacity, choose_beam, expected_capacities, steer
from rhs_isac_ros.link.band_link import BandLink
from rhs_isac_ros.link.steering import steer_bands
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.model.surface import matched_configuration
from rhs_isac_ros.support.arguments import ArgumentParser, input_file, integer, positive_int, seed

# Standard deviations of the estimates around the true position [m].
SPREADS_M = (0.01, 0.1, 0.3, 1.0, 3.0)
# Covariance of the estimates for which times are measured [m^2].
COVARIANCE_M2 = np.diag([0.9, 0.2, 0.12])**2
# Positions between which the calls alternate.
BLOCK = 10
# Ascents of the long optimisation that are refined element by element.
REFINED = 5


def main() -> None:
    """Run the benchmark."""
    parser = ArgumentParser(
        prog='scripts/benchmark steer', description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument('--scenario', type=input_file, help='YAML file of the scenario')
    parser.add_argument('--band', type=integer(0), help='index of the band; all by default')
    parser.add_argument('--positions', type=positive_int, default=300,
                        help='positions for the times and the plain search')
    parser.add_argument('--long', type=integer(0), default=100, metavar='POSITIONS',
                        help='positions for the long optimisation, of those')
    parser.add_argument('--starts', type=positive_int, default=150,
                        help='random starts of the long optimisation per position')
    parser.add_argument('--pairs', type=positive_int, default=2000,
                        help='number of pairs of true position and estimate')
    parser.add_argument('--seed', type=seed, default=1, help='seed of all random numbers')
    options = parser.parse_args()
    scenario = Scenario.from_yaml(options.scenario) if options.scenario else Scenario()
    bands = range(scenario.n_bands) if options.band is None else [options.band]
    if bands[-1] >= scenario.n_bands:
        parser.error(f'argument --band: {options.band}, expected at most {scenario.n_bands - 1}')
    rng = np.random.default_rng(options.seed)
    positions = scenario.sample_positions(options.positions, rng)
    print(f'{len(positions)} positions, seed {options.seed}')
    compare_times(scenario, bands, positions)
    for band in bands:
        print(f'band {band}')
        found = compare_with_plain(scenario, band, positions)
        compare_with_matched(scenario, band, positions, found)
        n_long = min(options.long, len(positions))
        if n_long:
            compare_with_long(scenario, band, positions[:n_long], found, options.starts, rng)
        compare_with_estimates(scenario, band, options.pairs, rng)


def compare_times(scenario: Scenario, bands: Sequence[int], positions: np.ndarray) -> None:
    """Print the CPU times of the choice of a beam and of its parts, and those of a plain search.

    The calls alternate every few positions, so that the load of the machine affects all of them.
    """
    def plain(position: np.ndarray) -> None:
        for band in bands:
            expected_capacities(
                scenario, [steer_sequentially(scenario, position, band)], position,
                COVARIANCE_M2)[0]

    calls = {
        'choice of the band': lambda position: choose_beam(
            scenario, position, COVARIANCE_M2, bands),
        'beams alone': lambda position: steer_bands(scenario, position, bands),
        'plain search': plain,
    }
    times_s = {name: [] for name in calls}
    for call in calls.values():
        call(positions[0])
    for start in range(0, len(positions), BLOCK):
        for name, call in calls.items():
            for position in positions[start:start + BLOCK]:
                begin_s = time.process_time()
                call(position)
                times_s[name].append(time.process_time() - begin_s)
    print(f'CPU time for {len(bands)} bands')
    for name, values in times_s.items():
        print(f'  {name:22}   {1e3 * np.median(values):.2f} ms median, '
              f'{1e3 * np.quantile(values, 0.95):.2f} ms 95th percentile')
    ratio = np.median(times_s['plain search']) / np.median(times_s['choice of the band'])
    print(f'  {"ratio":22}   {ratio:.1f}, plain search over choice of the band')


def compare_with_plain(scenario: Scenario, band: int, positions: np.ndarray) -> np.ndarray:
    """Print the capacity relative to a plain search; return the capacities [bit/s]."""
    found = [rate_bps(scenario, steer(scenario, position, band), position)
             for position in positions]
    plain = [rate_bps(scenario, steer_sequentially(scenario, position, band), position)
             for position in positions]
    print_share('plain search', 100 * np.divide(found, plain))
    print(f'capacity                   {np.median(found) / 1e6:.2f} Mbit/s median')
    return np.array(found)


def print_share(of: str, share: np.ndarray) -> None:
    """Print statistics of capacities relative to others [per cent]."""
    print(f'share of the {of:13} {share.min():.4f} % minimum, {np.median(share):.4f} % '
          f'median, {share.mean():.4f} % mean of {len(share)}; {np.sum(share > 100.0001)} times '
          'above it')


def rate_bps(scenario: Scenario, beam: Beam, position: np.ndarray) -> float:
    """Return the capacity of a beam at a position [bit/s]."""
    return float(capacity(scenario, beam, position[None])[0])


def compare_with_long(
        scenario: Scenario, band: int, positions: np.ndarray, found: np.ndarray, n_starts: int,
        rng: np.random.Generator) -> None:
    """Print the capacity of the search relative to the long optimisation."""
    best, long_s = [], []
    for position in positions:
        begin = time.process_time()
        best.append(long_optimisation(scenario, band, position, n_starts, rng))
        long_s.append(time.process_time() - begin)
    print_share('long optimum', 100 * found[:len(best)] / best)
    print(f'CPU time of the long optimisation {np.median(long_s):.1f} s')


def long_optimisation(
        scenario: Scenario, band: int, position: np.ndarray, n_starts: int,
        rng: np.random.Generator) -> float:
    """Return the best capacity of quasi-Newton ascents from random starts [bit/s].

    The variable is the configuration, within its bounds; the digital part is always the optimum
    for it. The best few ascents are refined by flipping single elements until no flip increases
    the capacity.
    """
    link = BandLink.to(scenario, position, band)
    ends = []
    for number in range(n_starts):
        start = rng.uniform(size=scenario.n_elements)
        start = np.round(start) if number % 2 else start
        result = minimize(negative_capacity(link), start, jac=True, method='L-BFGS-B',
                          bounds=[(0, 1)] * len(start), options={'maxiter': 200})
        ends.append(np.clip(result.x, 0, 1))
    ends.sort(key=link.best_rate, reverse=True)
    analog = max((refine(link, end) for end in ends[:REFINED]), key=link.best_rate)
    return rate_bps(scenario, Beam(analog, link.best_digital(analog), band), position)


def negative_capacity(link: BandLink) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
    """Return the negative capacity [nat] with its gradient, from the explicit channels."""
    factor = np.linalg.cholesky(
        link.spatial.matrix + 1e-12 * np.trace(link.spatial.matrix) * np.eye(len(link.fixed)))
    # LoS channel and modes of the multipath, [N_SB, N_E, 1 + N_E].
    modes = np.concatenate([
        link.los[:, :, None], np.broadcast_to(factor, (len(link.los), *factor.shape))], axis=2)

    def evaluate(analog: np.ndarray) -> tuple[float, np.ndarray]:
        digital = link.best_digital(analog)
        feeding = np.matmul(digital[:, None, :], link.onboard)[:, 0] / np.sqrt(link.noise_power_w)
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


def compare_with_matched(
        scenario: Scenario, band: int, positions: np.ndarray, found: np.ndarray) -> None:
    """Print the gain over the holographic principle with the optimal digital part."""
    gains = []
    for position, rate in zip(positions, found, strict=True):
        link = BandLink.to(scenario, position, band)
        analog = matched_configuration(link.los, link.onboard)
        matched = rate_bps(scenario, Beam(analog, link.best_digital(analog), band), position)
        gains.append(100 * (rate / matched - 1))
    print(f'gain over matched filter   {np.median(gains):.2f} % median, '
          f'{min(gains):.2f} % minimum')


def compare_with_estimates(
        scenario: Scenario, band: int, n_pairs: int, rng: np.random.Generator) -> None:
    """Print the loss by position error, and the most negative loss."""
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
              f'{min(lost):+.4f} % minimum of {len(lost)}')
    print(f'largest negative loss      {-min(0.0, *map(min, losses.values())):.4f} %')


if __name__ == '__main__':
    sys.exit(exit_code_of(main, (ScenarioError,)))
