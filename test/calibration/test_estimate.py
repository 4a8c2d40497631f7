"""Estimates of synthetic surfaces from pilots at known positions."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.calibration import (
    CalibrationWarning,
    Pilots,
    SurfacePrior,
    calibrate,
    estimate,
    report,
)
from rhs_isac_ros.calibration.estimate import initial_values
from rhs_isac_ros.model import ElementErrors, MeasurementModel
from rhs_isac_ros.model.elements import DeclaredElements, SurfaceEstimate
from rhs_isac_ros.model.gaussian import quadratic_form
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.positioning import make_estimator

NUISANCE = [
    {'user_gain_std_db': 1.0}, {'phase_std_rad': 6.2832}, {'band_phase_std_rad': 6.2832},
    {'carrier_offset_std_hz': 1e3, 'timing_std_s': 1e-8, 'band_phase_std_rad': 0.2}]


def excess_energy(scenario, beams, surface, known):
    """Energy of the error of whitened means in the region; noise alone has N_B N_SB F.

    Errors of the gain and phase of a band do not count: nuisance parameters limit their accuracy.
    """
    exact = MeasurementModel(scenario, beams, surface)
    positions = scenario.sample_positions(100, np.random.default_rng(9))
    mean = exact.whiten(exact.mean(positions))
    errors = exact.whiten(MeasurementModel(scenario, beams, known).mean(positions)) - mean
    share = np.sum(mean.conj() * errors, axis=2) / np.sum(np.abs(mean)**2, axis=2)
    return np.mean(np.sum(np.abs(errors - share[..., None] * mean)**2, axis=(1, 2)))


@pytest.mark.parametrize('changes', [{}, *NUISANCE], ids=lambda changes: ' '.join(changes))
def test_a_surface_is_recovered(scenario, beams, damaged, send, changes):
    scenario = dataclasses.replace(scenario, **changes)
    surface = damaged(3)
    found = calibrate(scenario, [send(scenario, beams, surface)]).surface
    np.testing.assert_array_equal(found.failed, ~np.isnan(surface.stuck))
    plain = dataclasses.replace(scenario, element_error_rms=0.0, failed_element_share=0.0)
    assert excess_energy(scenario, beams, surface, found) < 2.0
    assert excess_energy(scenario, beams, surface, None) > 10.0
    assert excess_energy(plain, beams, surface, None) > 10.0


@pytest.mark.slow
def test_deviations_are_those_of_the_errors(scenario, beams, damaged, send, truth):
    """Over several surfaces, the normalised errors of all numbers have unit variance."""
    normalised = []
    for seed in range(8):
        surface = damaged(seed)
        found = calibrate(scenario, [send(scenario, beams, surface, 30, seed)]).surface
        errors = np.concatenate([found.gains, found.offsets]) - truth(surface).ravel()
        std = found.std()[:len(errors)]
        # Offsets of elements that surely work are zero without any uncertainty.
        normalised.append((np.abs(errors) / np.maximum(std, 1e-12))[std > 1e-4])
    assert 0.8 < np.mean(np.concatenate(normalised)**2) < 1.25


def test_repeated_pilots_add_nothing(scenario, beams, damaged, send):
    """The multipath of a user at rest is the same in all cycles."""
    pilots = send(scenario, beams, damaged(3), 10)
    repeated = Pilots(beams, np.repeat(pilots.positions, 6, 0), np.repeat(pilots.received, 6, 0))
    one, six = (calibrate(scenario, [group]).surface for group in (pilots, repeated))
    np.testing.assert_array_equal(six.failed, one.failed)
    np.testing.assert_allclose(six.gains, one.gains, rtol=1e-6)
    np.testing.assert_allclose(six.std(), one.std(), atol=1e-6)


@pytest.mark.parametrize(('change', 'error'), [
    (lambda x, y: (1000 * x, y), r'^positions: .* m outside of the region .* in metres'),
    (lambda x, y: (x, 0 * y), '^received: signals of 0 W in row 0, band 0, expected'),
])
def test_impossible_pilots_are_refused(scenario, beams, send, change, error):
    pilots = send(scenario, beams, None, 5)
    with pytest.raises(ValueError, match=error):
        calibrate(scenario, [Pilots(beams, *change(pilots.positions, pilots.received))])


def test_shifted_positions_cause_a_warning(scenario, beams, damaged, send):
    pilots = send(scenario, beams, damaged(3))
    shifted = Pilots(beams, pilots.positions + [1.0, 0.0, 0.0], pilots.received)
    with pytest.warns(CalibrationWarning, match=r'^positions: \d+ of 60 pilots do not fit'):
        calibration = calibrate(scenario, [shifted])
    (text,) = calibration.about['warnings']
    assert f'warning: {text}' in report(calibration, scenario).splitlines()


def test_without_pilots_the_estimate_is_the_prior(scenario, beams):
    """Mean and covariance of the signals are those that the scenario declares."""
    found = calibrate(scenario, [], SurfacePrior(
        scenario.element_error_rms, scenario.failed_element_share, band_gain_rms=0.0)).surface
    elements = DeclaredElements(scenario)
    np.testing.assert_allclose(
        found.applied(beams.analog), elements.applied(beams.analog), atol=1e-9)
    np.testing.assert_allclose(found.band_gains, 1)
    np.testing.assert_allclose(found.failed_probability, scenario.failed_element_share)
    covariance = found.error_covariance(scenario, beams)
    declared = elements.error_covariance(scenario, beams)
    assert np.abs(covariance - declared).max() < 0.05 * np.abs(declared).max()
    none = Pilots(beams, np.zeros((0, 3)), np.zeros((0, *MeasurementModel(scenario, beams).shape)))
    np.testing.assert_array_equal(
        calibrate(scenario, [none]).surface.gains, calibrate(scenario, []).surface.gains)


def test_gains_and_phases_of_bands_are_estimated(scenario, beams, damaged, send):
    surface, gains = damaged(4), np.array([1.3 * np.exp(0.5j), 0.8 * np.exp(-2.0j)])
    pilots = send(scenario, beams, surface)
    pilots = Pilots(beams, pilots.positions, gains[:, None] * pilots.received)
    found = calibrate(scenario, [pilots]).surface
    std = found.std()[-2:]
    assert (np.abs(found.band_gains / gains - 1) < 4 * std).all()
    assert (std < 0.1).all()
    np.testing.assert_array_equal(found.failed, ~np.isnan(surface.stuck))


def test_an_alignment_starts_at_the_phases_of_the_bands(scenario, beams):
    declared = dataclasses.replace(scenario, band_phase_std_rad=6.2832)
    model, phases = MeasurementModel(declared, beams), np.array([0.9, -2.0])
    mean = model.mean(declared.sample_positions(5, np.random.default_rng(0)))
    signals, nuisance = mean * np.exp(1j * phases)[:, None], nuisance_of(declared)
    values = initial_values(nuisance, model.whiten(signals), model.whiten(mean))
    np.testing.assert_allclose(
        nuisance.divide(signals, values), mean, rtol=0, atol=1e-2 * np.abs(mean).max())


@pytest.mark.parametrize('speed_mps', [0.0, 1.5], ids=['static', 'changing'])
def test_multipath_that_changes_anyway_reveals_no_offset(scenario, beams, speed_mps):
    """The information about an offset is the variance of the score, whatever the multipath."""
    exact = dataclasses.replace(
        scenario, element_error_rms=0.0, failed_element_share=0.0, frame_duration_s=0.015,
        max_user_speed_mps=speed_mps)
    declared = dataclasses.replace(exact, carrier_offset_std_hz=3.0)
    model, nuisance = MeasurementModel(exact, beams), nuisance_of(declared)
    positions = scenario.sample_positions(400, np.random.default_rng(1))
    mean, received = model.mean(positions), model.sample(positions, np.random.default_rng(2))
    share = nuisance.share_of_multipath(model.root, model.whitener)
    score = estimate._gradient(nuisance, received, mean, model.whiten)
    slopes = model.whiten(nuisance.derivatives(received, mean, share))
    information = quadratic_form(slopes.reshape(len(mean), 1, -1))
    assert np.mean(score**2) == pytest.approx(np.mean(information), rel=0.2)
    assert (share == 1) == (speed_mps == 0)


def test_several_codebooks_reveal_more_of_the_elements(scenario, damaged, send, random_beams):
    surface = damaged(5)
    codebooks = [random_beams(scenario, np.random.default_rng(seed)) for seed in range(3)]
    groups = [send(scenario, codebook, surface, 20) for codebook in codebooks]
    alone, together = (calibrate(scenario, some).surface for some in (groups[:1], groups))
    assert together.std()[:25].mean() < 0.8 * alone.std()[:25].mean()


@pytest.mark.slow
def test_estimators_use_the_surface(scenario, beams, damaged, send):
    """With errors close to those of exact knowledge, and consistent covariances.

    An estimator that assumes an ideal surface gives no position for most signals.
    """
    surface = damaged(6)
    estimate = calibrate(scenario, [send(scenario, beams, surface)]).surface
    fresh = send(scenario, beams, surface, 60, seed=7)
    ideal = dataclasses.replace(scenario, element_error_rms=0.0, failed_element_share=0.0)
    assert make_estimator('bayes', ideal, beams).estimate(fresh.received).fix.mean() < 0.5
    squares = {}
    for name, known in (('after', estimate), ('exact', surface)):
        found = make_estimator('bayes', scenario, beams, surface=known).estimate(fresh.received)
        squares[name] = np.sum((found.mean - fresh.positions)**2, axis=1)
        if name == 'after':
            assert found.fix.all()
            trace = np.trace(found.covariance, axis1=1, axis2=2)
            assert 0.6 < squares[name].mean() / trace.mean() < 1.6
    assert squares['after'].mean() < 1.2 * squares['exact'].mean()


def test_a_poor_estimate_has_consistent_errors(scenario, beams, damaged, send):
    """Few pilots leave errors whose covariance depends on the position."""
    surface = damaged(8)
    estimate = calibrate(scenario, [send(scenario, beams, surface, 4)]).surface
    fresh = send(scenario, beams, surface, 60, seed=8)
    model = MeasurementModel(scenario, beams, estimate)
    errors = fresh.received - model.mean(fresh.positions)
    covariance = model.covariance_at(fresh.positions)
    energy = np.einsum('nir,nir->n', errors.conj(),
                       np.linalg.solve(covariance, errors[..., None])[..., 0]).real
    assert 0.5 < energy.mean() / errors[0].size < 1.3
    found = make_estimator('bayes', scenario, beams, surface=estimate).estimate(fresh.received)
    assert found.fix.mean() > 0.95


def test_an_exact_estimate_is_the_surface(scenario, beams, damaged, truth):
    surface = damaged(2)
    gains, offsets = truth(surface)
    exact = SurfaceEstimate(gains, offsets, np.ones(2, complex), np.zeros((52, 0), complex),
                            np.where(np.isnan(surface.stuck), 0.0, 1.0))
    one, other = MeasurementModel(scenario, beams, surface), MeasurementModel(
        scenario, beams, exact)
    np.testing.assert_allclose(one.radiation, other.radiation, rtol=1e-12)
    np.testing.assert_allclose(one.covariance(), other.covariance(), rtol=1e-12)
    assert surface.id != ElementErrors(surface.gains + 1, surface.stuck).id
