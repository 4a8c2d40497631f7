"""Fisher information and the bound, with nuisance parameters, priors and several surfaces."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import (
    average_crlb,
    crlb,
    crlb_of,
    fisher,
    fisher_information,
    site_crlb,
    site_information,
)
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Pose, Scenario, geometry
from rhs_isac_ros.model.impairments import nuisance_of
from rhs_isac_ros.model.scenario import ScenarioError
from rhs_isac_ros.positioning import make_estimator


def test_information_and_bound_match_the_vectors(case):
    positions = case.vectors['positions']
    information = fisher_information(MeasurementModel(case.scenario, case.codebook), positions)
    scale = np.abs(case.vectors['fim']).max()
    np.testing.assert_allclose(information, case.vectors['fim'], rtol=1e-8, atol=1e-10 * scale)
    bound = crlb(case.scenario, case.codebook, positions)
    assert bound.dtype == float
    np.testing.assert_allclose(bound, case.vectors['crlb'], rtol=1e-8)


def random_directions(rng, n):
    return np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]


@pytest.mark.parametrize('eigenvalues', [
    (1, 1, 1e-4), (1, 1e-4, 1e-4), (1, 1e-2, 1e-4), (1, 1, 1e-8), (1, 1e-4, 1e-8),
    (1, 1e-8, 1e-8), (1, 1, 1e-10), (1, 1e-5, 1e-10), (1, 1e-10, 1e-10)], ids=str)
def test_inverse_information_is_as_accurate_as_the_condition_allows(eigenvalues):
    rng = np.random.default_rng(5)
    turns = random_directions(rng, 100)
    matrices = (turns * np.array(eigenvalues)) @ np.swapaxes(turns, 1, 2)
    matrices = (matrices + np.swapaxes(matrices, 1, 2)) / 2
    units = 10.0**rng.uniform(-3, 3, size=(100, 3))
    scale = units[:, :, None] * units[:, None, :]
    inverse = fisher.inverse_information(matrices * scale) * scale
    expected = np.linalg.inv(matrices)
    errors = np.linalg.norm(inverse - expected, axis=(1, 2))
    # Both inverses have errors: rounding the matrix alone changes its inverse this much.
    allowed = 2e-15 * np.linalg.cond(matrices) * np.linalg.norm(expected, axis=(1, 2))
    assert (errors <= allowed).all()


@pytest.mark.parametrize('rank', [0, 1, 2])
def test_singular_information_is_infinite_without_a_warning(rank):
    rng = np.random.default_rng(6 + rank)
    units = 10.0**rng.uniform(-3, 3, size=(100, 3, 1))
    roots = units * rng.normal(size=(100, 3, rank))
    inverse = fisher.inverse_information(roots @ np.swapaxes(roots, 1, 2))
    np.testing.assert_array_equal(np.diagonal(inverse, axis1=1, axis2=2), np.inf)
    assert not np.isnan(inverse).any()
    # Axes without any information.
    inverse = fisher.inverse_information(np.diag([7.0] * rank + [0.0] * (3 - rank))[None])
    np.testing.assert_array_equal(np.diagonal(inverse[0]), np.inf)


def test_a_singular_matrix_does_not_affect_the_others():
    information = np.stack([np.diag([1.0, 4.0, 0.25]), np.ones((3, 3)), np.zeros((3, 3)),
                            np.diag([2.0, 5.0, 10.0])])
    inverse = fisher.inverse_information(information)
    np.testing.assert_allclose(inverse[0], np.diag([1, 0.25, 4]), rtol=1e-15)
    np.testing.assert_allclose(inverse[3], np.diag([0.5, 0.2, 0.1]), rtol=1e-15)
    assert fisher.inverse_information(np.zeros((0, 3, 3))).shape == (0, 3, 3)


@pytest.mark.parametrize('distance', [10, 100, 1000])
def test_bound_is_the_trace_of_the_inverse_information_at_any_distance(shipped, distance):
    """Far away, nearly all of the information is about the distance."""
    scenario = Scenario()
    positions = distance * np.array([[1.0, 1.0, 0.3], [1.0, 0.0, 0.0], [2.0, -1.0, 0.1]])
    information = fisher_information(MeasurementModel(scenario, shipped), positions)
    assert np.linalg.cond(information).max() < 1e10
    expected = np.trace(np.linalg.inv(information), axis1=1, axis2=2)
    np.testing.assert_allclose(
        crlb(scenario, shipped, positions), expected,
        rtol=1e-15 * np.linalg.cond(information).max())


DECLARED = {
    'user_gain_std_db': 2.0, 'carrier_offset_std_hz': 700.0, 'phase_std_rad': 0.4,
    'timing_std_s': 30e-9, 'band_phase_std_rad': 0.7}
ERRORS = {'element_error_rms': 0.1, 'failed_element_share': 0.05}
# Impairments, one at a time and together.
CASES = [{name: value} for name, value in DECLARED.items()] + [
    {'element_error_rms': 0.1}, {'failed_element_share': 0.05}, DECLARED | ERRORS]


def test_nothing_declared_gives_the_plain_bound(case):
    positions = case.vectors['positions']
    model = MeasurementModel(case.scenario, case.codebook)
    joint = fisher.joint_information_of(model, positions)
    np.testing.assert_allclose(
        fisher.without_nuisance(joint, case.scenario).information, case.vectors['fim'], rtol=1e-8,
        atol=1e-9 * np.abs(case.vectors['fim']).max())
    # An impairment too small to matter, through the code of nuisance parameters.
    tiny = dataclasses.replace(case.scenario, band_phase_std_rad=1e-9, user_gain_std_db=1e-9)
    np.testing.assert_allclose(
        crlb(tiny, case.codebook, positions), case.vectors['crlb'], rtol=1e-8)


@pytest.mark.parametrize('velocity', [(), (20.0, -30.0, 10.0)], ids=['rests', 'moves'])
def test_the_bound_is_that_of_the_joint_information(uncertain, uncertain_codebook, velocity):
    """Position, velocity and nuisance parameters by finite differences of the mean, and the whole
    matrix inverted. In a region without height, the user does not move up or down."""
    uncertain = dataclasses.replace(uncertain, roi_size_m=(2, 3, 0) if velocity else (2, 3, 2))
    model = MeasurementModel(uncertain, uncertain_codebook)
    position = uncertain.sample_positions(1, np.random.default_rng(1))
    nuisance, n_moving = nuisance_of(uncertain), np.count_nonzero(uncertain.roi_size_m)
    n_parameters = 3 + len(nuisance) + n_moving
    state = np.zeros((1, 6))
    state[:, :3], state[:, 3:3 + len(velocity)] = position, velocity
    position = state[:, :3 + len(velocity)]

    def mean(values):
        offset = np.zeros(6)
        offset[:3], offset[3:3 + n_moving] = values[:3], 30 * values[n_parameters - n_moving:]
        factors = np.exp(np.tensordot(
            values[3:3 + len(nuisance)], nuisance.scaled_patterns, axes=1))
        return model.whiten(model.mean(state + offset) * factors).ravel()

    steps = 1e-5 * np.eye(n_parameters)
    slopes = np.stack([(mean(step) - mean(-step)) / 2e-5 for step in steps])
    information = 2 * (slopes @ slopes.conj().T).real
    information[3:, 3:] += np.diag([*nuisance.precision, *[1.0] * n_moving])
    expected = np.trace(np.linalg.inv(information)[:3, :3])
    assert crlb_of(model, position)[0] == pytest.approx(expected, rel=1e-5)
    information[:3, :3] += geometry.region_information(uncertain)
    expected = np.trace(np.linalg.inv(information)[:3, :3])
    assert crlb_of(model, position, region_prior=True)[0] == pytest.approx(expected, rel=1e-5)


def test_an_unknown_phase_is_a_wrapped_one(table1):
    """From half a turn on, a phase is uniform, whatever its standard deviation."""
    bounds = [crlb(dataclasses.replace(table1.scenario, band_phase_std_rad=std), table1.codebook,
                   table1.vectors['positions'], region_prior=True)
              for std in (0.5, 2 * np.pi, 1e3, 'unknown')]
    assert (bounds[0] < bounds[1]).all()
    np.testing.assert_allclose(bounds[1:3], [bounds[3]] * 2, rtol=1e-6)
    # The phases of the bands contain a common one.
    both = dataclasses.replace(
        table1.scenario, band_phase_std_rad='unknown', phase_std_rad='unknown')
    np.testing.assert_allclose(crlb(both, table1.codebook, table1.vectors['positions'],
                                    region_prior=True), bounds[3], rtol=1e-9)


@pytest.mark.parametrize('name', DECLARED)
def test_the_bound_of_an_unknown_value_is_the_limit_of_wide_priors(table1, name):
    wide = {'user_gain_std_db': 60.0, 'carrier_offset_std_hz': 1e6, 'timing_std_s': 1e-4}
    unknown, prior = (
        crlb(dataclasses.replace(table1.scenario, **{name: value}), table1.codebook,
             table1.vectors['positions'], region_prior=True)
        for value in ('unknown', wide.get(name, 100.0)))
    np.testing.assert_allclose(prior, unknown, rtol=1e-3)


@pytest.mark.parametrize('declared', CASES, ids=lambda declared: '+'.join(declared)[:24])
def test_an_impairment_raises_the_bound(table1, declared):
    scenario = dataclasses.replace(table1.scenario, **declared)
    bound = crlb(scenario, table1.codebook, table1.vectors['positions'])
    assert (bound > 1.0001 * table1.vectors['crlb']).all()


def test_the_region_is_an_upper_limit(small):
    mute = dataclasses.replace(small.scenario, user_gain=1e-6, noise_psd_dbm_hz=-100)
    bound = crlb(mute, small.codebook, small.vectors['positions'], region_prior=True)
    np.testing.assert_allclose(bound, np.sum(np.square(mute.roi_size_m)) / 12, rtol=1e-3)


def test_a_flat_region_determines_the_coordinate(table1):
    """The bound is that of a user whose height is known."""
    scenario = dataclasses.replace(table1.scenario, roi_size_m=(10.0, 10.0, 0.0))
    positions = table1.scenario.sample_positions(5, np.random.default_rng(0))
    found = crlb(scenario, table1.codebook, positions, region_prior=True)
    model = MeasurementModel(scenario, table1.codebook)
    information = fisher_information(model, positions)[:, :2, :2]
    expected = np.linalg.inv(information + np.eye(2) * 12 / 100).trace(axis1=1, axis2=2)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize('changes', [
    {'noise_psd_dbm_hz': -300.0}, {'noise_psd_dbm_hz': -250.0}, {'max_power_w': 1e6},
    {'multipath_to_los_db': 100.0},
    {'noise_psd_dbm_hz': -300.0, 'failed_element_share': 0.01, 'element_error_rms': 0.0}])
def test_a_singular_covariance_is_an_error_that_names_the_fields(random_beams, changes):
    """The multipath is the same in all sub-bands, and stronger than the noise by 15 orders."""
    scenario = Scenario(delay_spread_s=0.0, **changes)
    codebook = random_beams(scenario, np.random.default_rng(0))
    if scenario.failed_element_share:
        # The errors of the elements make the covariance regular.
        assert np.isfinite(crlb(scenario, codebook, [[10.0, 1.0, 0.2]])).all()
        with pytest.raises(ScenarioError, match='^noise_psd_dbm_hz: '):
            make_estimator('bayes', scenario, codebook).estimate(np.zeros((2, 32), complex) + 1e-6)
        return
    for call in (crlb, average_crlb):
        with pytest.raises(ScenarioError, match=(
                '^noise_psd_dbm_hz: .*multipath_to_los_db.*delay_spread_s.*singular')):
            call(scenario, codebook, [[10.0, 1.0, 0.2]])


def test_weak_noise_is_no_error_if_the_covariance_is_regular(random_beams):
    """Without noise, the bound depends on the multipath alone."""
    bounds = []
    for noise_psd_dbm_hz in (-250.0, -400.0):
        scenario = Scenario(noise_psd_dbm_hz=noise_psd_dbm_hz, max_power_w=1e6)
        codebook = random_beams(scenario, np.random.default_rng(0))
        bounds.append(crlb(scenario, codebook, [[10.0, 1.0, 0.2]]))
    np.testing.assert_allclose(*bounds, rtol=1e-6)


FRONT = Pose(uncertainty=(0.0, 0.0))
SIDE = Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0), (0.0, 0.0))
PLACES = np.array([[8.0, 1.0, 0.2], [14.0, -4.0, -0.9]])


@pytest.fixture(scope='module')
def model():
    scenario = Scenario(n_frames=2, elements_per_side=6)
    return MeasurementModel(scenario, random_codebook(scenario, np.random.default_rng(1)))


def at(model, pose):
    """Return the model with another pose of its surface."""
    return MeasurementModel(dataclasses.replace(model.scenario, pose=pose), model.beams)


def test_one_surface_at_the_origin_has_its_own_bound(model):
    np.testing.assert_allclose(site_crlb([at(model, FRONT)], PLACES), crlb_of(model, PLACES))


def test_the_bound_of_one_surface_does_not_depend_on_its_pose(model):
    np.testing.assert_allclose(
        site_crlb([at(model, SIDE)], PLACES), crlb_of(model, SIDE.to_surface(PLACES)))


def test_information_adds_up_in_the_frame_of_the_site(model):
    side = fisher_information(model, SIDE.to_surface(PLACES))
    # A turn by 90 degrees: x of the site is -y of the surface, and y of the site is its x.
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(
        site_information([at(model, FRONT), at(model, SIDE)], PLACES),
        fisher_information(model, PLACES) + turn @ side @ turn.T)


def test_the_bound_takes_velocities_in_the_frame_of_the_site(model):
    states = np.hstack([PLACES, np.tile([3e4, 2e4, 1e4], (len(PLACES), 1))])
    own = np.hstack([SIDE.to_surface(PLACES), SIDE.vectors_to_surface(states[:, 3:])])
    with pytest.raises(ValueError, match='positions: a masked array'):
        site_crlb([at(model, SIDE)], np.ma.array(states))
    found = site_crlb([at(model, SIDE)], states)
    np.testing.assert_allclose(found, crlb_of(model, own))
    assert not np.allclose(found, crlb_of(model, own[:, :3]), rtol=1e-3)


def test_a_second_surface_improves_the_bound(model):
    one, two = (site_crlb([at(model, pose) for pose in poses], PLACES)
                for poses in ([FRONT], [FRONT, SIDE]))
    assert (two < 0.7 * one).all()


def test_the_error_of_a_pose_adds_its_covariance(model):
    uncertain = dataclasses.replace(SIDE, uncertainty=(0.1, 1.0))
    exact, found = (np.linalg.inv(site_information([at(model, pose)], PLACES))
                    for pose in (SIDE, uncertain))
    np.testing.assert_allclose(found, exact + uncertain.spread(PLACES))


def test_a_surface_in_an_unknown_place_adds_nothing(model):
    lost = dataclasses.replace(SIDE, uncertainty=(1e6, 0.0))
    np.testing.assert_allclose(site_crlb([at(model, FRONT), at(model, lost)], PLACES),
                               site_crlb([at(model, FRONT)], PLACES), rtol=1e-6)


def test_a_user_behind_a_surface_is_refused(model):
    with pytest.raises(ValueError, match='in front of the surface'):
        site_crlb([at(model, SIDE)], np.array([[10.0, -11.0, 0.0]]))


def test_the_velocity_of_a_user_is_the_same_for_all_surfaces(model):
    """Two equal surfaces at one place are one with twice the signals."""
    scenario = dataclasses.replace(
        model.scenario, user_speed_std_mps=1.0, frame_duration_s=0.05, user_gain_std_db=1.0)
    walking = at(MeasurementModel(scenario, model.beams), FRONT)
    joint = 2 * fisher.joint_information_of(walking, PLACES)
    assert joint.shape[1:] == (7, 7)
    # The gain is another one for each of the surfaces.
    joint[:, 3, 3] += 2 * nuisance_of(scenario).precision[0]
    joint[:, range(4, 7), range(4, 7)] += 1.0
    expected = np.linalg.inv(joint)[:, :3, :3].trace(axis1=1, axis2=2)
    np.testing.assert_allclose(site_crlb([walking, walking], PLACES), expected)
    np.testing.assert_allclose(site_crlb([at(walking, SIDE)] * 2, PLACES), site_crlb(
        [walking, walking], SIDE.to_surface(PLACES)))
    np.testing.assert_allclose(site_crlb([walking], PLACES), crlb_of(walking, PLACES))
