"""A scenario with impairments, for bounds that take them into account."""

import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario


@pytest.fixture(scope='session')
def uncertain() -> Scenario:
    """Two bands with little correlation, and every built-in impairment."""
    return Scenario(
        center_frequencies_hz=(1.2e9, 3.1e9), n_subbands=2, n_frames=3, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-4,
        roi_center_m=(3, 0, 0), roi_size_m=(2, 3, 2), user_gain_std_db=2.0,
        carrier_offset_std_hz=700.0, phase_std_rad=0.4, timing_std_s=30e-9,
        band_phase_std_rad=0.7, element_error_rms=0.1, failed_element_share=0.05)


@pytest.fixture(scope='session')
def uncertain_codebook(uncertain, random_beams) -> Codebook:
    return random_beams(uncertain, np.random.default_rng(0))
