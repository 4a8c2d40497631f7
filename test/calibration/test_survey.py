"""The covariance of the multipath from signals at known positions."""

import dataclasses
import warnings

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

# The multipath of the hall differs from that of Table I, which is declared.
DECLARED = Scenario()
HALL = Scenario(multipath_to_los_db=-5.0, delay_spread_s=50e-9, angular_spread_deg=30.0)
# Squared Mahalanobis radius of the 95 % region.
RADIUS = 7.815


def send(scenario, beams, n, seed=1):
    rng = np.random.default_rng(seed)
    positions = scenario.sample_positions(n, rng)
    return positions, MeasurementModel(scenario, beams).sample(positions, rng)


@pytest.fixture(scope='module')
def estimate(shipped):
    return survey(DECLARED, shipped, *send(HALL, shipped, 100))


def test_fields_are_those_of_the_hall(estimate):
    assert estimate.multipath_to_los_db == pytest.approx(-5, abs=1)
    assert estimate.delay_spread_s == pytest.approx(50e-9, rel=0.2)
    assert estimate.angular_spread_deg == pytest.approx(30, rel=0.2)
    # The fields describe this hall well, so that they weigh more than the sample.
    assert estimate.about['prior_weight'] > 200


def test_the_covariance_is_that_of_the_hall(estimate, shipped):
    measured = MeasurementModel(dataclasses.replace(DECLARED, multipath=estimate), shipped)
    true = MeasurementModel(HALL, shipped)
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
    rng = np.random.default_rng(4)
    model = MeasurementModel(DECLARED, shipped)
    directions = 0.03 * rng.normal(size=(2, 2, model.radiation.shape[2], 2)) @ [1, 1j]
    paths = np.einsum('irm,ipm->ipr', model.radiation, directions) * 5e-3

    def receive(n, seed):
        positions, received = send(HALL, shipped, n, seed)
        gains = np.random.default_rng(seed + 1).normal(size=(n, 2, 2)) @ [1, 1j]
        return positions, received + np.einsum('np,ipr->nir', gains, paths)

    positions, received = receive(200, 11)
    shares = {}
    for name, scenario in {
            'declared': DECLARED,
            'measured': dataclasses.replace(
                DECLARED, multipath=survey(DECLARED, shipped, *receive(100, 7)))}.items():
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
def test_positions_behind_obstacles_are_left_out(shipped):
    """A third of the positions receives multipath alone, 6 dB weaker than that of the others."""
    positions, received = send(HALL, shipped, 60)
    model = MeasurementModel(HALL, shipped)
    received[::3] = (received[::3] - model.mean(positions[::3])) / 2
    estimate = survey(DECLARED, shipped, positions, received)
    assert estimate.about['blocked'] == 20
    seen = np.arange(60) % 3 > 0
    alone = survey(DECLARED, shipped, positions[seen], received[seen])
    np.testing.assert_allclose(estimate.excess, alone.excess, rtol=0.2,
                               atol=0.05 * np.abs(alone.excess).max())


@pytest.mark.slow
def test_impairments_are_estimated_with_the_multipath(shipped):
    impaired = {'user_gain_std_db': 3.0, 'phase_std_rad': 6.2832, 'timing_std_s': 5e-9}
    declared, hall = (dataclasses.replace(one, **impaired) for one in (DECLARED, HALL))
    estimate = survey(declared, shipped, *send(hall, shipped, 60))
    assert estimate.multipath_to_los_db == pytest.approx(-5, abs=2)
    assert estimate.delay_spread_s == pytest.approx(50e-9, rel=0.4)
    measured = dataclasses.replace(declared, multipath=estimate)
    positions, received = send(hall, shipped, 60, 2)
    fixes = make_estimator('bayes', measured, shipped).estimate(received)
    errors = np.linalg.norm(fixes.mean - positions, axis=1)[fixes.fix]
    assert fixes.fix.mean() > 0.95
    assert np.median(errors) < 1.0


@pytest.mark.slow
def test_a_calibrated_surface_takes_part(shipped):
    """A gain of a band is not multipath if the surface explains it."""
    rng = np.random.default_rng(0)
    gains = 1 + 0.2 * rng.normal(size=(100, 2)) @ [1, 1j]
    surface = ElementErrors(gains, np.full(100, np.nan))
    positions = HALL.sample_positions(40, rng)
    received = MeasurementModel(HALL, shipped, surface).sample(positions, rng)
    levels = [survey(DECLARED, shipped, positions, received, known).multipath_to_los_db
              for known in (surface, None)]
    assert levels[0] == pytest.approx(-5, abs=1.5)
    assert levels[1] > levels[0] + 1


def test_a_calibration_holds_in_every_hall(estimate, shipped, tmp_path):
    calibrate(DECLARED, [Pilots(shipped, *send(DECLARED, shipped, 5))]).save(tmp_path / 's.npz')
    measured = dataclasses.replace(DECLARED, multipath=estimate)
    surface = load_surface(str(tmp_path / 's.npz'), measured)
    assert make_estimator('bayes', measured, shipped, surface=surface).surface is surface


@pytest.mark.slow
@pytest.mark.parametrize('n', [1, 3])
def test_few_positions_yield_nearly_the_fields_and_a_warning(shipped, n):
    with pytest.warns(SurveyWarning, match='expected at least 20'):
        estimate = survey(DECLARED, shipped, *send(HALL, shipped, n))
    assert f'positions: {n}' in estimate.about['warnings'][0]
    assert np.isfinite(estimate.excess).all()
    assert 1.2 < estimate.about['inflation'] < 2


@pytest.mark.slow
def test_a_survey_in_a_corner_causes_a_warning(shipped):
    positions, received = send(HALL, shipped, 200)
    corner = (positions[:, 1] < -2)
    with pytest.warns(SurveyWarning, match='along y, expected at least half of the 10 m'):
        estimate = survey(DECLARED, shipped, positions[corner], received[corner])
    assert len(estimate.about['warnings']) == 1


@pytest.mark.slow
def test_a_survey_of_the_region_causes_none(shipped):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        survey(DECLARED, shipped, *send(HALL, shipped, 30))


def test_invalid_arrays_are_refused(shipped):
    positions, received = send(HALL, shipped, 5)
    with pytest.raises(ValueError, match='positions: none given'):
        survey(DECLARED, shipped, positions[:0], received[:0])
    with pytest.raises(ValueError, match='received: shape'):
        survey(DECLARED, shipped, positions, received[:, :1])
    with pytest.raises(ValueError, match='received: not finite'):
        survey(DECLARED, shipped, positions, received * np.nan)
