"""A benchmark from the paper: focused beams that scan the region of interest."""

import numpy as np

from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.surface import matched_configuration, on_levels, onboard_matrix


def directional_codebook(
        scenario: Scenario, rng: np.random.Generator | None = None) -> Codebook:
    """Focus each of the N_B F frames on a different point: the paper's `Directional`.

    The focal points are spread across the width of the region of interest. Consecutive points
    belong to different bands, so that each band scans the whole width. Frames alternate between
    points below and above mid-height: beams that were all symmetric in height could not
    distinguish up from down. The configuration follows the holographic principle. The weights of
    each sub-band are the matched filter of the resulting feed signals, with equal power in all
    sub-bands. The codebook is deterministic; `rng` is unused.

    Raises
    ------
    ValueError
        If a gain pattern of the scenario is zero at a focal point.
    """
    sizes = scenario.sizes
    analog = np.empty([sizes[s] for s in ('N_B', 'F', 'N_E')])
    digital = np.empty([sizes[s] for s in ('N_B', 'N_SB', 'F', 'K')], complex)
    points = focal_points(scenario)
    for band, onboard in enumerate(onboard_matrix(scenario)):
        for frame, los in enumerate(los_gain(scenario, points[:, band], band)):
            analog[band, frame] = on_levels(
                scenario, matched_configuration(los, onboard))
            feeds = np.einsum('jkm,jm->jk', onboard, analog[band, frame] * los)
            if not los.any():
                raise ValueError(
                    f'element_gain, user_gain: no gain at {points[frame, band].tolist()} m, '
                    f'expected a positive one at the focal point of frame {frame}, band {band}')
            digital[band, :, frame] = np.conj(feeds) / np.linalg.norm(
                feeds, axis=1, keepdims=True)
    return Codebook(analog, digital * np.sqrt(scenario.max_power_w / sizes['N_SB']),
                    provenance='directional')


def focal_points(scenario: Scenario) -> np.ndarray:
    """Return the focal points of the beams, float64 [F, N_B, 3] [m]."""
    n_frames, n_bands = scenario.n_frames, scenario.n_bands
    low, high = scenario.roi_bounds_m
    points = np.tile((low + high) / 2, (n_frames, n_bands, 1))
    fractions = (np.arange(n_frames * n_bands) + 0.5) / (n_frames * n_bands)
    points[..., 1] = (low[1] + (high[1] - low[1]) * fractions).reshape(n_frames, n_bands)
    points[..., 2] = low[2] + (high[2] - low[2]) * np.where(
        np.arange(n_frames) % 2, 0.75, 0.25)[:, None]
    return points
