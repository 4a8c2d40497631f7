"""Estimators that search for the modes of the posterior: its moments, its maximum, its modes."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import chdtri
from scipy.stats import qmc

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario, ScenarioError, simulate_received
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.positioning import Tracker, make_estimator
from rhs_isac_ros.system import System

# Little scattering and three bands, which leave a single mode.
SINGLE_MODE = Scenario(
    center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))


@pytest.fixture(scope='module')
def table1_estimates(table1_estimator, shipped):
    """Signals from 200 positions of Table I, and their estimates."""
    scenario, rng = Scenario(), np.random.default_rng(0)
    positions = scenario.sample_positions(200, rng)
    received = simulate_received(scenario, shipped, positions, rng)
    return positions, received, table1_estimator.estimate(received)


def squared_normalised(errors, covariances):
    return np.einsum('nu,nu->n', errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def test_the_covariance_describes_the_errors_on_table_1(table1_estimates):
    """The squared normalised error of three coordinates is 3 on average."""
    positions, _, estimate = table1_estimates
    errors = estimate.mean - positions
    assert np.mean(np.sum(errors**2, axis=1)) < 1.35
    assert 2 < squared_normalised(errors, estimate.covariance).mean() < 4.5
    # The mean of 200 errors without bias stays within this limit.
    assert (np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(200)).all()
    low, high = Scenario().roi_bounds_m
    assert ((estimate.mean >= low) & (estimate.mean <= high)).all()


def test_modes_outside_the_region_do_not_hide_those_inside(table1):
    """In this phase, the likelihood is e^10 times higher 1.7 m below the region than at the truth.

    An estimator that loses the modes inside the region returns a position 5 m away, with a
    standard deviation of millimetres.
    """
    rng = np.random.default_rng(17)
    positions = table1.scenario.sample_positions(200, rng)
    received = simulate_received(table1.scenario, table1.codebook, positions, rng)[83]
    estimate = make_estimator('bayes', table1.scenario, table1.codebook).estimate(received)
    error = estimate.mean - positions[83]
    assert squared_normalised(error[None], estimate.covariance[None])[0] < 100


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SINGLE_MODE, np.random.default_rng(1))


@pytest.fixture(scope='module')
def single_mode(codebook):
    return SINGLE_MODE, codebook, make_estimator('bayes', SINGLE_MODE, codebook)


def test_strong_signals_give_accurate_positions(single_mode):
    scenario, codebook, estimator = single_mode
    rng = np.random.default_rng(2)
    positions = scenario.sample_positions(40, rng)
    received = simulate_received(scenario, codebook, positions, rng)
    estimate = estimator.estimate(received)
    errors = estimate.mean - positions
    assert np.linalg.norm(errors, axis=1).max() < 0.1
    assert 1.5 < squared_normalised(errors, estimate.covariance).mean() < 5
    noiseless = estimator.estimate(MeasurementModel(scenario, codebook).mean(positions))
    assert np.linalg.norm(noiseless.mean - positions, axis=1).max() < 0.02


def test_a_position_just_outside_the_region_gives_one_inside(single_mode):
    scenario, codebook, estimator = single_mode
    low, high = scenario.roi_bounds_m
    outside = np.array([[4.0, 0.0, high[2] + 0.01], [4.0, low[1] - 0.01, 0.0]] * 5)
    received = simulate_received(scenario, codebook, outside, np.random.default_rng(3))
    estimate = estimator.estimate(received)
    assert estimate.fix.all()
    assert np.linalg.norm(estimate.mean - outside, axis=1).max() < 0.1
    assert (estimate.mean >= low - 1e-9).all()
    assert (estimate.mean <= high + 1e-9).all()
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0


def test_moments_match_a_brute_force_posterior(plain, random_beams):
    """The reference weights 65 536 points of a small region with the plain likelihood.

    The estimator approximates every mode by a Gaussian, so that single phases differ. Over 40
    phases, mean and variance must be close to those of the posterior.
    """
    scenario = Scenario(n_subbands=2, elements_per_side=4, roi_center_m=(4, 0, 0),
                        roi_size_m=(1, 1, 0.5))
    rng = np.random.default_rng(1)
    codebook = random_beams(scenario, rng)
    received = simulate_received(scenario, codebook, scenario.sample_positions(40, rng), rng)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)

    p = plain(scenario, codebook.analog, codebook.digital)
    points = qmc.Sobol(3, seed=5).random(2**16) * [1, 1, 0.5] + [3.5, -0.5, -0.25]
    spatial = multipath_covariance(scenario)
    log_likelihood = np.zeros((40, 2**16))
    for band in range(2):
        means = p.mean(points, band)
        solved = np.linalg.solve(p.covariance(band, spatial[band]), means.T).T
        energy = np.sum(means.conj() * solved, axis=1).real
        log_likelihood += 2 * (received[:, band] @ solved.conj().T).real - energy
    weights = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    means = weights @ points
    covariances = np.array([np.cov(points.T, aweights=w, ddof=0) for w in weights])

    variance = np.trace(covariances, axis1=1, axis2=2)
    estimated_variance = np.trace(estimate.covariance, axis1=1, axis2=2)
    excess = np.sum((estimate.mean - means)**2, axis=1)
    assert excess.mean() < 0.12 * variance.mean()
    assert 0.85 < estimated_variance.mean() / variance.mean() < 1.15
    # A mode that is kept or left out changes a few of the variances by more than a factor of two.
    assert np.mean(np.abs(np.log2(estimated_variance / variance)) < 1) >= 0.9
    # Entries of the mean covariance are compared in units of the standard deviations.
    expected = covariances.mean(axis=0)
    deviation = np.sqrt(np.diag(expected))
    difference = (estimate.covariance.mean(axis=0) - expected) / np.outer(deviation, deviation)
    assert np.abs(difference).max() < 0.2


def share_covered(estimate, positions) -> float:
    """Share of the phases whose 95 % region contains the user; no fix contains none."""
    errors = (estimate.mean - positions)[estimate.fix]
    normalised = squared_normalised(errors, estimate.covariance[estimate.fix])
    return np.sum(normalised <= 7.815) / len(positions)


@pytest.mark.parametrize('changes', [
    {'user_gain_std_db': 3.0}, {'carrier_offset_std_hz': 2e3}, {'timing_std_s': 5e-8},
    {'phase_std_rad': 7.0}, {'band_phase_std_rad': 0.2},
    {'user_gain_std_db': 1.0, 'phase_std_rad': 0.5, 'carrier_offset_std_hz': 1e3},
    {'element_error_rms': 0.02},
    {'carrier_offset_std_hz': 'unknown', 'phase_std_rad': 'unknown', 'timing_std_s': 'unknown'},
], ids=lambda changes: ' '.join(changes))
def test_declared_impairments_leave_consistent_estimates(single_mode, codebook, changes):
    """Undeclared, many of these signals have no fix or a wrong one."""
    scenario, rng = dataclasses.replace(SINGLE_MODE, **changes), np.random.default_rng(2)
    positions = scenario.sample_positions(25, rng)
    received = MeasurementModel(scenario, codebook).sample(positions, rng)
    silent = single_mode[2].estimate(received)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)
    assert share_covered(silent, positions) < 0.8
    assert share_covered(estimate, positions) >= 0.88
    assert estimate.fix.all()
    assert 75 < np.median(estimate.residual) < 110


def test_an_unknown_gain_needs_no_prior(codebook):
    """Not even one that contains the gain, with or without other explanations of the signals."""
    sent = dataclasses.replace(SINGLE_MODE, user_gain=30.0)
    unknown = dataclasses.replace(
        SINGLE_MODE, user_gain_std_db='unknown', blocked_probability=0.1)
    positions = unknown.sample_positions(25, np.random.default_rng(2))
    received = MeasurementModel(sent, codebook).sample(positions, np.random.default_rng(3))
    for reject_outside in (False, True):
        estimate = make_estimator(
            'bayes', unknown, codebook, reject_outside=reject_outside).estimate(received)
        assert estimate.fix.all()
        assert share_covered(estimate, positions) >= 0.88
        assert np.nanmax(estimate.blocked_probability) < 0.05


def test_a_weak_user_keeps_all_modes(shipped):
    """Divided by the low gain, the noise exceeds that for which the grid is computed."""
    declared = Scenario(multipath_to_los_db=-20.0, user_gain_std_db=6.0)
    sent = dataclasses.replace(
        declared, user_gain_std_db=0.0, user_gain=declared.user_gain * 10**-0.85)
    positions = sent.sample_positions(40, np.random.default_rng(1))
    received = MeasurementModel(sent, shipped).sample(positions, np.random.default_rng(2))
    estimate = make_estimator('bayes', declared, shipped).estimate(received)
    squares = squared_normalised(estimate.mean - positions, estimate.covariance)
    assert squares.max() < 30 and squares.mean() < 5


def test_an_unknown_timing_requires_an_unknown_phase(codebook):
    with pytest.raises(ScenarioError, match='^timing_std_s: unknown, expected an unknown phase'):
        make_estimator(
            'bayes', dataclasses.replace(SINGLE_MODE, timing_std_s='unknown'), codebook)


@pytest.mark.parametrize('std', [1e-300, 1e-12])
def test_negligible_impairments_change_no_estimate(single_mode, codebook, std):
    scenario = dataclasses.replace(
        SINGLE_MODE, user_gain_std_db=std, timing_std_s=std * 1e-7, band_phase_std_rad=std)
    rng = np.random.default_rng(2)
    positions = SINGLE_MODE.sample_positions(5, rng)
    received = MeasurementModel(SINGLE_MODE, codebook).sample(positions, rng)
    expected = single_mode[2].estimate(received)
    found = make_estimator('bayes', scenario, codebook).estimate(received)
    np.testing.assert_allclose(found.mean, expected.mean, atol=0.02)
    np.testing.assert_allclose(found.residual, expected.residual, rtol=0.02)


@pytest.fixture(scope='module')
def strong(random_beams):
    """Positions and signals with a single mode, of few sub-bands."""
    scenario = dataclasses.replace(SINGLE_MODE, n_subbands=2)
    codebook = random_beams(scenario, np.random.default_rng(1))
    positions, received = System(scenario, codebook).pairs(8, 0)
    return scenario, codebook, positions, received


def test_no_position_nearby_is_more_likely(strong, plain):
    """A search with the plain likelihood, from the true position, ends at the estimate."""
    scenario, codebook, positions, received = strong
    estimate = make_estimator('ml', scenario, codebook).estimate(received)
    p, spatial = plain(scenario, codebook.analog, codebook.digital), multipath_covariance(scenario)
    covariances = [p.covariance(band, spatial[band]) for band in range(3)]

    def square_residual(position, signals):
        residuals = [signals[band] - p.mean(position, band) for band in range(3)]
        return sum((r.conj() @ np.linalg.solve(c, r)).real
                   for r, c in zip(residuals, covariances, strict=True))

    low, high = scenario.roi_bounds_m
    for n in range(4):
        found = minimize(square_residual, positions[n], args=(received[n],),
                         method='Nelder-Mead', bounds=list(zip(low, high, strict=True)),
                         options={'xatol': 1e-5, 'fatol': 1e-6})
        deviation = np.sqrt(np.trace(estimate.covariance[n]))
        assert np.linalg.norm(estimate.mean[n] - found.x) < 0.1 * deviation
        assert square_residual(estimate.mean[n], received[n]) < found.fun + 0.02


def test_the_covariance_is_the_inverse_information_at_the_estimate(strong):
    scenario, codebook, _, received = strong
    estimate = make_estimator('ml', scenario, codebook).estimate(received)
    model = MeasurementModel(scenario, codebook)
    expected = np.linalg.inv(fisher_information(model, estimate.mean))
    for found, bound in zip(estimate.covariance, expected, strict=True):
        np.testing.assert_allclose(found, bound, atol=0.15 * np.trace(bound))


def test_a_single_mode_is_not_enough_for_table_1(table1_estimator, shipped):
    """The errors exceed those of the posterior mean, as the covariances state."""
    positions, received = System(Scenario(), shipped).pairs(60, 2)
    estimator = make_estimator('ml', Scenario(), shipped)
    ml, mean = estimator.estimate(received), table1_estimator.estimate(received)
    errors = [np.sum((e.mean - positions)**2, axis=1) for e in (ml, mean)]
    assert errors[0].mean() > 1.2 * errors[1].mean()
    assert errors[0].mean() == pytest.approx(
        np.trace(ml.covariance, axis1=1, axis2=2).mean(), rel=0.4)
    # Both are points of one posterior.
    mixture = estimator.posterior(received[0]).mixture
    np.testing.assert_allclose(mixture.moments()[0], mean.mean[0], atol=1e-6)


@pytest.fixture(scope='module')
def phases(shipped):
    rng = np.random.default_rng(5)
    positions = Scenario().sample_positions(12, rng)
    return simulate_received(Scenario(), shipped, positions, rng)


def test_the_mixture_has_the_moments_of_the_estimate(table1_estimator, phases):
    for received in phases:
        estimate, found = table1_estimator.estimate(received), table1_estimator.posterior(received)
        assert (np.diff(found.mixture.log_weights) <= 0).all()
        assert found.mixture.log_mass == pytest.approx(0, abs=1e-12)
        mean, covariance = found.mixture.moments()
        for one in (estimate, found):
            np.testing.assert_allclose(mean, one.mean, atol=1e-9)
            np.testing.assert_allclose(covariance, one.covariance, atol=1e-9)


def test_the_modes_are_the_range_ambiguities_of_the_bands(table1_estimator, phases):
    """Two bands 0.5 GHz apart repeat every 0.6 m; single bands every 0.1 m."""
    gaps = []
    for received in phases:
        modes = table1_estimator.posterior(received).mixture
        ranges = np.sort(np.linalg.norm(modes.means[modes.probabilities > 0.05], axis=1))
        gaps += np.diff(ranges).tolist()
    assert np.median([gap for gap in gaps if gap > 0.3]) == pytest.approx(0.6, abs=0.06)


def test_posteriors_of_several_shots_are_those_of_each(table1_estimator, phases):
    received = np.concatenate([phases[:3], np.zeros_like(phases[:1])])
    found = table1_estimator.posterior(received)
    assert found.fix.tolist() == [True, True, True, False]
    for n, one in enumerate(received):
        alone = table1_estimator.posterior(one)
        assert found[n].fix == alone.fix
        if alone.fix:
            np.testing.assert_allclose(found[n].mean, alone.mean, rtol=0, atol=1e-9)
            np.testing.assert_allclose(
                found[n].mixture.moments()[1], alone.covariance, rtol=0, atol=1e-9)
    assert found[3].mixture is None


def test_fewer_modes_are_left_out_for_other_surfaces(random_beams):
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9), n_subbands=4, n_frames=2, elements_per_side=6,
        carrier_offset_std_hz=200.0)
    codebook, rng = random_beams(scenario, np.random.default_rng(0)), np.random.default_rng(1)
    received = simulate_received(scenario, codebook, scenario.sample_positions(20, rng), rng)
    usual, more = (make_estimator('bayes', scenario, codebook, **options).posterior(received)
                   for options in ({}, {'left_out': 1e-6}))
    # Most estimates differ by less than a tenth of their standard deviation.
    offsets = more.mean - usual.mean
    assert np.mean(squared_normalised(offsets, usual.covariance) < 0.1**2) >= 0.8
    few, many = (np.array([len(one[n].sighting.likelihood.means) for n in range(20)])
                 for one in (usual, more))
    assert (many >= few).all() and many.sum() > 1.3 * few.sum()
    with pytest.raises(ValueError, match='left_out: 0.1, expected'):
        make_estimator('bayes', scenario, codebook, left_out=0.1)


def test_a_region_far_shorter_than_the_wavelength_has_a_mode_for_all_signals(random_beams):
    """The likelihood has no maximum along the range in the few cells near the prior of a track."""
    scenario = Scenario(
        center_frequencies_hz=(1e6, 2e6), n_subbands=2, n_frames=3, elements_per_side=4,
        subband_width_hz=1e5, roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook, rng = random_beams(scenario, np.random.default_rng(0)), np.random.default_rng(1)
    positions = scenario.sample_positions(20, rng)
    received = MeasurementModel(scenario, codebook).sample(positions, rng)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)
    squares = squared_normalised(estimate.mean - positions, estimate.covariance)
    assert np.mean(squares <= chdtri(3, 0.05)) >= 0.8
    tracker = Tracker(make_estimator('bayes', scenario, codebook, lazy=True))
    assert all(tracker.update(0.1 * n, one).fix for n, one in enumerate(received))


def test_few_and_strong_measurements_locate_users(random_beams):
    """Approximations on the grid must not displace the true position."""
    scenario = Scenario(
        center_frequencies_hz=(2.58e9,), n_subbands=2, subband_width_hz=271e3, n_feeds=1,
        elements_per_side=(8, 10), element_interval_wavelengths=1.0, multipath_to_los_db=-100.0,
        max_user_speed_mps=100.0, roi_center_m=(11.7, 0, 0), roi_size_m=(5.2, 15.7, 6.0))
    codebook, rng = random_beams(scenario, np.random.default_rng(0)), np.random.default_rng(1)
    positions = scenario.sample_positions(100, rng)
    estimate = make_estimator('bayes', scenario, codebook).estimate(
        simulate_received(scenario, codebook, positions, rng))
    assert estimate.fix.mean() > 0.97
    squares = squared_normalised(estimate.mean - positions, estimate.covariance)[estimate.fix]
    assert np.mean(squares < chdtri(3, 0.05)) > 0.88


def test_one_frame_of_one_band_leaves_all_positions_on_a_surface():
    """Of thousands of peaks, those count whose steps are predicted as far as they are taken."""
    scenario = Scenario(
        center_frequencies_hz=(49.8e9,), n_subbands=32, subband_width_hz=54.6e3, n_frames=1,
        elements_per_side=(5, 16), element_interval_wavelengths=0.59, refractive_index=1.45,
        delay_spread_s=22e-9, angular_spread_deg=4.4, multipath_to_los_db=-18.8,
        max_power_w=0.0026, roi_center_m=(3.3, 1.3, -0.1), roi_size_m=(2.8, 2.7, 0.43))
    codebook, rng = random_codebook(scenario, np.random.default_rng(8)), np.random.default_rng(8)
    positions = scenario.sample_positions(40, rng)
    estimate = make_estimator('bayes', scenario, codebook).estimate(
        simulate_received(scenario, codebook, positions, rng))
    squares = squared_normalised(estimate.mean - positions, estimate.covariance)
    assert np.mean(squares < chdtri(3, 0.05)) > 0.9
    assert np.mean(squares) < 1.6 * 3


def test_offsets_far_from_their_first_estimates_are_found_with_strong_signals():
    """The direct path of a strong signal misleads the estimates before the search."""
    scenario = Scenario(
        center_frequencies_hz=(51.3e9,), n_subbands=16, subband_width_hz=289e3, n_frames=8,
        elements_per_side=(8, 12), element_interval_wavelengths=0.41, n_feeds=2,
        refractive_index=2.29, delay_spread_s=131e-9, angular_spread_deg=3.8,
        multipath_to_los_db=-8.4, max_power_w=0.0155, roi_center_m=(17.5, -5.5, 1),
        roi_size_m=(7.8, 21.4, 4.4), timing_std_s=13e-9)
    codebook, rng = random_codebook(scenario, np.random.default_rng(0)), np.random.default_rng(0)
    positions = scenario.sample_positions(60, rng)
    received = simulate_received(scenario, codebook, positions, rng)
    # Of these, the margin of the search covers too little.
    far = [52, 53, 15]
    estimate = make_estimator('bayes', scenario, codebook).estimate(received[far])
    squares = squared_normalised(estimate.mean - positions[far], estimate.covariance)
    assert (squares < 16).all()


def test_regions_contain_the_range_within_a_wavelength(shipped):
    """With strong signals and partly known phases, most of the variance is within it."""
    scenario = Scenario(multipath_to_los_db=-40.0, band_phase_std_rad=1.0)
    rng = np.random.default_rng(1)
    positions = scenario.sample_positions(80, rng)
    estimate = make_estimator('bayes', scenario, shipped).estimate(
        simulate_received(scenario, shipped, positions, rng))
    squares = squared_normalised(estimate.mean - positions, estimate.covariance)
    # The mean of the offsets in place of draws leaves 0.55.
    assert np.mean(squares < chdtri(3, 0.05)) > 0.85


@pytest.mark.parametrize('changes', [
    {'roi_size_m': (10, 0, 0)}, {'roi_size_m': (0, 10, 2)}, {'roi_size_m': (0, 10, 0)},
    {'roi_size_m': (10, 10, 0), 'roi_center_m': (10, 0, -2)}, {'delay_spread_s': 0.0},
    {'delay_spread_s': 1e-9}, {'delay_spread_s': 0.0, 'multipath_to_los_db': -20.0},
    {'roi_center_m': (1, 20, 5), 'roi_size_m': (1.5, 10, 2)},
    {'roi_center_m': (0.3, 5, 0), 'roi_size_m': (0.5, 6, 2)},
    {'multipath_to_los_db': -20.0, 'user_gain_std_db': 1.0},
    {'multipath_to_los_db': -25.0, 'timing_std_s': 20e-9}], ids=str)
def test_regions_contain_users_on_lines_in_flat_channels_at_wide_angles_and_with_strong_signals(
        changes, shipped):
    scenario, rng = Scenario(**changes), np.random.default_rng(0)
    positions = scenario.sample_positions(200, rng)
    estimate = make_estimator('bayes', scenario, shipped).estimate(
        simulate_received(scenario, shipped, positions, rng))
    assert estimate.fix.mean() > 0.995
    squares = squared_normalised(estimate.mean - positions, estimate.covariance)
    inside = squares <= chdtri(np.count_nonzero(scenario.roi_size_m), 0.05)
    # Posteriors are not Gaussian; the standard error is 0.015.
    assert 0.9 < np.mean(inside) < 0.985


@pytest.mark.parametrize('noise_psd_dbm_hz', [-94.0, -84.0])
@pytest.mark.parametrize('changes', [{}, {'roi_size_m': (0, 10, 0)}], ids=['box', 'line'])
def test_noise_that_hides_signals_of_unknown_gain_lets_no_search_diverge(
        random_beams, noise_psd_dbm_hz, changes):
    """Hardly anything then limits the gain."""
    scenario = Scenario(**{
        'center_frequencies_hz': (1.3e9, 1.5e9), 'n_subbands': 4, 'n_frames': 1,
        'elements_per_side': 7, 'element_interval_wavelengths': 0.4, 'multipath_to_los_db': -29.0,
        'roi_size_m': (8, 10, 4), 'user_gain_std_db': np.inf, 'timing_std_s': 6e-8,
        'noise_psd_dbm_hz': noise_psd_dbm_hz} | changes)
    codebook = random_beams(scenario, np.random.default_rng(0))
    _, received = System(scenario, codebook).pairs(10, 0)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)
    assert np.isfinite(estimate.mean[estimate.fix]).all()
    assert (np.linalg.eigvalsh(estimate.covariance[estimate.fix]) > -1e-9).all()
