"""Posteriors with a mixture as prior."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import chdtri

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Pose, Scenario
from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.elements import draw_surface
from rhs_isac_ros.model.gaussian import quadratic_form
from rhs_isac_ros.model.geometry import jacobian, region_information, to_polar
from rhs_isac_ros.positioning import BayesEstimator, Mixture, Motion, Tracker, prior
from rhs_isac_ros.positioning.lattice import Resolution, lay_grid
from rhs_isac_ros.positioning.likelihood import Signals
from rhs_isac_ros.positioning.prior import cells_of, constant_shares, multiply
from rhs_isac_ros.positioning.search import Modes, marginal_at
from rhs_isac_ros.positioning.segments import concatenate, select
from rhs_isac_ros.positioning.sheets import Sheets
from rhs_isac_ros.system import System

PLACE = np.array([8.5, -1.5, 0.2])
STD_M = 0.15
POSE = Pose((1.0, -2.0, 0.5), (0.1, -0.2, 0.6, 0.8))
REGION_RADIUS = float(chdtri(3, 0.05))


def around(place, std_m=STD_M):
    return Mixture(np.zeros(1), np.asarray(place, float)[None], std_m**2 * np.eye(3)[None])


@pytest.fixture(scope='module')
def model(shipped):
    return MeasurementModel(Scenario(), shipped)


@pytest.fixture
def lazy(shipped):
    """An estimator that has not seen the codebook."""
    return BayesEstimator(System(Scenario(), shipped), lazy=True)


def has_searched_the_region(estimator):
    return '_region' in vars(estimator)


@pytest.mark.parametrize('pose', [Pose(), POSE], ids=['at the origin', 'elsewhere'])
def test_a_bent_mixture_has_the_moments_of_range_and_directions(pose):
    rng, std_m = np.random.default_rng(1), np.array([0.03, 0.5, 0.3])
    mixture = around(pose.to_site(PLACE))._replace(
        covariances=pose.covariances_to_site(np.diag(std_m**2))[None])
    points = to_polar(pose.to_surface(mixture.sample(200_000, rng)))
    bent = Sheets.from_mixture(mixture, pose)
    stds = np.sqrt(np.diagonal(bent.covariances[0]))
    np.testing.assert_allclose(
        (points.mean(axis=0) - bent.means[0]) / stds, 0.0, atol=0.03)
    np.testing.assert_allclose(
        np.cov(points.T) / np.outer(stds, stds), bent.covariances[0] / np.outer(stds, stds),
        atol=0.03)


def test_a_flattened_mixture_has_the_moments_of_the_position():
    """A sheet, 5 mm thick and half a metre wide, around a surface."""
    rng = np.random.default_rng(2)
    point = to_polar(PLACE)
    covariance = np.diag([0.005, 0.06, 0.04])**2
    points = rng.multivariate_normal(point, covariance, 200_000)
    w = np.sqrt(1 - np.sum(points[:, 1:]**2, axis=1))
    positions = POSE.to_site(points[:, :1] * np.column_stack([w, points[:, 1:]]))
    flat = Sheets(np.zeros(1), point[None], covariance[None]).to_mixture(POSE)
    np.testing.assert_allclose(flat.means[0], positions.mean(axis=0), atol=5e-3)
    np.testing.assert_allclose(flat.covariances[0], np.cov(positions.T), atol=2e-3)
    # The mean is beside the sheet, by much more than it is thick.
    assert np.linalg.norm(POSE.to_surface(flat.means[0])) < point[0] - 0.015


def test_bending_leaves_velocities_and_their_correlation():
    covariance = np.eye(6) + 0.3
    mixture = Mixture(np.zeros(1), np.array([[*PLACE, 1.0, 2.0, 3.0]]), 1e-4 * covariance[None])
    again = Sheets.from_mixture(mixture, POSE).to_mixture(POSE)
    np.testing.assert_allclose(again.means, mixture.means, atol=1e-4)
    np.testing.assert_allclose(again.covariances, mixture.covariances, rtol=1e-3, atol=1e-8)


def test_what_is_behind_the_surface_is_left_out():
    behind, before = around([-2.0, 0.3, 0.1]), around(PLACE)
    sheets = Sheets.from_mixture(concatenate(behind, before), Pose())
    np.testing.assert_array_equal(sheets.means, Sheets.from_mixture(before, Pose()).means)
    with pytest.raises(ValueError, match='mixture: means at x = -2 m'):
        Sheets.from_mixture(behind, Pose())


def test_the_search_covers_four_standard_deviations():
    scenario, rng = Scenario(), np.random.default_rng(3)
    grid, resolution = lay_grid(scenario), Resolution.of(scenario)
    chosen = cells_of(Sheets.from_mixture(around(PLACE), Pose()), grid, resolution)
    offsets = rng.standard_normal((500, 3))
    offsets *= 3.9 * STD_M / np.linalg.norm(offsets, axis=1)[:, None]
    points, part = to_polar(PLACE + offsets), grid.within(chosen)
    apart = np.abs(points[:, None] - part.points)
    half = np.column_stack([
        part.widths_m[part.range_bin] / 2,
        np.tile(0.2 * resolution.direction, (len(part.node), 1))])
    assert (apart <= 1.01 * half).all(axis=2).any(axis=1).all()
    assert np.count_nonzero(chosen) < 0.1 * len(chosen)


@pytest.mark.parametrize('share', [0.25, 1.0])
def test_a_share_is_an_exponent_of_the_likelihood(monkeypatch, share):
    point, before = to_polar(PLACE), Sheets.from_mixture(around(PLACE + [0.1, -0.2, 0.05]), Pose())
    curvature = np.diag(1 / np.array([0.1, 0.02, 0.03])**2)
    modes = Modes(np.zeros(1, int), point[None], np.zeros((1, 3)), curvature[None], np.zeros(1),
                  np.zeros((1, 0)), np.zeros(1), np.zeros(1, int))

    def quadratic(conditional, likelihood, points, values, signals):
        offsets = points - point
        slopes = -offsets @ curvature
        return np.sum(offsets * slopes, axis=1) / 2, slopes, curvature[None]

    monkeypatch.setattr(prior, 'expanded_at', quadratic)
    likelihood = SimpleNamespace(nuisance=SimpleNamespace(carried=lambda values, *points: values))
    found = multiply(before, modes, share, [None], likelihood, Signals(*np.zeros((2, 1))),
                     Scenario().roi_bounds_m, np.zeros(3)).bent
    precision = np.linalg.inv(before.covariances[0])
    covariance = np.linalg.inv(precision + share * curvature)
    np.testing.assert_allclose(found.covariances[0], covariance, atol=1e-12)
    np.testing.assert_allclose(
        found.means[0], covariance @ (precision @ before.means[0] + share * curvature @ point))


@pytest.mark.slow
def test_the_posterior_is_the_prior_times_the_likelihood(table1_estimator, model):
    """The reference weighs points drawn from the prior with the exact likelihood."""
    rng, errors = np.random.default_rng(5), []
    for place in ([8.5, -1.5, 0.2], [6.0, 2.0, -0.3], [11.0, 0.5, 0.1]):
        # A second mode, 0.6 m away, is improbable.
        prior = around(place + 0.1 * rng.standard_normal(3), 0.1)
        signals = model.sample(np.array([place]), rng)[0]
        found = table1_estimator.posterior(signals, prior, wrong=1e-9)
        points = prior.sample(30_000, rng)
        residual = model.whiten(signals - model.mean(points))
        logs = -np.sum(np.abs(residual)**2, axis=(1, 2))
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        mean = weights @ points
        spread = np.cov(points.T, aweights=weights, ddof=0)
        error = found.mean - mean
        errors.append(error @ np.linalg.solve(spread, error))
        np.testing.assert_allclose(
            np.linalg.slogdet(found.covariance)[1], np.linalg.slogdet(spread)[1],
            atol=0.5)
        mean_of_mixture, _ = found.mixture.moments()
        np.testing.assert_allclose(mean_of_mixture, found.mean, atol=1e-9)
    # The reference has an effective number of about fifty points.
    assert np.mean(errors) < 0.1


@pytest.mark.slow
def test_modes_with_unknown_phases_are_as_broad_as_the_likelihood_near_the_prior():
    """The reference weighs points drawn from the prior with the likelihood at each of them."""
    scenario = Scenario(elements_per_side=6, n_frames=4, band_phase_std_rad='unknown')
    beams, rng = random_codebook(scenario, np.random.default_rng(0)), np.random.default_rng(1)
    estimator, errors, sizes = BayesEstimator(System(scenario, beams)), [], []
    likelihood, bounds = estimator._likelihood, scenario.roi_bounds_m
    for place in scenario.sample_positions(10, rng):
        density = around(place + STD_M * rng.standard_normal(3))
        signals = estimator.system.sample(place[None], rng)
        found = estimator.posterior(signals[0], density, wrong=1e-9)
        points = density.sample(4000, rng)
        points = points[((points >= bounds[0]) & (points <= bounds[1])).all(axis=1)]
        logs, _, _ = marginal_at(
            likelihood, likelihood, to_polar(points),
            np.zeros((len(points), len(likelihood.nuisance))),
            select(likelihood.signals(signals), np.zeros(len(points), int)))
        weights, _ = mixture_weights(logs)
        error, spread = found.mean - weights @ points, np.cov(points.T, aweights=weights, ddof=0)
        errors.append(error @ np.linalg.solve(spread, error))
        sizes.append(np.linalg.slogdet(found.covariance)[1] - np.linalg.slogdet(spread)[1])
    assert np.mean(errors) < 0.1
    np.testing.assert_allclose(sizes, 0, atol=0.5)


@pytest.mark.slow
def test_a_codebook_that_has_not_been_seen_gives_the_same_posterior(
        lazy, table1_estimator, model):
    rng = np.random.default_rng(7)
    for _ in range(5):
        prior = around(PLACE + STD_M * rng.standard_normal(3))
        signals = model.sample(PLACE[None], rng)[0]
        found, expected = (
            one.posterior(signals, prior) for one in (lazy, table1_estimator))
        error = found.mean - expected.mean
        assert error @ np.linalg.solve(expected.covariance, error) < 0.05
        np.testing.assert_allclose(found.covariance, expected.covariance, atol=3e-3)
    assert not has_searched_the_region(lazy)


def test_the_region_is_searched_if_the_signals_disagree_with_the_prior(
        lazy, table1_estimator, model):
    place = np.array([13.0, 3.5, -0.4])
    signals = model.sample(place[None], np.random.default_rng(8))[0]
    found = lazy.posterior(signals, around(PLACE))
    assert has_searched_the_region(lazy)
    alone = table1_estimator.estimate(signals)
    assert np.linalg.norm(found.mean - alone.mean) < 0.2
    offset = found.mean - place
    assert offset @ np.linalg.solve(found.covariance, offset) < REGION_RADIUS


def test_a_prior_behind_the_surface_is_wrong(lazy, table1_estimator, model):
    signals = model.sample(PLACE[None], np.random.default_rng(2))[0]
    free = table1_estimator.estimate(signals)
    for estimator in (lazy, table1_estimator):
        found = estimator.posterior(signals, around(-PLACE))
        np.testing.assert_allclose(found.mean, free.mean, atol=0.1)


@pytest.mark.parametrize(('options', 'message'), [
    ({'wrong': 0.0}, 'wrong: 0.0, expected a probability between 0 and 1'),
    ({'wrong': 1.0}, 'wrong: 1.0, expected'), ({'wrong': np.nan}, 'wrong: nan, expected'),
    ({'share': 0.0}, 'share: 0.0, expected an exponent above 0'),
    ({'share': 2.0}, 'share: 2.0, expected'), ({'n_before': -1}, 'n_before: -1.0, expected')])
def test_an_argument_out_of_range_is_named(table1_estimator, options, message):
    with pytest.raises(ValueError, match=message):
        table1_estimator.posterior(np.zeros((2, 32)), around(PLACE), **options)


@pytest.mark.parametrize('options', [{'wrong': 0.2}, {'share': 0.5}, {'n_before': 1}])
def test_an_argument_without_effect_is_named(table1_estimator, options):
    (name,) = options
    with pytest.raises(ValueError, match=f'{name}: .*, expected together with a prior'):
        table1_estimator.posterior(np.zeros((2, 32)), **options)


def test_positions_are_in_the_frame_of_the_surface_and_mixtures_in_that_of_the_site(
        shipped, table1_estimator, model):
    placed = BayesEstimator(System(dataclasses.replace(Scenario(), pose=POSE), shipped))
    signals = model.sample(PLACE[None], np.random.default_rng(9))[0]
    expected = table1_estimator.posterior(signals, around(PLACE))
    found = placed.posterior(signals, around(POSE.to_site(PLACE)))
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-6)
    np.testing.assert_allclose(
        found.mixture.moments()[0], POSE.to_site(expected.mixture.moments()[0]), atol=1e-6)


def test_without_a_prior_the_mixture_is_that_of_the_region(table1_estimator, model):
    signals = model.sample(PLACE[None], np.random.default_rng(10))[0]
    found = table1_estimator.posterior(signals)
    mean, covariance = found.mixture.moments()
    np.testing.assert_allclose(mean, found.mean, atol=1e-9)
    np.testing.assert_allclose(covariance, found.covariance, atol=1e-9)
    assert found.mixture.log_mass == pytest.approx(0.0, abs=1e-9)


def test_signals_without_a_position_have_no_mixture(table1_estimator, model):
    signals = 1e3 * model.sample(PLACE[None], np.random.default_rng(11))[0]
    found = table1_estimator.posterior(signals, around(PLACE))
    assert found.mixture is None
    assert 'residual' in found.reason


ERRONEOUS = Scenario(elements_per_side=6, n_frames=4, element_error_rms=0.05)


@pytest.fixture(scope='module')
def codebook():
    return random_codebook(ERRONEOUS, np.random.default_rng(0))


def test_without_errors_of_elements_nothing_is_constant(codebook):
    exact = dataclasses.replace(ERRONEOUS, element_error_rms=0.0)
    np.testing.assert_array_equal(constant_shares(MeasurementModel(exact, codebook)), np.zeros(3))


def test_shares_are_those_of_steps_with_drawn_surfaces(codebook):
    """The steps are from signals without multipath and noise, with elements of many surfaces."""
    rng, model = np.random.default_rng(1), MeasurementModel(ERRONEOUS, codebook)
    positions = ERRONEOUS.sample_positions(40, rng)
    by_point = jacobian(to_polar(positions))
    mean, slopes = model.mean_and_jacobian(positions, by_point, whitened=True)
    slopes = slopes.reshape(len(positions), 3, -1)
    covariance = np.linalg.inv(quadratic_form(slopes) + np.swapaxes(
        by_point, 1, 2) @ region_information(ERRONEOUS) @ by_point)
    steps = []
    for _ in range(100):
        surface = draw_surface(ERRONEOUS, rng)
        exact = MeasurementModel(dataclasses.replace(ERRONEOUS, element_error_rms=0.0), codebook,
                                 surface)
        change = model.whiten(exact.mean(positions)) - mean
        pull = 2 * np.einsum('npr,nr->np', slopes.conj(), change.reshape(len(change), -1)).real
        steps.append(np.matmul(covariance, pull[..., None])[..., 0])
    shares = np.mean(np.square(steps), axis=0) / np.diagonal(covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(constant_shares(model), shares.mean(axis=0), rtol=0.15)


@pytest.mark.slow
def test_a_track_is_no_better_than_the_errors_that_all_phases_share(codebook):
    estimator = BayesEstimator(System(ERRONEOUS, codebook))
    rng, place = np.random.default_rng(2), np.array([8.0, 0.5, 0.2])
    tracker, model = Tracker(estimator, Motion()), MeasurementModel(ERRONEOUS, codebook)
    for time_s in range(8):
        found = tracker.update(time_s, model.sample(place[None], rng)[0])
    constant = found.mixture.constant_covariance
    assert (np.linalg.eigvalsh(constant) > 0).all()
    assert (np.linalg.eigvalsh(found.covariance - constant) > 0).all()
    assert (np.linalg.eigvalsh(tracker.predict(8.0)[1] - constant) > 0).all()
