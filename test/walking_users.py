"""A small system whose users walk during a cycle, and users of it."""

import dataclasses

import numpy as np
from scipy.special import chdtri

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.system import System

# A cycle of 0.36 s, in which a user walks several wavelengths.
WALKING = Scenario(
    center_frequencies_hz=(5.25e9, 5.75e9), n_subbands=2, n_frames=12, frame_duration_s=0.015,
    elements_per_side=10, element_interval_wavelengths=0.35, n_feeds=1,
    feed_positions_m=((0.3, 0.0, 0.0),), refractive_index=1.0, max_user_speed_mps=1.5,
    multipath_to_los_db=-6, band_phase_std_rad=6.2832, roi_center_m=(2.5, 0, 0),
    roi_size_m=(2, 2, 0), user_speed_std_mps=1.0, outside_probability=0.0)


def system_of(**changes) -> System:
    scenario = dataclasses.replace(WALKING, **changes)
    return System(scenario, random_codebook(scenario, np.random.default_rng(3)))


def users_of(scenario, n, speed, rng):
    """States in random directions in the plane of the region."""
    way = rng.standard_normal((n, 3)) * (np.array(scenario.roi_size_m) > 0)
    return np.hstack([scenario.sample_positions(n, rng),
                      speed * way / np.linalg.norm(way, axis=1, keepdims=True)])


def inside(errors, covariances, n):
    covariances = covariances + 1e-8 * np.eye(covariances.shape[-1])
    squares = np.einsum('ni,nij,nj->n', errors, np.linalg.inv(covariances), errors)
    return np.mean(squares <= chdtri(n, 0.05))
