"""The global bound: limits, and brute force where the posterior has a few ambiguous ranges."""

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb, global_bound
from rhs_isac_ros.bounds.global_bound import _Lattice
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario

SMALL = {'elements_per_side': 4, 'n_subbands': 2, 'n_frames': 2, 'n_feeds': 2}


def bound_and_codebook(n_phases=1024, **fields):
    scenario = Scenario(**{**SMALL, **fields})
    codebook = random_codebook(scenario, np.random.default_rng(1))
    bound = global_bound(MeasurementModel(scenario, codebook), np.random.default_rng(2), n_phases)
    return scenario, codebook, bound


def test_without_signal_the_bound_is_the_variance_of_the_region():
    scenario, _, bound = bound_and_codebook(256, max_power_w=1e-15, noise_psd_dbm_hz=0.0)
    assert bound.value == pytest.approx(
        np.sum(np.square(scenario.roi_size_m)) / 12, rel=0.02)


def test_with_strong_signals_the_bound_is_the_cramer_rao_bound():
    scenario, codebook, bound = bound_and_codebook(
        256, multipath_to_los_db=-33.0, roi_center_m=(5.0, 0.3, 0.2), roi_size_m=(0.1, 0.4, 0.4))
    local = crlb(scenario, codebook, bound.positions).mean()
    size = np.square(scenario.roi_size_m).sum() / 12
    assert local < size / 20
    assert bound.value == pytest.approx(local, rel=0.1)
    assert bound.coarseness == 1


def test_ambiguous_ranges_are_as_in_a_brute_force_posterior():
    # In a thin region, only the range is unknown. Its phases repeat every 0.6 m.
    scenario, codebook, bound = bound_and_codebook(
        128, multipath_to_los_db=-5.0, roi_center_m=(7.0, 0.0, 0.0), roi_size_m=(3.0, 1e-6, 1e-6))
    rng = np.random.default_rng(3)
    model = MeasurementModel(scenario, codebook)
    grid = np.zeros((1501, 3))
    grid[:, 0] = np.linspace(5.5, 8.5, len(grid))
    means = model.whiten(model.mean(grid)).reshape(len(grid), -1)
    truth = scenario.sample_positions(1024, rng)
    received = model.whiten(model.sample(truth, rng)).reshape(len(truth), -1)
    log = 2 * (received @ means.conj().T).real - np.sum(np.abs(means)**2, axis=1)
    weights = np.exp(log - log.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    variances = weights @ grid[:, 0]**2 - (weights @ grid[:, 0])**2
    local = crlb_of_range(model, truth)
    assert variances.mean() > 5 * local
    spread = np.hypot(variances.std() / np.sqrt(len(truth)), bound.standard_error)
    assert abs(bound.value - variances.mean()) < 4 * spread
    assert spread < 0.07 * bound.value


def crlb_of_range(model, truth):
    slope = model.mean_and_jacobian(truth, whitened=True)[1][:, 0]
    return np.mean(1 / (2 * np.sum(np.abs(slope)**2, axis=(1, 2))))


def test_squared_errors_have_the_mean_of_the_bound():
    scenario, _, bound = bound_and_codebook(128, roi_size_m=(2.0, 2.0, 1.0))
    spread = np.std(bound.squared_errors) / np.sqrt(len(bound.squared_errors))
    assert abs(bound.squared_errors.mean() - bound.value) < 4 * np.hypot(
        spread, bound.standard_error)
    low, high = scenario.roi_bounds_m
    assert ((bound.positions >= low) & (bound.positions <= high)).all()


def test_the_amplitude_of_strong_signals_does_not_exclude_the_truth():
    scenario, codebook, bound = bound_and_codebook(64, multipath_to_los_db=-30.0)
    assert 0 < bound.value < crlb(scenario, codebook, bound.positions).mean()
    assert bound.coarseness > 3


def test_log_likelihoods_are_interpolated_over_the_range_also_for_wide_bands():
    scenario = Scenario(**SMALL, center_frequencies_hz=(2e9,), subband_width_hz=4e8,
                        roi_size_m=(8.0, 2.0, 2.0))
    model = MeasurementModel(
        scenario, random_codebook(scenario, np.random.default_rng(1))).prepare()
    lattice = _Lattice(model, np.array([0.37, 0.1, 0.1]), np.array([8.0, 0.3, 0.2]))
    signals = model.whiten(model.mean(np.array([[7.0, 0.2, 0.1]])))
    products = lattice._products(signals)[0].view(np.float32).reshape(len(lattice._sight), -1)
    points = lattice._sight[:, None] * lattice._ranges[:, None]
    means = model.whiten(model.mean(points.reshape(-1, 3)))
    exact = np.sum(2 * (means.conj() * signals).real - np.abs(means)**2, axis=(1, 2))
    inside = np.isfinite(lattice._prior)
    found = (products @ lattice._basis + lattice._offset)[inside] - lattice._prior[inside]
    np.testing.assert_allclose(found, exact.reshape(inside.shape)[inside],
                               atol=1e-3 * np.abs(exact).max())


def test_too_few_phases_are_an_error():
    for n_phases, expected in ((1, 'at least 2'), (1e3, 'an integer, at least 2')):
        with pytest.raises(ValueError, match=f'n_phases: {n_phases}, expected {expected}'):
            bound_and_codebook(n_phases)


def test_a_flat_region_is_the_limit_of_thin_ones():
    flat, thin = (bound_and_codebook(
        256, multipath_to_los_db=-20.0, roi_center_m=(5.0, 0.0, 1.2),
        roi_size_m=(1.0, 1.0, size))[2] for size in (0.0, 2e-2))
    spread = np.hypot(flat.standard_error, thin.standard_error)
    assert flat.value == pytest.approx(thin.value, abs=4 * spread + 0.05 * thin.value)
    assert spread < 0.2 * thin.value
