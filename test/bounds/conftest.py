"""A scenario with impairments, and a comparison of gradients with finite differences."""

import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario


@pytest.fixture(scope='session')
def uncertain() -> Scenario:
    """Two bands with little correlation, every built-in impairment, and users who move."""
    return Scenario(
        center_frequencies_hz=(1.2e9, 3.1e9), n_subbands=2, n_frames=3, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-4, retune_s=1e-3,
        user_speed_std_mps=30.0, roi_center_m=(3, 0, 0), roi_size_m=(2, 3, 2),
        user_gain_std_db=2.0,
        carrier_offset_std_hz=700.0, phase_std_rad=0.4, timing_std_s=30e-9,
        band_phase_std_rad=0.7, element_error_rms=0.1, failed_element_share=0.05)


@pytest.fixture(scope='session')
def uncertain_codebook(uncertain, random_beams) -> Codebook:
    return random_beams(uncertain, np.random.default_rng(0))


@pytest.fixture(scope='session')
def assert_gradients():
    """Function that compares gradients with finite differences in random directions."""
    def check(gradients, value, codebook, rng, slack=0.0, step=1e-5):
        """Compare; `value` takes analog and digital variables, with rounding error `slack`."""
        start = {'analog': codebook.analog, 'digital': codebook.digital}
        for _ in range(2):
            for (name, values), gradient in zip(start.items(), gradients, strict=True):
                assert (gradient.shape, gradient.dtype) == (values.shape, values.dtype)
                way = rng.normal(size=(*values.shape, 2)) @ [1, 1j if name == 'digital' else 0]
                way = way.astype(values.dtype) * (np.linalg.norm(values) / np.linalg.norm(way))
                ahead, behind = (value(**start | {name: values + sign * step * way})
                                 for sign in (1, -1))
                scale = np.linalg.norm(gradient) * np.linalg.norm(way)
                assert np.sum(gradient.conj() * way).real == pytest.approx(
                    (ahead - behind) / (2 * step), abs=slack + 1e-6 * scale)
    return check
