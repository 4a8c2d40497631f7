"""Estimates in the frame of the site, and checks of received signals."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest

from rhs_isac_ros.model import Pose
from rhs_isac_ros.positioning import BayesEstimator, Mixture, SignalError, Tracker
from rhs_isac_ros.positioning.estimate import Estimate, checked_received, estimate_each
from rhs_isac_ros.system import System


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
    assert message == f'received: shape {shape}, expected [1, 6] or [N, 1, 6]'


def test_a_notebook_shows_position_errors_and_reason():
    one = Estimate(np.array([9.0, 1.0, 0.0]), np.diag([4.0, 1.0, 0.25]))
    assert repr(one) == "Estimate(mean=[9. 1. 0.], std=[2.  1.  0.5], reason='')"
    two = Estimate(np.array([[9.0, 1, 0], [np.nan] * 3]), np.full((2, 3, 3), np.nan), ('', 'far'))
    assert repr(two) == '<2 estimates, 1 with a position>'


def test_a_position_in_the_site_contains_the_errors_of_the_pose():
    mixture = Mixture(np.zeros(2), [[9.0, 1.0, 0.0], [11.0, 1.0, 0.0]], [np.eye(3)] * 2)
    found = Estimate(*mixture.moments(), density=mixture)
    pose = Pose((1.0, 2.0, 0.0), (0.0, 0.0, 1.0, 1.0), (0.1, 1.0))
    exact = dataclasses.replace(pose, uncertainty=(0.0, 0.0))
    batch = Estimate.of_each([found, Estimate.without_fix('none')])
    for placed in found.to_site(pose), batch.to_site(pose)[0]:
        np.testing.assert_allclose(
            placed.covariance, found.to_site(exact).covariance + pose.scatter(placed.mean))
        np.testing.assert_allclose(placed.mixture.moments()[1] - found.covariance,
                                   pose.scatter(placed.mean))


def test_a_position_behind_the_surface_is_no_fix(small):
    places = np.array([[8.0, 1.0, 0.0], [-8.0, 1.0, 0.0]])
    found = estimate_each(small.codebook, np.zeros((2, 1, 6)), lambda batch: (
        Estimate(place, np.eye(3)) for place in places))
    assert found.fix.tolist() == [True, False]
    assert found.reason[0] == ''
    assert found.reason[1].startswith('position: x = -8 m, expected x > 0')


@pytest.mark.parametrize('copied', [copy.copy, copy.deepcopy, lambda one: pickle.loads(
    pickle.dumps(one))])
def test_a_copy_of_a_posterior_has_its_mixture_and_its_sighting(small, copied):
    system = System(small.scenario, small.codebook)
    estimator = BayesEstimator(system)
    received = system.sample(np.array([[8.0, 1.0, 0.2]]), np.random.default_rng(1))
    found = estimator.posterior(np.concatenate([received, 0 * received]))
    mixtures, sightings = found.mixture, found.sighting
    assert mixtures[1] is sightings[1] is None
    for one, mixture, sighting in (
            (copied(found)[0], mixtures[0], sightings[0]),
            (copied(found[0]), found[0].mixture, found[0].sighting),
            (copied(found).to_site(Pose()), None, None)):
        np.testing.assert_array_equal(one.mean, found[0].mean if mixture else found.mean)
        if mixture:
            np.testing.assert_array_equal(one.mixture.means, mixture.means)
            np.testing.assert_array_equal(one.sighting.sheets.means, sighting.sheets.means)
    tracker = Tracker(estimator)
    tracker.update(0.0, received[0])
    np.testing.assert_array_equal(copied(tracker).update(0.1, received[0]).mean,
                                  tracker.update(0.1, received[0]).mean)
