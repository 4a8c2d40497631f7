"""The covariance of the multipath from signals at known positions."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.calibration import (
    Pilots,
    SurveyWarning,
    calibrate,
    load_surface,
    survey,
    survey_report,
)
from rhs_isac_ros.model import ElementErrors, MeasurementModel, Scenario
from rhs_isac_ros.positioning import make_estimator

# The multipath of the hall differs from the declared one.
DECLARED = Scenario(elements_per_side=5, n_subbands=4, n_frames=3, n_feeds=2)
FIELDS = {'multipath_to_los_db': -5.0, 'delay_spread_s': 200e-9, 'angular_spread_deg': 30.0}
HALL = dataclasses.replace(DECLARED, **FIELDS)
# Squared Mahalanobis radius of the 95 % region.
RADIUS = 7.815


def send(scenario, beams, n, seed=1):
    rng = np.random.default_rng(seed)
    positions = scenario.sample_positions(n, rng)
    return positions, MeasurementModel(scenario, beams).sample(positions, rng)


@pytest.fixture(scope='module')
def beams(random_beams):
    return random_beams(DECLARED, np.random.default_rng(0))


@pytest.fixture(scope='module')
def estimate(beams):
    """Also a test that a survey of the whole region causes no warning, which is an error here."""
    return survey(DECLARED, beams, *send(HALL, beams, 100))


def test_fields_are_those_of_the_hall(estimate):
    assert estimate.multipath_to_los_db == pytest.approx(-5, abs=1)
    assert estimate.delay_spread_s == pytest.approx(200e-9, rel=0.2)
    assert estimate.angular_spread_deg == pytest.approx(30, rel=0.2)
    # The fields describe this hall well, so that they weigh more than the sample.
    assert estimate.about['prior_weight'] > 200


def test_the_covariance_is_that_of_the_hall(estimate, beams):
    measured = MeasurementModel(dataclasses.replace(DECLARED, multipath=estimate), beams)
    true = MeasurementModel(HALL, beams)
    white = true.whitener @ measured.covariance() @ np.conj(np.swapaxes(true.whitener, 1, 2))
    values = np.linalg.eigvalsh(white) / estimate.about['inflation']
    assert 0.6 < values.min() and values.max() < 1.6
    assert 1 <= estimate.about['inflation'] < 1.4


def test_the_report_lists_what_was_found(estimate):
    text = survey_report(estimate)
    assert text.startswith('100 positions, 0 more without a direct path, codebook ')
    assert 'in the 95 % region' in text
    assert 'warning' not in text


@pytest.mark.slow
def test_estimates_after_a_survey_are_in_their_regions(shipped):
    """Directions of arrival that no fields describe, learnt from 100 positions."""
    rng, declared = np.random.default_rng(4), Scenario()
    hall = dataclasses.replace(declared, **FIELDS | {'delay_spread_s': 50e-9})
    model = MeasurementModel(declared, shipped)
    directions = 0.03 * rng.normal(size=(2, 2, model.radiation.shape[2], 2)) @ [1, 1j]
    paths = np.einsum('irm,ipm->ipr', model.radiation, directions) * 5e-3

    def receive(n, seed):
        positions, received = send(hall, shipped, n, seed)
        gains = np.random.default_rng(seed + 1).normal(size=(n, 2, 2)) @ [1, 1j]
        return positions, received + np.einsum('np,ipr->nir', gains, paths)

    positions, received = receive(200, 11)
    shares = {}
    for name, scenario in {
            'declared': declared,
            'measured': dataclasses.replace(
                declared, multipath=survey(declared, shipped, *receive(100, 7)))}.items():
        estimate = make_estimator('bayes', scenario, shipped).estimate(received)
        fix = estimate.fix
        errors = (estimate.mean - positions)[fix]
        distances = np.einsum('na,na->n', errors, np.linalg.solve(
            estimate.covariance[fix], errors[..., None])[..., 0])
        shares[name] = fix.mean(), np.sum(distances <= RADIUS) / max(fix.sum(), 1)
    assert shares['measured'][0] >= 0.98
    assert 0.91 <= shares['measured'][1] <= 0.995
    assert min(shares['declared']) < 0.8


@pytest.mark.slow
def test_positions_behind_obstacles_are_left_out(beams):
    """A third of the positions receives multipath alone, 6 dB weaker than that of the others."""
    positions, received = send(HALL, beams, 30)
    model = MeasurementModel(HALL, beams)
    received[::3] = (received[::3] - model.mean(positions[::3])) / 2
    estimate = survey(DECLARED, beams, positions, received)
    assert estimate.about['blocked'] == 10
    seen = np.arange(30) % 3 > 0
    alone = survey(DECLARED, beams, positions[seen], received[seen])
    np.testing.assert_allclose(
        estimate.excess, alone.excess, atol=1e-3 * np.abs(alone.excess).max())


@pytest.mark.slow
def test_users_in_sight_with_strong_multipath_take_part(beams):
    """The level of the multipath has a standard deviation of 3 dB among users."""
    positions, received = send(HALL, beams, 60)
    mean = MeasurementModel(HALL, beams).mean(positions)
    levels_db = 3 * np.random.default_rng(2).normal(size=(60, 1, 1))
    estimate = survey(DECLARED, beams, positions, mean + (received - mean) * 10**(levels_db / 20))
    assert estimate.about['blocked'] == 0
    assert estimate.about['level_std_db'] > 2


@pytest.mark.slow
def test_impairments_are_estimated_with_the_multipath(beams):
    impaired = {'user_gain_std_db': 3.0, 'phase_std_rad': 6.2832, 'timing_std_s': 5e-9}
    declared, hall = (dataclasses.replace(one, **impaired) for one in (DECLARED, HALL))
    estimate = survey(declared, beams, *send(hall, beams, 60))
    assert estimate.multipath_to_los_db == pytest.approx(-5, abs=2)
    assert estimate.delay_spread_s == pytest.approx(200e-9, rel=0.4)
    positions, received = send(hall, beams, 60, 2)
    errors = []
    for scenario in (dataclasses.replace(declared, multipath=estimate), hall):
        fixes = make_estimator('bayes', scenario, beams).estimate(received)
        assert fixes.fix.mean() > 0.95
        errors.append(np.median(np.linalg.norm(fixes.mean - positions, axis=1)))
    assert errors[0] < 1.1 * errors[1]


@pytest.mark.slow
def test_users_with_a_random_phase_at_one_height(beams):
    """The region has no extent along z, and the phase of a user is a nuisance parameter."""
    declared, hall = (dataclasses.replace(
        one, phase_std_rad=1.0, roi_size_m=(10.0, 10.0, 0.0)) for one in (DECLARED, HALL))
    estimate = survey(declared, beams, *send(hall, beams, 40))
    assert estimate.multipath_to_los_db == pytest.approx(-5, abs=2)
    assert estimate.about['coverage'][0] > 0.9


@pytest.mark.slow
def test_a_calibrated_surface_takes_part(beams):
    """A gain of a band is not multipath if the surface explains it."""
    rng = np.random.default_rng(0)
    gains = 1 + 0.3 * rng.normal(size=(25, 2)) @ [1, 1j]
    surface = ElementErrors(gains, np.full(25, np.nan))
    positions = HALL.sample_positions(25, rng)
    received = MeasurementModel(HALL, beams, surface).sample(positions, rng)
    levels = [survey(DECLARED, beams, positions, received, known).multipath_to_los_db
              for known in (surface, None)]
    assert levels[0] == pytest.approx(-5, abs=1.5)
    assert levels[1] > levels[0] + 1


def test_a_calibration_holds_in_every_hall(estimate, beams, tmp_path):
    calibrate(DECLARED, [Pilots(beams, *send(DECLARED, beams, 5))]).save(tmp_path / 's.npz')
    measured = dataclasses.replace(DECLARED, multipath=estimate)
    surface = load_surface(str(tmp_path / 's.npz'), measured)
    assert make_estimator('bayes', measured, beams, surface=surface).surface is surface


@pytest.mark.slow
def test_one_position_yields_nearly_the_fields_and_a_warning(beams):
    with pytest.warns(SurveyWarning, match='expected at least 20'):
        estimate = survey(DECLARED, beams, *send(HALL, beams, 1))
    assert 'positions: 1' in estimate.about['warnings'][0]
    assert np.isfinite(estimate.excess).all()
    assert 1.2 < estimate.about['inflation'] < 2


@pytest.mark.slow
def test_a_survey_in_a_corner_causes_a_warning(beams):
    positions, received = send(HALL, beams, 120)
    corner = (positions[:, 1] < -2)
    with pytest.warns(SurveyWarning, match='along y, expected at least half of the 10 m'):
        estimate = survey(DECLARED, beams, positions[corner], received[corner])
    assert len(estimate.about['warnings']) == 1


def test_invalid_arrays_are_refused(beams):
    positions, received = send(HALL, beams, 5)
    with pytest.raises(ValueError, match='positions: none given'):
        survey(DECLARED, beams, positions[:0], received[:0])
    with pytest.raises(ValueError, match='received: shape'):
        survey(DECLARED, beams, positions, received[:, :1])
    with pytest.raises(ValueError, match='received: not finite'):
        survey(DECLARED, beams, positions, received * np.nan)
