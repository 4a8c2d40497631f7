"""Estimates in the frame of the site, and checks of received signals."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import Pose
from rhs_isac_ros.positioning import Mixture, SignalError
from rhs_isac_ros.positioning.estimate import Estimate, checked_received, estimate_each


def test_signals_of_one_phase_become_a_batch_of_one(small):
    signals = np.arange(12).reshape(2, 1, 6)
    batch = checked_received(small.codebook, signals)
    assert batch.dtype == complex
    np.testing.assert_array_equal(batch, signals)
    single = checked_received(small.codebook, signals[1].tolist())
    np.testing.assert_array_equal(single, signals[1:])


@pytest.mark.parametrize('shape', [(6,), (1, 5), (2, 6), (6, 1), (1, 1, 1, 6), ()])
def test_the_error_for_another_shape_names_field_shape_and_expectation(small, shape):
    with pytest.raises(SignalError) as caught:
        checked_received(small.codebook, np.zeros(shape))
    message = str(caught.value)
    assert message.startswith(f'received: shape {shape}, expected [N_B, N_SB F] = (1, 6)')


def test_a_position_in_the_site_contains_the_errors_of_the_pose():
    mixture = Mixture(np.zeros(2), [[9.0, 1.0, 0.0], [11.0, 1.0, 0.0]], [np.eye(3)] * 2)
    found = Estimate(*mixture.moments(), density=mixture)
    pose = Pose((1.0, 2.0, 0.0), (0.0, 0.0, 1.0, 1.0), (0.1, 1.0))
    exact = dataclasses.replace(pose, uncertainty=(0.0, 0.0))
    batch = Estimate.of_each([found, Estimate.without_fix('none')])
    for placed in found.to_site(pose), batch.to_site(pose)[0]:
        np.testing.assert_allclose(
            placed.covariance, found.to_site(exact).covariance + pose.spread(placed.mean))
        np.testing.assert_allclose(placed.mixture.moments()[1] - found.covariance,
                                   pose.spread(placed.mean))


def test_a_position_behind_the_surface_is_no_fix(small):
    places = np.array([[8.0, 1.0, 0.0], [-8.0, 1.0, 0.0]])
    found = estimate_each(small.codebook, np.zeros((2, 1, 6)), lambda batch: (
        Estimate(place, np.eye(3)) for place in places))
    assert found.fix.tolist() == [True, False]
    assert found.reason[0] == ''
    assert found.reason[1].startswith('position: x = -8 m, expected x > 0')
