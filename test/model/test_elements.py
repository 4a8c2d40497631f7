"""Errors and failures of the elements: draws, and their effect on mean and covariance."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import qmc

from rhs_isac_ros.model import (
    MeasurementModel,
    Scenario,
    draw_surface,
    simulate_received,
)
from rhs_isac_ros.model.elements import (
    DeclaredElements,
    SurfaceEstimate,
    element_correlation,
)

N_SURFACES = 1500
ERRORS = [{'element_error_rms': 0.2}, {'failed_element_share': 0.1},
          {'element_error_rms': 0.3, 'failed_element_share': 0.3}]


@pytest.fixture(scope='module')
def damaged(small) -> Scenario:
    return dataclasses.replace(
        small.scenario, element_error_rms=0.3, failed_element_share=0.2)


def test_a_surface_has_the_declared_errors():
    scenario = Scenario(
        elements_per_side=100, element_error_rms=0.05, failed_element_share=0.03)
    surface = draw_surface(scenario, np.random.default_rng(1))
    errors, levels = surface.gains - 1, surface.stuck[~np.isnan(surface.stuck)]
    assert np.sqrt(np.mean(np.abs(errors)**2)) == pytest.approx(0.05, rel=0.05)
    assert abs(np.mean(errors**2)) < 5e-2 * 0.05**2
    assert len(levels) == pytest.approx(300, abs=4 * np.sqrt(300))
    assert levels.min() >= 0
    assert levels.max() <= 1
    assert levels.mean() == pytest.approx(0.5, abs=4 / np.sqrt(12 * 300))


def test_a_failed_element_is_stuck_in_all_configurations():
    scenario = Scenario(elements_per_side=4, element_error_rms=0.1, failed_element_share=0.4)
    surface = draw_surface(scenario, np.random.default_rng(2))
    analog = np.random.default_rng(3).uniform(size=(2, 3, 16))
    applied = surface.applied(analog)
    failed = ~np.isnan(surface.stuck)
    assert 0 < failed.sum() < 16
    np.testing.assert_array_equal(
        applied[..., failed], np.broadcast_to((surface.stuck * surface.gains)[failed],
                                              applied[..., failed].shape))
    np.testing.assert_array_equal(
        applied[..., ~failed], (analog * surface.gains)[..., ~failed])


def test_a_higher_share_adds_failures():
    few, many = (draw_surface(Scenario(failed_element_share=share), np.random.default_rng(4))
                 for share in (0.1, 0.3))
    failed = ~np.isnan(few.stuck)
    assert 0 < failed.sum() < (~np.isnan(many.stuck)).sum()
    np.testing.assert_array_equal(many.stuck[failed], few.stuck[failed])


@pytest.mark.parametrize('errors', ERRORS, ids=str)
def test_mean_and_covariance_are_those_over_surfaces(small, errors):
    scenario = dataclasses.replace(small.scenario, **errors)
    position = small.vectors['positions'][1:2]
    model = MeasurementModel(scenario, small.codebook)
    rng = np.random.default_rng(1)
    surfaces = [MeasurementModel(scenario, small.codebook, draw_surface(scenario, rng))
                for _ in range(N_SURFACES)]
    covariance = model.covariance_at(position)[0, 0]
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    deviations = np.array([s.mean(position)[0, 0] for s in surfaces]) - model.mean(position)[0, 0]
    deviations = deviations @ root.T
    assert np.abs(deviations.mean(axis=0)).max() < 5 / np.sqrt(N_SURFACES)
    # The covariance over surfaces and multipath is the mean covariance given the surface, plus
    # the covariance of the mean given the surface.
    given = np.mean([s.covariance()[0] for s in surfaces], axis=0)
    found = root @ given @ root.conj().T + deviations.T @ deviations.conj() / N_SURFACES
    np.testing.assert_allclose(found, np.eye(len(root)), atol=7 / np.sqrt(N_SURFACES))


def test_the_average_is_that_over_the_region(table1):
    scenario = dataclasses.replace(
        table1.scenario, element_error_rms=0.03, failed_element_share=0.01)
    model = MeasurementModel(scenario, table1.codebook)
    low, high = scenario.roi_bounds_m
    positions = low + qmc.Sobol(3, seed=0).random(128) * (high - low)
    average = model.covariance_at(positions).mean(axis=0)
    scale = np.sqrt(np.einsum('brr->br', average).real)
    difference = (model.covariance() - average) / (scale[:, :, None] * scale[:, None, :])
    assert np.abs(difference).max() < 0.01


def test_the_quadrature_over_the_region_has_converged():
    """A near, wide region and wide sub-bands need more nodes than Table I."""
    scenario = Scenario(elements_per_side=4, n_subbands=4, subband_width_hz=5e6,
                        roi_center_m=(3, 0, 0), roi_size_m=(4, 8, 4))
    found = element_correlation(scenario, 0)
    expected = element_correlation(scenario, 0, 24)
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


def test_elements_are_exact_if_their_errors_are_known_or_absent(small, damaged):
    assert draw_surface(damaged, np.random.default_rng(3)).is_exact
    assert DeclaredElements(small.scenario).is_exact
    for name in ('element_error_rms', 'failed_element_share'):
        assert not DeclaredElements(Scenario(**{name: 1e-6})).is_exact
    n, n_bands = small.scenario.n_elements, small.scenario.n_bands
    for rank in (0, 1):
        factor = np.ones((2 * n + n_bands, rank), complex)
        assert SurfaceEstimate(np.ones(n), np.zeros(n), np.ones(n_bands), factor,
                               np.zeros(n)).is_exact == (rank == 0)


def test_an_estimate_adds_the_covariance_of_its_errors(random_beams):
    """To first order in the errors of gains, offsets and bands: one term for each column of F."""
    scenario = Scenario(elements_per_side=3, n_feeds=2, n_subbands=2)
    rng = np.random.default_rng(5)
    beams, positions = random_beams(scenario, rng), scenario.sample_positions(2, rng)
    estimate = rng.normal(size=(9 + 9 + 2, 2)) @ [1, 1j]
    factor = rng.normal(size=(20, 3, 2)) @ [1, 1j]

    def model(gains, offsets, bands, factor=factor[:, :0]):
        return MeasurementModel(
            scenario, beams, SurfaceEstimate(gains, offsets, bands, factor, np.zeros(9)))

    def of_errors(errors):
        gains, offsets, bands = np.split(errors, [9, 18])
        return model(estimate[:9] + gains, estimate[9:18] + offsets, estimate[18:] * (1 + bands))

    expected = of_errors(0 * estimate).covariance_at(positions)
    for column in factor.T:
        slope = (of_errors(column).mean(positions) - of_errors(-column).mean(positions)) / 2
        scattered = model(column[:9], column[9:18], estimate[18:]).covariance()
        expected += slope[..., None] * slope[..., None, :].conj() + (
            scattered - scenario.noise_power_w * np.eye(scattered.shape[-1]))
    found = model(*np.split(estimate, [9, 18]), factor).covariance_at(positions)
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


def test_both_simulations_use_a_given_surface(small, damaged):
    surface = draw_surface(damaged, np.random.default_rng(9))
    quiet = dataclasses.replace(damaged, noise_psd_dbm_hz=-200, multipath_to_los_db=-100)
    positions = quiet.sample_positions(2, np.random.default_rng(10))
    model = MeasurementModel(quiet, small.codebook, surface)
    mean = model.mean(positions)
    for received in (model.sample(positions, np.random.default_rng(0)), simulate_received(
            quiet, small.codebook, positions, np.random.default_rng(0), surface)):
        assert np.abs(received - mean).max() < 1e-3 * np.abs(mean).max()


def test_a_surface_of_another_size_is_an_error(small):
    other = draw_surface(Scenario(), np.random.default_rng(9))
    with pytest.raises(ValueError, match='^surface: 100 elements, expected N_E = 16 as in '):
        MeasurementModel(small.scenario, small.codebook, other)
