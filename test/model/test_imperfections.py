"""Draws of the deviations that a scenario declares."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import MeasurementModel, Scenario, simulate_received
from rhs_isac_ros.model.imperfections import draw_deviations, draw_surface

N_PHASES = 1500


@pytest.fixture(scope='module')
def uncertain(small) -> Scenario:
    """All deviations but that of the gain, which would change the covariance with the user."""
    return dataclasses.replace(
        small.scenario, band_phase_std_rad=7.0, timing_std_s=1e-6, carrier_offset_std_hz=1e4,
        element_error_rms=0.3, failed_element_share=0.2)


def simulate(scenario, codebook, positions, seed):
    return simulate_received(scenario, codebook, positions, np.random.default_rng(seed))


def sample(scenario, codebook, positions, seed):
    return MeasurementModel(scenario, codebook).sample(positions, np.random.default_rng(seed))


def test_table_1_draws_nothing(table1):
    rng = np.random.default_rng(0)
    before = rng.bit_generator.seed_seq.n_children_spawned
    assert draw_deviations(table1.scenario, 4, rng) == (None, None)
    assert rng.bit_generator.seed_seq.n_children_spawned == before


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


def test_multipath_and_noise_do_not_depend_on_what_is_declared(small, uncertain):
    positions = small.scenario.sample_positions(3, np.random.default_rng(5))
    plain = simulate(small.scenario, small.codebook, positions, 6)
    phases = dataclasses.replace(small.scenario, phase_std_rad=1e-9)
    np.testing.assert_allclose(
        simulate(phases, small.codebook, positions, 6), plain, rtol=1e-6)
    assert not np.allclose(simulate(uncertain, small.codebook, positions, 6), plain, rtol=0.01)


@pytest.mark.parametrize('draw', [simulate, sample])
def test_signals_have_the_declared_distribution(small, uncertain, draw):
    """Deviations from the mean of the drawn surface, with the factors of the drawn users, are
    white after whitening."""
    positions = np.tile(small.vectors['positions'][2], (N_PHASES, 1))
    received = draw(uncertain, small.codebook, positions, 7)
    surface, factors = draw_deviations(uncertain, N_PHASES, np.random.default_rng(7))
    model = MeasurementModel(uncertain, small.codebook, surface)
    white = model.whiten(received / factors - model.mean(positions[:1])).reshape(N_PHASES, -1)
    limit = 5.0 / np.sqrt(N_PHASES)
    assert np.abs(white.T @ white.conj() / N_PHASES - np.eye(white.shape[1])).max() < limit
    assert np.abs(white.mean(axis=0)).max() < limit


@pytest.mark.parametrize('draw', [simulate, sample])
def test_gain_acts_on_the_multipath_but_not_on_the_noise(small, draw):
    scenario = dataclasses.replace(small.scenario, user_gain_std_db=6.0, noise_psd_dbm_hz=-90.0)
    positions = np.tile(small.vectors['positions'][2], (N_PHASES, 1))
    received = draw(scenario, small.codebook, positions, 8)
    _, factors = draw_deviations(scenario, N_PHASES, np.random.default_rng(8))
    model = MeasurementModel(scenario, small.codebook)
    deviation = (received - factors * model.mean(positions[:1]))[:, 0]
    noise = scenario.noise_power_w * np.eye(6)
    scattered = model.covariance()[0] - noise
    expected = np.mean(np.abs(factors[:, 0, 0])**2) * scattered + noise
    found = deviation.T @ deviation.conj() / N_PHASES
    assert np.abs(found - expected).max() < 0.25 * np.abs(expected).max()


def test_a_given_surface_is_used(small, uncertain):
    surface = draw_surface(uncertain, np.random.default_rng(9))
    silent = dataclasses.replace(small.scenario, noise_psd_dbm_hz=-400, multipath_to_los_db=-200)
    positions = small.scenario.sample_positions(2, np.random.default_rng(10))
    received = simulate_received(
        silent, small.codebook, positions, np.random.default_rng(0), surface)
    model = MeasurementModel(silent, small.codebook, surface)
    np.testing.assert_allclose(received, model.mean(positions), rtol=1e-6)


def test_a_known_surface_is_that_of_the_samples(small, uncertain):
    surface = draw_surface(uncertain, np.random.default_rng(9))
    quiet = dataclasses.replace(
        small.scenario, element_error_rms=0.3, failed_element_share=0.2, noise_psd_dbm_hz=-200,
        multipath_to_los_db=-100)
    positions = quiet.sample_positions(2, np.random.default_rng(10))
    model = MeasurementModel(quiet, small.codebook, surface)
    mean = model.mean(positions)
    received = model.sample(positions, np.random.default_rng(0))
    assert np.abs(received - mean).max() < 1e-3 * np.abs(mean).max()


def test_a_surface_of_another_size_is_an_error(small):
    other = draw_surface(Scenario(), np.random.default_rng(9))
    positions = small.scenario.sample_positions(2, np.random.default_rng(10))
    with pytest.raises(ValueError, match='^surface: 100 elements, expected N_E = 16 as in '):
        MeasurementModel(small.scenario, small.codebook, other)
    with pytest.raises(ValueError, match='^surface: 100 elements, expected N_E = 16 as in '):
        simulate_received(
            small.scenario, small.codebook, positions, np.random.default_rng(0), other)
