"""Errors that are the same in all phases: shares of variances, and tracks that count them once."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.elements import draw_surface
from rhs_isac_ros.model.gaussian import quadratic_form
from rhs_isac_ros.model.geometry import jacobian, region_information, to_polar
from rhs_isac_ros.positioning import Motion, Tracker, make_estimator
from rhs_isac_ros.positioning.constant import constant_shares

SCENARIO = Scenario(elements_per_side=6, n_frames=4, element_error_rms=0.05)


@pytest.fixture(scope='module')
def codebook():
    return random_codebook(SCENARIO, np.random.default_rng(0))


def test_without_errors_of_elements_nothing_is_constant(codebook):
    exact = dataclasses.replace(SCENARIO, element_error_rms=0.0)
    np.testing.assert_array_equal(constant_shares(MeasurementModel(exact, codebook)), np.zeros(3))


def test_shares_are_those_of_steps_with_drawn_surfaces(codebook):
    """The steps are from signals without multipath and noise, with elements of many surfaces."""
    rng, model = np.random.default_rng(1), MeasurementModel(SCENARIO, codebook)
    positions = SCENARIO.sample_positions(40, rng)
    by_point = jacobian(to_polar(positions))
    mean, slopes = model.mean_and_jacobian(positions, by_point, whitened=True)
    slopes = slopes.reshape(len(positions), 3, -1)
    covariance = np.linalg.inv(quadratic_form(slopes) + np.swapaxes(
        by_point, 1, 2) @ region_information(SCENARIO) @ by_point)
    steps = []
    for _ in range(100):
        surface = draw_surface(SCENARIO, rng)
        exact = MeasurementModel(dataclasses.replace(SCENARIO, element_error_rms=0.0), codebook,
                                 surface)
        change = model.whiten(exact.mean(positions)) - mean
        pull = 2 * np.einsum('npr,nr->np', slopes.conj(), change.reshape(len(change), -1)).real
        steps.append(np.matmul(covariance, pull[..., None])[..., 0])
    shares = np.mean(np.square(steps), axis=0) / np.diagonal(covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(constant_shares(model), shares.mean(axis=0), rtol=0.15)


def test_a_track_is_no_better_than_the_errors_that_all_phases_share(codebook):
    estimator = make_estimator('bayes', SCENARIO, codebook)
    rng, place = np.random.default_rng(2), np.array([8.0, 0.5, 0.2])
    tracker, model = Tracker(estimator, Motion()), MeasurementModel(SCENARIO, codebook)
    for time_s in range(8):
        found = tracker.update(time_s, model.sample(place[None], rng)[0])
    constant = found.mixture.constant_covariance
    assert (np.linalg.eigvalsh(constant) > 0).all()
    assert (np.linalg.eigvalsh(found.covariance - constant) > 0).all()
    assert (np.linalg.eigvalsh(tracker.predict(8.0)[1] - constant) > 0).all()
