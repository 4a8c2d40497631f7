"""Coverage and consistency in scenarios that are drawn at random.

Problem: the scenarios of other benchmarks were chosen by those who wrote the estimator. Are its
positions honest where nobody has looked? Each seed draws a scenario: carriers from 0.9 to 60 GHz,
one to four bands, apertures, boards of few and many elements, regions that are boxes, planes or
lines in any direction, levels and spreads of the multipath, power, and which parameters are
unknown. The codebook is random, and users are uniformly distributed over the region. One surface
serves all users of a scenario, also if its elements have errors or failures.

The 95 % region of an estimate is the ellipsoid of its covariance that contains 95 % of a Gaussian,
in the dimensions of the region. NEES is the squared error normalised by the covariance, divided by
this number of dimensions: 1 for a consistent estimate. A row is marked if less than 90 % of the
positions are in the region, NEES exceeds 1.6, or less than 95 % of the estimates are fixes, by
more than chance: the 95 % interval contains no value within the limit. The 95 % intervals of
shares are Wilson's; those of NEES are from a percentile bootstrap.

With `--walking`, users move by 0.01 to 30 wavelengths in a cycle, but not by more than 0.4 of the
shortest range, with standard deviations that the scenario declares; up to 32 frames, and times to
retune, are drawn as well. A row then also contains the velocity, and is marked if its limits are
exceeded.

With `--surfaces`, others with scenarios of their own are at random places around the region, as in
a site. For each user, their poses are off as declared.
"""

import dataclasses
import functools
import time
from typing import Any

import numpy as np
from parts import frame
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.experiments.resampling import share_percent
from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.model.geometry import polar_bounds, velocity_std_mps
from rhs_isac_ros.positioning import Site, SiteEstimator, make_estimator
from rhs_isac_ros.support.arguments import integer
from rhs_isac_ros.system import System

LEAST_COVERED, LEAST_FIX, MOST_NEES = 90.0, 95.0, 1.6
# Fields that a description names if they are not 0.
UNKNOWN = ('user_gain_std_db', 'phase_std_rad', 'band_phase_std_rad', 'timing_std_s',
           'carrier_offset_std_hz', 'element_error_rms', 'failed_element_share',
           'blocked_probability')


def main() -> None:
    """Run the benchmark."""
    parser = frame.benchmark_parser('arbitrary', __doc__, 60, default_seed=None, has_jobs=True)
    parser.add_argument('--first', type=integer(0, 10**9), default=0, help='first seed')
    parser.add_argument('--scenarios', type=integer(1, 10**6), default=40,
                        help='number of scenarios')
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument('--walking', action='store_true',
                       help='users walk in a cycle, with a declared velocity')
    kinds.add_argument('--surfaces', type=integer(1, 8), default=1,
                       help='number of surfaces around the region')
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.scenarios)
    results = frame.measured(options, 'arbitrary', measure, {
        str(one): {'seed': one, 'n': options.positions, 'walking': options.walking,
                   'n_surfaces': options.surfaces} for one in seeds})
    table = frame.Table(['seed', 'scenario', ''], {
        'fix [%]': ('fix', 1), 'in the 95 % region [%]': ('covered', 1), 'NEES': ('nees', 2),
        'error [m]': ('rms_m', 3), **({
            'velocity in its region [%]': ('velocity_covered', 1),
            'NEES of the velocity': ('velocity_nees', 2)} if options.walking else {}),
        'time of a fix [ms]': ('fix_ms', 1)})
    for name, figures in results.items():
        table.row(name, figures['about'], 'marked' if figures['marked'] else '', **figures)
    frame.write_results(options.json, results)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(f'{np.exp(rng.uniform(np.log(low), np.log(high))):.3g}')


def draw(rng: np.random.Generator) -> Scenario:
    """Draw a scenario of users at rest."""
    between = functools.partial(log_uniform, rng)

    def maybe(share: float, value: Any, otherwise: Any = 0.0) -> Any:
        return value if rng.uniform() < share else otherwise

    lowest_hz, n_bands = between(0.9e9, 60e9), int(rng.integers(1, 5))
    gaps = rng.uniform(0.01, 0.2, n_bands - 1)
    centers_hz = lowest_hz * np.concatenate([[1.0], 1 + np.cumsum(gaps)])
    n_subbands, width_hz = int(rng.integers(1, 13)), between(5e4, 0.009 * lowest_hz / 12)
    bandwidth_hz = n_subbands * width_hz
    distance_m = between(1.0, 30.0)
    turn, lift = rng.uniform(-0.9, 0.9), rng.uniform(-0.5, 0.5)
    center_m = distance_m * np.array([
        np.cos(lift) * np.cos(turn), np.cos(lift) * np.sin(turn), np.sin(lift)])
    size_m = distance_m * rng.uniform(0.1, 1.2, 3) * (rng.uniform(size=3) < 0.75)
    if not size_m.any():
        size_m[rng.integers(3)] = 0.5 * distance_m
    size_m[0] = min(size_m[0], 1.7 * center_m[0])
    wavelength_m = SPEED_OF_LIGHT_MPS / lowest_hz
    loss = (wavelength_m / (4 * np.pi * distance_m))**2
    noise_w = 10**(-174 / 10 - 3) * width_hz
    # Users who move by more than a small part of a wavelength in a cycle need a declared velocity.
    n_frames, speed_mps = int(rng.integers(1, 9)), between(0.1, 30.0)
    duration_s = min(between(1e-6, 1e-3), 0.01 * wavelength_m / (n_bands * n_frames * speed_mps))
    return Scenario(
        center_frequencies_hz=tuple(np.round(centers_hz, -3).tolist()), n_subbands=n_subbands,
        subband_width_hz=width_hz, subband_spacing_hz=maybe(0.2, 2 * width_hz),
        n_frames=n_frames, frame_duration_s=duration_s,
        elements_per_side=tuple(rng.integers(3, 13, 2).tolist()),
        element_interval_wavelengths=float(np.round(rng.uniform(0.2, 0.6), 2)),
        n_feeds=int(rng.integers(1, 6)), delay_spread_s=between(1e-9, 1e-6),
        max_user_speed_mps=speed_mps, angular_spread_deg=between(2.0, 60.0),
        max_power_w=noise_w / loss * between(1e-2, 1e4),
        multipath_to_los_db=float(np.round(rng.uniform(-30, 10), 1)),
        multipath_direction_deg=maybe(0.3, tuple(np.round(rng.uniform(-60, 60, 2), 1).tolist()),
                                      (0.0, 0.0)),
        roi_center_m=tuple(np.round(center_m, 3).tolist()),
        roi_size_m=tuple(np.round(size_m, 3).tolist()),
        user_gain_std_db=maybe(0.3, between(0.5, 6.0), maybe(0.1, np.inf)),
        phase_std_rad=maybe(0.3, between(0.1, 7.0)),
        band_phase_std_rad=maybe(0.3, between(0.1, 7.0)),
        timing_std_s=maybe(0.3, between(0.01, 1.0) / bandwidth_hz),
        carrier_offset_std_hz=maybe(0.2, between(1.0, 1e3)),
        element_error_rms=maybe(0.1, between(0.005, 0.05)),
        failed_element_share=maybe(0.1, between(0.005, 0.05)),
        blocked_probability=maybe(0.1, between(0.05, 0.3)))


def with_velocity(at_rest: Scenario, rng: np.random.Generator) -> Scenario:
    """Let the users of a scenario walk in a cycle."""
    between = functools.partial(log_uniform, rng)
    wavelength_m = SPEED_OF_LIGHT_MPS / at_rest.center_frequencies_hz[0]
    nearest_m = float(polar_bounds(at_rest.roi_bounds_m)[0, 0])
    std_mps, n_frames = between(0.05, 5.0), int(between(1, 33))
    way_m = min(between(0.01, 30.0) * wavelength_m, 0.4 * nearest_m)
    retuning = rng.uniform() * (rng.uniform() < 0.3)  # Relative to the time of a band.
    n_bands, cycle_s = at_rest.n_bands, way_m / std_mps
    band_s = min(cycle_s / (n_bands + (n_bands - 1) * retuning), n_frames)
    return dataclasses.replace(
        at_rest, n_frames=n_frames, frame_duration_s=band_s / n_frames,
        retune_s=retuning * band_s, user_speed_std_mps=std_mps,
        # The multipath may change less than the direct path, or not at all.
        max_user_speed_mps=std_mps * float(rng.choice([3**0.5, 0.02, 0.0], p=[0.7, 0.15, 0.15])),
        carrier_offset_std_hz=(rng.uniform() < 0.2) * between(0.01, 1.0) / cycle_s)


def placed(scenario: Scenario, bounds_m: np.ndarray, rng: np.random.Generator) -> Scenario:
    """Move a surface to any side of a region of a site, which it faces, though not exactly."""
    distance_m = np.linalg.norm(np.ptp(bounds_m, axis=0)) / 2 * rng.uniform(1.5, 4.0)
    sight = Rotation.from_euler('ZY', [rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.5)])
    facing = sight * Rotation.from_euler('ZYX', rng.uniform(-0.3, 0.3, 3))
    pose = Pose(tuple(bounds_m.mean(axis=0) - distance_m * sight.apply([1.0, 0.0, 0.0])),
                tuple(facing.as_quat()))
    corners = pose.to_surface(np.stack(np.meshgrid(*bounds_m.T), axis=-1).reshape(-1, 3))
    low, high = corners.min(axis=0), corners.max(axis=0)
    # The signals are as strong as they were drawn.
    nearer = distance_m / np.linalg.norm(scenario.roi_center_m)
    return dataclasses.replace(
        scenario, pose=pose, roi_center_m=tuple((low + high) / 2),
        roi_size_m=tuple(high - low), max_power_w=scenario.max_power_w * nearer**2)


def in_sight(system: System) -> System:
    """Return a surface whose users have a direct path."""
    return System(dataclasses.replace(system.scenario, blocked_probability=0.0), system.codebook)


def signals_of(system: System, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw signals of users at positions of the site; for each, the pose is off as declared."""
    return in_sight(system).sample(np.stack([system.pose.displaced(rng.multivariate_normal(
        np.zeros(6), system.pose.covariance)).to_surface(place) for place in positions]), rng)


def measure(seed: int, n: int, walking: bool = False, n_surfaces: int = 1) -> dict[str, Any]:
    """Measure the scenario of a seed with n positions."""
    rng = np.random.default_rng(seed)
    scenario = draw(rng)
    if walking:
        scenario = with_velocity(scenario, rng)
    system = System(scenario, random_codebook(scenario, rng))
    site = {'first': system}
    for number in range(1, n_surfaces):
        other = placed(draw(rng), scenario.roi_bounds_m, rng)
        site[f'other_{number}'] = System(other, random_codebook(other, rng))
    # Positions of users without a direct path have no error to measure.
    positions, received = in_sight(system).pairs(n, seed)
    velocities = velocity_std_mps(scenario) * rng.standard_normal((n, 3))
    if walking:
        received = in_sight(system).sample(np.hstack([positions, velocities]), rng)
    locate = make_estimator('bayes', scenario, system.codebook).estimate
    if n_surfaces > 1:
        locate = SiteEstimator(Site(site, scenario.roi_bounds_m)).estimate
        received = {name: signals_of(one, positions, rng) for name, one in site.items()}
    begin_s = time.process_time()
    estimate = locate(received)
    fix_ms = 1e3 * (time.process_time() - begin_s) / n
    axes, fix = np.flatnonzero(scenario.roi_size_m), np.asarray(estimate.fix)
    errors = (estimate.mean - positions)[fix][:, axes]
    figures, is_marked = consistency(errors, estimate.covariance[fix][:, axes[:, None], axes])
    if walking:
        of_velocity, is_wrong = consistency(
            (estimate.velocity - velocities)[fix][:, axes],
            estimate.velocity_covariance[fix][:, axes[:, None], axes])
        figures.update({f'velocity_{name}': value for name, value in of_velocity.items()})
        is_marked |= is_wrong
    mse, fixes = frame.mean_interval(np.sum(errors**2, axis=1)), share_percent(int(fix.sum()), n)
    return {
        'about': '; '.join(about(one.scenario) for one in site.values()), 'fix': fixes, **figures,
        'rms_m': mse and [value**0.5 for value in mse], 'fix_ms': fix_ms,
        'marked': is_marked or bool(fixes[2] < LEAST_FIX)}


def consistency(errors: np.ndarray, covariances: np.ndarray) -> tuple[dict[str, Any], bool]:
    """Compare errors [N, D] with covariances [N, D, D]; also return whether they are too large."""
    squares = np.sum(errors * np.linalg.solve(covariances, errors[..., None])[..., 0], axis=1)
    n_axes = errors.shape[1]
    covered = share_percent(int(np.sum(squares <= chdtri(n_axes, 0.05))), max(len(squares), 1))
    nees = frame.mean_interval(squares / n_axes)
    return {'covered': covered, 'nees': nees, 'squares': squares.tolist()}, bool(
        covered[2] < LEAST_COVERED or nees is not None and nees[1] > MOST_NEES)


def about(scenario: Scenario) -> str:
    """Describe a scenario in a few words."""
    rows, columns = np.broadcast_to(scenario.elements_per_side, 2)
    words = [
        f'{scenario.center_frequencies_hz[0] / 1e9:.3g} GHz',
        f'{scenario.n_bands} x {scenario.n_subbands} x {scenario.n_frames}',
        f'elements {rows} x {columns}',
        'region {:.3g} x {:.3g} x {:.3g} m'.format(*scenario.roi_size_m),
        f'multipath {scenario.multipath_to_los_db:g} dB']
    return ', '.join(words + [f'{name} {value:.3g}' for name in ('user_speed_std_mps', *UNKNOWN)
                              if (value := getattr(scenario, name))])


if __name__ == '__main__':
    frame.run(main)
