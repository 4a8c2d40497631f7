"""The covariance of the multipath from signals at known positions."""

import dataclasses
import runpy
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.calibration import (
    SurveyWarning,
    survey,
)
from rhs_isac_ros.calibration.survey import PLACE_WAVELENGTHS
from rhs_isac_ros.model import ElementErrors, MeasurementModel, Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator

# The multipath of the hall differs from the declared one.
DECLARED = Scenario(elements_per_side=5, n_subbands=4, n_frames=3, n_feeds=2)
FIELDS = {'multipath_to_los_db': -5.0, 'delay_spread_s': 200e-9, 'angular_spread_deg': 30.0}
HALL = dataclasses.replace(DECLARED, **FIELDS)
# The package has a function of the same name.
survey_module = sys.modules['rhs_isac_ros.calibration.survey']
EXAMPLES = Path(__file__).parents[2] / 'docs' / 'examples'
# Squared Mahalanobis radius of the 95 % region.
RADIUS = 7.815


def measured(*arguments):
    """Survey without a warning of few places."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', SurveyWarning)
        return survey(*arguments)


def covered(scenario, beams, positions, received):
    """Share of users with a fix, and share of these in their 95 % region."""
    estimate = make_estimator('bayes', scenario, beams).estimate(received)
    fix = estimate.fix
    errors = (estimate.mean - positions)[fix]
    distances = np.einsum('na,na->n', errors, np.linalg.solve(
        estimate.covariance[fix], errors[..., None])[..., 0])
    return fix.mean(), np.sum(distances <= RADIUS) / max(fix.sum(), 1)


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
        shares[name] = covered(scenario, shipped, positions, received)
    assert shares['measured'][0] >= 0.98
    assert 0.91 <= shares['measured'][1] <= 0.995
    assert min(shares['declared']) < 0.8


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


def test_users_in_sight_with_strong_multipath_take_part(beams):
    """The level of the multipath has a standard deviation of 3 dB among users."""
    positions, received = send(HALL, beams, 60)
    mean = MeasurementModel(HALL, beams).mean(positions)
    levels_db = 3 * np.random.default_rng(2).normal(size=(60, 1, 1))
    estimate = survey(DECLARED, beams, positions, mean + (received - mean) * 10**(levels_db / 20))
    assert estimate.about['blocked'] == 0
    assert estimate.about['level_std_db'] > 2


def test_impairments_are_estimated_with_the_multipath(beams):
    """The region has no extent along z."""
    impaired = {'user_gain_std_db': 3.0, 'phase_std_rad': 6.2832, 'timing_std_s': 5e-9,
                'roi_size_m': (10.0, 10.0, 0.0)}
    declared, hall = (dataclasses.replace(one, **impaired) for one in (DECLARED, HALL))
    estimate = survey(declared, beams, *send(hall, beams, 60))
    assert estimate.multipath_to_los_db == pytest.approx(-5, abs=2)
    assert estimate.delay_spread_s == pytest.approx(200e-9, rel=0.4)
    assert estimate.about['coverage'][0] > 0.9
    positions, received = send(hall, beams, 60, 2)
    errors = []
    for scenario in (dataclasses.replace(declared, multipath=estimate), hall):
        fixes = make_estimator('bayes', scenario, beams).estimate(received)
        assert fixes.fix.mean() > 0.95
        errors.append(np.median(np.linalg.norm(fixes.mean - positions, axis=1)))
    assert errors[0] < 1.1 * errors[1]


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


def test_one_position_yields_nearly_the_fields_and_a_warning(beams):
    with pytest.warns(SurveyWarning, match='expected at least 20'):
        estimate = survey(DECLARED, beams, *send(HALL, beams, 1))
    few, *spans = estimate.about['warnings']
    assert few.startswith('positions: 1,')
    assert 'along y, expected at least half of the 10 m of the region' in spans[-2]
    assert np.isfinite(estimate.excess).all()
    assert 1.2 < estimate.about['inflation'] < 2


def test_repeated_signals_add_nothing(beams):
    """A survey of 10 places whose signals were recorded six times is one of 10 places."""
    positions, received = send(HALL, beams, 10)
    estimates = []
    for n in (1, 6):
        places = np.repeat(positions, n, axis=0)
        offsets = np.random.default_rng(0).uniform(-0.05, 0.05, places.shape)
        residuals = received - MeasurementModel(HALL, beams).mean(positions)
        signals = np.repeat(residuals, n, axis=0) + MeasurementModel(HALL, beams).mean(
            places + offsets)
        with pytest.warns(SurveyWarning, match='positions: 10, expected at least 20'):
            estimates.append(survey(DECLARED, beams, places + offsets, signals))
    one, six = estimates
    assert (one.about['positions'], six.about['positions']) == (10, 60)
    assert six.about['places'] == 10
    # Errors, but not the covariance without inflation, depend on the positions.
    for name in ('coverage', 'level_std_db', 'prior_weight'):
        assert six.about[name] == pytest.approx(one.about[name], rel=1e-6), name
    assert six.about['inflation'] == pytest.approx(
        one.about['inflation'], rel=0.1)


def test_a_walk_is_divided_into_places(shipped, monkeypatch):
    """Positions 3 cm apart, in a hall whose paths do not fade."""
    trace = runpy.run_path(str(EXAMPLES / 'box_hall.py'))['trace']
    rng, declared = np.random.default_rng(2), Scenario()

    def receive(positions):
        channel = dataclasses.replace(declared, channel=trace(positions))
        return simulate_received(channel, shipped, positions, rng)

    corners = declared.sample_positions(5, rng)
    lengths = np.cumsum([0.0, *np.linalg.norm(np.diff(corners, axis=0), axis=1)])
    route = np.transpose([np.interp(0.03 * np.arange(300), lengths, axis) for axis in corners.T])
    users, signals = declared.sample_positions(150, rng), receive(route)
    located = receive(users)
    shares = []
    for wavelengths in (PLACE_WAVELENGTHS, 1e-9):
        monkeypatch.setattr(survey_module, 'PLACE_WAVELENGTHS', wavelengths)
        shares.append(covered(
            dataclasses.replace(declared, multipath=measured(declared, shipped, route, signals)),
            shipped, users, located))
    assert min(shares[0]) > 0.93
    assert shares[1][1] < 0.85


def test_shifted_positions_cause_a_warning(beams):
    positions, received = send(HALL, beams, 60)
    with pytest.warns(SurveyWarning, match=r'positions: \d+ of 60 do not fit a direct path'):
        survey(DECLARED, beams, positions + [0.0, 1.0, 0.0], received)


def test_a_declared_share_of_blocked_users_causes_no_warning(beams):
    positions, received = send(HALL, beams, 60)
    model = MeasurementModel(HALL, beams)
    received[::2] -= model.mean(positions[::2])
    declared = dataclasses.replace(DECLARED, blocked_probability=0.5)
    assert survey(declared, beams, positions, received).about['blocked'] == 30


@pytest.mark.parametrize('scale', [1000.0, 100.0, 1 / 0.3048])
def test_positions_in_other_units_are_refused(beams, scale):
    positions, received = send(HALL, beams, 30)
    with pytest.raises(ValueError, match=r'^positions: .* m outside of the region .* in metres'):
        survey(DECLARED, beams, scale * positions, received)


def test_signals_that_no_receiver_measures_are_refused(beams):
    positions, received = send(HALL, beams, 30)
    received[7, 1] = 0
    with pytest.raises(ValueError, match='^received: signals of 0 W in row 7, band 1, expected'):
        survey(DECLARED, beams, positions, received)
    noiseless = MeasurementModel(HALL, beams).mean(positions)
    with pytest.raises(ValueError, match='^received: residuals of .* W in row .* with noise'):
        survey(DECLARED, beams, positions, noiseless)


def test_signals_of_other_positions_are_refused(beams):
    """Half a wavelength makes the multipath alone more probable at all positions."""
    positions, received = send(HALL, beams, 30)
    quiet = MeasurementModel(HALL, beams).mean(positions) + 1e-3 * received
    with pytest.raises(ValueError, match='^positions: no direct path at any of 30, expected'):
        survey(DECLARED, beams, positions + [0.06, 0.0, 0.0], quiet)


def test_invalid_arrays_are_refused(beams):
    positions, received = send(HALL, beams, 5)
    for arrays, error in (((positions[:0], received[:0]), 'positions: none given'),
                          ((positions, received[:, :1]), 'received: shape'),
                          ((positions, received * np.nan), 'received: not finite')):
        with pytest.raises(ValueError, match=error):
            survey(DECLARED, beams, *arrays)
