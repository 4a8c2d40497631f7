"""Codebooks without optimisation: random ones, and focused beams that scan the region of interest.

Both are benchmarks of the paper, whose optimisation starts from the random ones. The paper does
not specify the focal points. `SCANS` contains three interpretations: functions that return focal
points, float64 [F, N_B, 3] [m]. In the first two, frames alternate between points below and above
mid-height, because beams that are all symmetric in height could not distinguish up from down.
"""

from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.surface import NOMINAL, feed_signals, on_levels, ports_of


def random_codebook(scenario: Scenario, rng: np.random.Generator) -> Codebook:
    """Draw random configurations: the paper's `Random`, and the start of its optimisation.

    The entries of C are uniform in [0, 1] and rounded to the amplitude levels, if any. Every entry
    of S is sqrt(P_max / (K N_SB)).
    """
    sizes = scenario.sizes
    analog = on_levels(scenario, rng.uniform(size=[sizes[s] for s in ('N_B', 'F', 'N_E')]))
    weight = np.sqrt(scenario.max_power_w / (sizes['K'] * sizes['N_SB']))
    digital = np.full((sizes['N_B'], sizes['N_SB'], sizes['F'], sizes['K']), weight, complex)
    return Codebook(analog, digital, provenance='random')


def directional_codebook(
        scenario: Scenario, scan: str = 'width', surface: SurfaceEstimate | None = None
) -> Codebook:
    """Focus each of the N_B F frames on a point of a scan: the paper's `Directional`.

    The configuration is that of `Board.focused`: on the board of the paper, by the holographic
    principle. The weights of each sub-band are the matched filter of the resulting feed signals,
    with equal power in all sub-bands. Both include the response of a calibrated surface. `scan`
    is one of `SCANS`. Raises ValueError if it is unknown, no element has a gain at a focal point,
    or the elements of the board are coupled.
    """
    if scan not in SCANS:
        raise ValueError(f'scan: {scan!r}, expected one of {sorted(SCANS)}')
    sizes = scenario.sizes
    analog = np.empty([sizes[s] for s in ('N_B', 'F', 'N_E')])
    digital = np.empty([sizes[s] for s in ('N_B', 'N_SB', 'F', 'K')], complex)
    points, response = SCANS[scan](scenario), surface.response if surface else NOMINAL
    for band in range(scenario.n_bands):
        for frame, los in enumerate(los_gain(scenario, points[:, band], band)):
            analog[band, frame] = scenario.board.focused(
                ports_of(scenario, band), response[0] * los, scenario.amplitude_levels)
            feeds = feed_signals(scenario, band, analog[band, frame], los, (*response[:2], 1.0))
            if not los.any():
                raise ValueError(
                    f'element_gain, user_gain: no gain at {points[frame, band].tolist()} m, '
                    f'expected a positive one at the focal point of frame {frame}, band {band}')
            digital[band, :, frame] = np.conj(feeds) / np.linalg.norm(
                feeds, axis=1, keepdims=True)
    return Codebook(analog, digital * np.sqrt(scenario.max_power_w / sizes['N_SB']),
                    provenance='directional' if scan == 'width' else f'directional, {scan}')


def width_points(scenario: Scenario) -> np.ndarray:
    """Return N_B F points across the width of the region; each band scans the whole width."""
    n_frames, n_bands = scenario.n_frames, scenario.n_bands
    across = _centers(n_frames * n_bands).reshape(n_frames, n_bands)
    return _points(scenario, across, _alternating(n_frames)[:, None])


def width_points_per_band(scenario: Scenario) -> np.ndarray:
    """Return F points across the width, the same in each band."""
    n_frames = scenario.n_frames
    return _points(scenario, _centers(n_frames)[:, None], _alternating(n_frames)[:, None])


def grid_points(scenario: Scenario) -> np.ndarray:
    """Return a grid of F points across width and height, the same in each band.

    The number of rows is the largest divisor of F that does not exceed the square root of F. Four
    frames, for example, form a grid of 2 x 2 points.
    """
    n_frames = scenario.n_frames
    rows = max(n for n in range(1, n_frames + 1) if n_frames % n == 0 and n * n <= n_frames)
    row, column = np.divmod(np.arange(n_frames), n_frames // rows)
    return _points(scenario, _centers(n_frames // rows)[column][:, None],
                   _centers(rows)[row][:, None])


SCANS: Mapping[str, Callable[[Scenario], np.ndarray]] = {
    'width': width_points, 'width_per_band': width_points_per_band, 'grid': grid_points}


def _points(scenario: Scenario, across: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Place points at mid-depth, at fractions of width and height that broadcast to [F, N_B]."""
    low, high = scenario.roi_bounds_m
    points = np.tile((low + high) / 2, (scenario.n_frames, scenario.n_bands, 1))
    points[..., 1] = low[1] + (high[1] - low[1]) * across
    points[..., 2] = low[2] + (high[2] - low[2]) * up
    return points


def _centers(n: int) -> np.ndarray:
    return (np.arange(n) + 0.5) / n


def _alternating(n_frames: int) -> np.ndarray:
    return np.where(np.arange(n_frames) % 2, 0.75, 0.25)


STARTS: Mapping[
    str, Callable[[Scenario, np.random.Generator, SurfaceEstimate | None], Codebook]] = {
        'random': lambda scenario, rng, _: random_codebook(scenario, rng),
        'directional': lambda scenario, _, surface: directional_codebook(
            scenario, surface=surface)}
