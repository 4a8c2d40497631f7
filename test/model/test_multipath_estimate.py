"""A measured covariance of the multipath, in place of the declared one."""

import dataclasses

import numpy as np
import pytest
import yaml

from rhs_isac_ros.model import MeasurementModel, Scenario, ScenarioError, simulate_received
from rhs_isac_ros.model import multipath as mp
from rhs_isac_ros.model.multipath_estimate import CONDITIONS, MultipathEstimate
from rhs_isac_ros.support.files import ArchiveError

N = 40_000


@pytest.fixture(scope='module')
def declared():
    """A scenario of little noise whose frames and sub-bands are far from fully correlated."""
    return Scenario(
        center_frequencies_hz=(1.2e9, 3.1e9), n_subbands=3, n_frames=2, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-3)


@pytest.fixture(scope='module')
def beams(declared, random_beams):
    return random_beams(declared, np.random.default_rng(0))


@pytest.fixture(scope='module')
def target(declared, beams):
    """A covariance of the survey's signals that differs much from the declared one."""
    rng = np.random.default_rng(1)
    root = MeasurementModel(declared, beams).root
    mixing = np.eye(6) + 0.5 * rng.normal(size=(2, 6, 6, 2)) @ [1, 1j]
    factor = root @ mixing
    return factor @ np.conj(np.swapaxes(factor, 1, 2))


@pytest.fixture(scope='module')
def estimate(declared, beams, target):
    model = MeasurementModel(declared, beams)
    inverse = np.linalg.inv(model.covariance())
    return MultipathEstimate(
        declared.multipath_to_los_db, declared.delay_spread_s, declared.angular_spread_deg,
        np.array(model.radiation), inverse @ (target - model.covariance()) @ inverse,
        {name: declared.fields()[name] for name in CONDITIONS})


@pytest.fixture(scope='module')
def measured(declared, estimate):
    return dataclasses.replace(declared, multipath=estimate)


def relative(actual, expected):
    return np.linalg.norm(actual - expected) / np.linalg.norm(expected)


def test_signals_of_the_survey_have_the_measured_covariance(measured, beams, target):
    covariance = MeasurementModel(measured, beams).covariance()
    assert relative(covariance, target) < 1e-4
    np.testing.assert_allclose(covariance, np.conj(np.swapaxes(covariance, 1, 2)))


def test_an_excess_of_zero_is_the_declared_covariance(declared, estimate, beams):
    same = dataclasses.replace(estimate, excess=0 * estimate.excess)
    np.testing.assert_array_equal(
        MeasurementModel(dataclasses.replace(declared, multipath=same), beams).covariance(),
        MeasurementModel(declared, beams).covariance())


def test_its_fields_take_the_place_of_those_of_the_scenario(measured):
    other = dataclasses.replace(
        measured, multipath_to_los_db=-9.0, delay_spread_s=1e-9, angular_spread_deg=50.0)
    np.testing.assert_array_equal(mp.multipath_covariance(other),
                                  mp.multipath_covariance(measured))
    np.testing.assert_array_equal(mp.measurement_correlation(other),
                                  mp.measurement_correlation(measured))


def test_gains_of_elements_have_the_covariance_of_other_beams(measured, random_beams):
    """The covariance is one of the gains: it holds for beams that no survey has used."""
    other = random_beams(measured, np.random.default_rng(5))
    radiation = MeasurementModel(measured, other).radiation
    expected = mp.scattered_covariance(measured, radiation)
    for band in range(2):
        gains = mp.draw_multipath(measured, band, N, np.random.default_rng(band))
        signals = np.einsum('nrm,rm->nr', gains, radiation[band])
        sample = signals.T @ signals.conj() / N
        assert relative(sample, expected[band]) < 0.03
        spatial = np.einsum('nrm,nrk->mk', gains, gains.conj()) / gains[..., 0].size
        assert relative(spatial, mp.spatial_covariance(measured).matrix[band]) < 0.03
        assert relative(mp.multipath_covariance(measured)[band], spatial) > 0.1


@pytest.fixture
def by_convolution(monkeypatch):
    """Treat the surface as one of many elements."""
    caches = (mp.spatial_covariance, mp.declared_covariance, mp.multipath_factors, mp._stretches)
    for cache in caches:
        cache.cache_clear()
    monkeypatch.setattr(mp, '_MAX_MATRIX', 1)
    monkeypatch.setattr(mp, '_ANGLE_NODES', 16)
    yield
    for cache in (*caches, mp._lattice):
        cache.cache_clear()


def test_many_elements_have_the_same_spatial_covariance(measured, request):
    few = mp.spatial_covariance(measured)
    request.getfixturevalue('by_convolution')
    many = mp.spatial_covariance(measured)
    assert many.matrix is None
    np.testing.assert_allclose(many.power, few.power)
    np.testing.assert_allclose(few.power, np.diagonal(few.matrix, axis1=1, axis2=2).real)
    weights = np.random.default_rng(0).normal(size=(2, 4, 9, 2)) @ [1, 1j]
    for found, expected, rows in ((many, few, weights), (many[1], few[1], weights[1]),
                                  (many[[1, 0]], few[[1, 0]], weights)):
        product = expected.scatter(rows)
        np.testing.assert_allclose(product, rows @ expected.matrix)
        np.testing.assert_allclose(
            found.scatter(rows), product, atol=1e-12 * np.abs(product).max())


@pytest.mark.slow
def test_gains_of_many_elements_have_the_measured_covariance(
        measured, beams, target, by_convolution):
    radiation = MeasurementModel(measured, beams).radiation
    noise = measured.noise_power_w * np.eye(6)
    for band in range(2):
        gains = mp.draw_multipath(measured, band, N // 4, np.random.default_rng(band))
        signals = np.einsum('nrm,rm->nr', gains, radiation[band])
        assert relative(signals.T @ signals.conj() / len(signals) + noise, target[band]) < 0.06


def test_both_simulations_have_the_measured_covariance(measured, beams, target):
    positions = np.tile(measured.roi_center_m, (N, 1))
    model = MeasurementModel(measured, beams)
    for received in (model.sample(positions, np.random.default_rng(1)),
                     simulate_received(measured, beams, positions, np.random.default_rng(2))):
        errors = received - model.mean(positions[:1])
        sample = np.einsum('nir,nis->irs', errors, errors.conj()) / N
        assert relative(sample, target) < 0.03


def test_a_declared_spatial_covariance_is_that_of_the_fields(declared):
    assert mp.spatial_covariance(declared) is mp.declared_covariance(declared)
    np.testing.assert_array_equal(
        mp.spatial_covariance(declared).matrix, mp.multipath_covariance(declared))


def test_a_file_holds_the_estimate_and_scenarios_name_it(declared, estimate, measured, tmp_path):
    estimate.save(tmp_path / 'hall.npz')
    assert MultipathEstimate.load(tmp_path / 'hall.npz') == estimate
    (tmp_path / 'hall.yaml').write_text(
        yaml.safe_dump(declared.changes() | {'multipath': 'hall.npz'}), encoding='utf-8')
    loaded = Scenario.from_yaml(tmp_path / 'hall.yaml')
    assert loaded == measured
    assert hash(loaded) == hash(measured)
    # The path does not matter to the identifier, but the content does.
    assert loaded.id == measured.id != declared.id
    assert Scenario(**loaded.changes()) == measured


def test_a_changed_file_is_refused(declared, estimate, tmp_path):
    dataclasses.replace(estimate, excess=2 * estimate.excess).save(tmp_path / 'hall.npz')
    with pytest.raises(ScenarioError, match=r'^multipath: .*hall.npz: digest .*, expected '):
        dataclasses.replace(declared, multipath=f'{tmp_path / "hall.npz"}@{estimate.digest}')


def test_an_estimate_of_another_scenario_is_refused(measured):
    with pytest.raises(ScenarioError, match=r'^multipath: a survey with n_subbands 3, expected 4'):
        dataclasses.replace(measured, n_subbands=4)


@pytest.mark.parametrize('name', ['excess', 'radiation', 'delay_spread_s'])
def test_numbers_that_are_not_finite_are_refused(estimate, name):
    with pytest.raises(ArchiveError, match=f'^{name}: not finite'):
        dataclasses.replace(estimate, **{name: np.nan * getattr(estimate, name)})


def test_sizes_that_disagree_are_refused(estimate):
    with pytest.raises(ArchiveError, match=r'^excess: shape \(2, 5, 6\)'):
        dataclasses.replace(estimate, excess=estimate.excess[:, 1:])
