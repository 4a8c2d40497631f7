"""Modes of the posterior under sets of failed elements, and the growth of these sets."""

import collections
import dataclasses

import numpy as np
import pytest
from walking_users import system_of, users_of

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import blocks
from rhs_isac_ros.model.elements import DeclaredElements, ElementErrors
from rhs_isac_ros.model.geometry import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning import failures, make_estimator
from rhs_isac_ros.positioning import outside as outside_table
from rhs_isac_ros.positioning.alternatives import Blocked, Outside
from rhs_isac_ros.positioning.dispersed import DispersedLikelihood
from rhs_isac_ros.positioning.grid import Starts
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.outside import tabulate_outside
from rhs_isac_ros.positioning.search import OneState, ascend
from rhs_isac_ros.system import System

SCENARIO = Scenario(
    center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1), failed_element_share=0.02)
INTACT = dataclasses.replace(SCENARIO, failed_element_share=0.0)
# Two bands, with which sets are ambiguous.
AMBIGUOUS = dataclasses.replace(SCENARIO, center_frequencies_hz=(2.5e9, 3.1e9))
POSITION = np.array([4.2, 0.3, -0.1])
POINT = to_polar(POSITION)
NO_VALUES = np.zeros(0)


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


@pytest.fixture(scope='module')
def model(codebook):
    return failures.FailureModel(Likelihood(System(SCENARIO, codebook)))


def with_failures(elements, levels, n_elements=SCENARIO.n_elements) -> ElementErrors:
    stuck = np.full(n_elements, np.nan)
    stuck[list(elements)] = levels
    return ElementErrors(np.ones(n_elements, complex), stuck)


def real(vectors):
    """Real and imaginary parts of all bands, [..., 2 N_B S], for vectors [..., N_B, S]."""
    flat = vectors.reshape(*vectors.shape[:-2], -1)
    return np.concatenate([flat.real, flat.imag], axis=-1)


def real_covariance(covariance):
    """Covariance of `real` for circular signals with a covariance [N_B, S, S]."""
    n_bands, n_rows = covariance.shape[:2]
    whole = np.zeros((n_bands, n_rows, n_bands, n_rows), complex)
    whole[np.arange(n_bands), :, np.arange(n_bands)] = covariance
    whole = whole.reshape(n_bands * n_rows, -1)
    return np.block([[whole.real, -whole.imag], [whole.imag, whole.real]]) / 2


def test_the_likelihood_has_the_moments_of_surfaces_with_a_given_set(codebook, model):
    """Value, gradient and information follow from mean and covariance over the amplitudes.

    The real amplitudes of the direct path leave no circular signals.
    """
    failed = (3, 17)
    received = MeasurementModel(SCENARIO, codebook).sample(
        POSITION[None], np.random.default_rng(2))
    # Three-point quadrature with the moments of a uniform amplitude.
    nodes = 0.5 + np.array([-1, 0, 1]) / 2
    weights = np.array([1, 4, 1]) / 6
    mean, scattered, slopes = 0.0, 0.0, 0.0
    means, shares = [], []
    for first, one in zip(nodes, weights, strict=True):
        for second, two in zip(nodes, weights, strict=True):
            surface = MeasurementModel(INTACT, codebook, with_failures(failed, (first, second)))
            share = one * two
            means.append(surface.mean(POSITION[None])[0])
            shares.append(share)
            mean = mean + share * means[-1]
            scattered = scattered + share * surface.covariance()
            slopes = slopes + share * surface.mean_and_jacobian(POSITION[None])[1][0]
    covariance = real_covariance(scattered)
    for share, one in zip(shares, means, strict=True):
        deviation = real(one - mean)
        covariance = covariance + share * np.outer(deviation, deviation)

    inverse = np.linalg.inv(covariance)
    by_point = real(np.tensordot(jacobian(POINT[None])[0].T, slopes, 1))
    information = by_point @ inverse @ by_point.T
    residual = real(received[0] - mean)
    energy = residual @ inverse @ residual / 2
    gradient = by_point @ inverse @ residual
    # Whitened signals of unit covariance have the density exp(-|y|^2), without pi.
    volume = np.linalg.slogdet(covariance)[1] / 2 + len(residual) / 2 * np.log(2)
    log_prior = 2 * np.log(0.02) + 34 * np.log(0.98)

    signals = model.likelihood.signals(received)
    local = model.failed_set(failed).local(POINT[None], NO_VALUES[None], signals)
    floor = np.diag(model.likelihood.nuisance.floor)
    np.testing.assert_allclose(local.information[0] - floor, information, rtol=1e-6, atol=0.1)
    np.testing.assert_allclose(local.gradient[0], gradient, rtol=1e-6)
    assert local.residual[0] == pytest.approx(energy, rel=1e-6)
    average = np.linalg.slogdet(MeasurementModel(SCENARIO, codebook).covariance())[1].sum()
    assert local.value[0] == pytest.approx(log_prior - energy - volume + average, rel=1e-6)

    value, deviance = model.weigh(failed, model.places(POINT[None], NO_VALUES[None], signals))
    # The step exceeds no limit here.
    gain = gradient @ np.linalg.solve(information + floor, gradient) / 2
    prior = 2 * np.log(0.02 / 0.98)
    assert value[0] == pytest.approx(prior - energy - volume + gain, rel=1e-3)
    spread = volume - np.linalg.slogdet(scattered)[1].sum()
    assert deviance[0] == pytest.approx(energy - gain + spread, rel=1e-3)


def test_element_errors_have_their_covariance_at_the_position(codebook):
    """With no failure, the likelihood is that of element errors alone."""
    declared = dataclasses.replace(SCENARIO, element_error_rms=0.1)
    alone = Likelihood(System(dataclasses.replace(declared, failed_element_share=0.0), codebook))
    both = Likelihood(System(declared, codebook))
    points = to_polar(np.array([[3.1, 0.0, 0.2], POSITION, [4.9, -0.8, 0.4]]))
    received = MeasurementModel(declared, codebook).sample(
        to_positions(points), np.random.default_rng(3))
    values = np.zeros((3, 0))
    found = failures.FailureModel(both).failed_set(()).local(
        points, values, both.signals(received))
    expected = DispersedLikelihood(alone).local(points, values, alone.signals(received))
    for name in ('gradient', 'information', 'residual'):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6)
    shift = both.log_det - alone.log_det + 36 * np.log(0.98)
    np.testing.assert_allclose(found.value, expected.value + shift, rtol=1e-6)


@pytest.fixture(scope='module', params=[{}, {'user_gain_std_db': 1.0, 'timing_std_s': 1e-8}],
                ids=['position', 'gain and timing'])
def weighing(request, codebook):
    """A model, and the signals at the true position."""
    scenario = dataclasses.replace(SCENARIO, **request.param)
    received = MeasurementModel(scenario, codebook).sample(
        POSITION[None], np.random.default_rng(3))
    model = failures.FailureModel(Likelihood(System(scenario, codebook)))
    # As for a large surface.
    model.surfaces.parts = blocks(36, 10)
    (site,) = model.places(
        POINT[None], np.full((1, len(request.param)), 0.1), model.likelihood.signals(received))
    return model, site


def tolerance(model):
    """The covariance of the smaller set gives the information about nuisance parameters."""
    return {'rel': 0, 'abs': 0.1} if len(model.likelihood.nuisance) else {'rel': 1e-9}


def test_a_further_failure_is_weighed_as_the_larger_set(weighing):
    model, site = weighing
    values = model.weigh_extensions((5, 20), [site])[0]
    for element in (0, 12, 35):
        larger = tuple(sorted((5, 20, element)))
        (expected,), _ = model.weigh(larger, [site])
        assert values[element] == pytest.approx(expected, **tolerance(model))


def test_the_remainder_adds_to_the_covariance(weighing, codebook, monkeypatch):
    model, site = weighing
    values = model.weigh_extensions((5,), [site], 0.3)[0]
    remainder = 0.3 * DeclaredElements(SCENARIO).error_covariance(SCENARIO, codebook)
    for element in (0, 35):
        failed = tuple(sorted((5, element)))
        surface = model.surfaces.surface(failed)
        larger = surface._replace(covariance=surface.covariance + remainder)
        whitening = failures.Whitening.of(larger.covariance[None], model.likelihood.nuisance)
        monkeypatch.setattr(model.surfaces, 'whitening', lambda _, whitening=whitening: whitening)
        (expected,), _ = model.weigh(failed, [site])
        assert values[element] == pytest.approx(expected, **tolerance(model))


@pytest.mark.slow
def test_a_few_failures_cost_little_accuracy(codebook):
    """One Gaussian for all failures has several times the error."""
    rng = np.random.default_rng(5)
    positions = SCENARIO.sample_positions(12, rng)
    estimator = make_estimator('bayes', SCENARIO, codebook)
    exact = make_estimator('bayes', INTACT, codebook)
    errors = []
    for position in positions:
        model = MeasurementModel(INTACT, codebook, with_failures(
            rng.choice(36, 1, replace=False), rng.uniform(size=1)))
        estimate = estimator.estimate(model.sample(position[None], rng)[0])
        other = exact.estimate(MeasurementModel(INTACT, codebook).sample(position[None], rng)[0])
        errors.append([np.sum((estimate.mean - position)**2), np.sum((other.mean - position)**2)])
    own, undamaged = np.mean(errors, axis=0)
    assert own < 3 * undamaged


@pytest.mark.parametrize('share, enumerated', [(0.0, False), (0.02, True), (0.5, False)])
def test_sets_are_searched_if_failures_are_rare(share, enumerated):
    scenario = dataclasses.replace(SCENARIO, failed_element_share=share)
    assert failures.can_enumerate(scenario) is enumerated


@pytest.fixture(scope='module')
def ambiguous(random_beams):
    """The model of two bands."""
    codebook = random_beams(AMBIGUOUS, np.random.default_rng(1))
    return failures.FailureModel(Likelihood(System(AMBIGUOUS, codebook)))


def sample_with(model, failed, seed):
    rng = np.random.default_rng(seed)
    intact = dataclasses.replace(model.likelihood.scenario, failed_element_share=0.0)
    surface = with_failures(failed, rng.uniform(size=len(failed)))
    return MeasurementModel(intact, model.likelihood.codebook, surface).sample(
        POSITION[None], rng)


def search_at_the_truth(model, received):
    search = failures.FailureSearch(model, model.likelihood.signals(received))
    return search, search.add(POINT[None], NO_VALUES[None])


@pytest.mark.slow
def test_sets_grow_to_the_true_one_or_to_one_that_is_more_probable(ambiguous):
    rng = np.random.default_rng(6)
    for seed in range(12):
        failed = tuple(sorted(rng.choice(36, 3, replace=False).tolist()))
        search, sites = search_at_the_truth(ambiguous, sample_with(ambiguous, failed, seed))
        search.grow(sites, 0.3)
        (true,), _ = ambiguous.weigh(failed, search.places[:1])
        assert search.log_probabilities[search.best] >= true - 1e-6


@pytest.mark.parametrize('range_m, level_db', [(14.0, 0.0), (1e7, 20.0)], ids=['far', 'blocked'])
def test_users_elsewhere_have_the_evidence_of_the_true_set(
        codebook, range_m, level_db, monkeypatch):
    """Relative to an average over surfaces, and up to the sets that explain signals as well."""
    failed, point = (3, 17), np.array([[range_m, 0.2, -0.1]])
    likelihood = Likelihood(System(SCENARIO, codebook))
    elements, average = failures.FailedElements(likelihood), DispersedLikelihood(likelihood)
    surface = MeasurementModel(SCENARIO, codebook, with_failures(failed, [0.1, 0.8]))
    received = 10**(level_db / 20) * surface.sample(
        to_positions(point), np.random.default_rng(3))
    monkeypatch.setattr(outside_table, '_TEMPLATES', 1000)
    elsewhere = (Blocked(SCENARIO, likelihood.model) if level_db
                 else Outside(SCENARIO, tabulate_outside(likelihood.model)))
    points, values, share, level = elsewhere.places(
        likelihood.signals(received).whitened[0], likelihood.nuisance)
    assert 0.9 < share <= 1
    signals = likelihood.signals(received / level)
    starts = Starts(np.zeros(len(points), int), points, values)
    known, averaged = (
        ascend(conditional, elements._elsewhere, starts, signals, 8).log_mass
        for conditional in (elements._model.failed_set(failed), average))
    assert known > averaged + 3
    assert known - averaged - 0.5 < elements.gain(points, values, signals) < known - averaged + 6
    assert OneState(likelihood).gain(points, values, signals) == 0


def test_users_who_walk_have_the_failed_elements_of_users_at_rest(codebook, model):
    """Sets are compared with sets, also in another scenario."""
    walking = Likelihood(System(dataclasses.replace(
        SCENARIO, frame_duration_s=0.015, user_speed_std_mps=1.0), codebook))
    at_rest, found = model.failed_set((3, 17)), failures.FailedElements(walking)
    known = failures.FailureModel(walking).failed_set((3, 17))
    signals = walking.signals(MeasurementModel(SCENARIO, codebook).sample(
        POSITION[None], np.random.default_rng(2)))
    values = np.zeros((1, len(walking.nuisance)))
    assert (found.same(at_rest).local(POINT[None], values, signals).value
            == known.local(POINT[None], values, signals).value)


def test_elements_fail_at_the_place_of_each_frame():
    """What a failure changes is linear in the elements, also while users walk."""
    system, rng = system_of(failed_element_share=0.01), np.random.default_rng(2)
    model = failures.FailureModel(Likelihood(system))
    prior, intact = model.likelihood.nuisance, dataclasses.replace(
        system.scenario, failed_element_share=0.0)
    state = users_of(system.scenario, 1, 1.0, rng)
    point, values = to_polar(state[:, :3]), np.zeros((1, len(prior)))
    values[:, :2] = state[:, 3:5]
    changes, amplitudes = model.effects_of([3, 17], model.places(
        point, values, model.likelihood.signals(system.sample(state, rng))))

    def mean_and_slopes(failed, *at):
        return MeasurementModel(intact, system.codebook, with_failures(
            failed, at, intact.n_elements)).mean_and_jacobian(*prior.states(point, values))
    before, usual, wider = (mean_and_slopes(*one) for one in (
        ((), ), ((3, 17), 0.5, 0.5), ((3, 17), 0.5 + 12**-0.5, 0.5)))
    scale = np.abs(before[0]).max()
    np.testing.assert_allclose(changes[:, 0, 0].sum(axis=0), (before[0] - usual[0])[0],
                               atol=1e-12 * scale)
    np.testing.assert_allclose(changes[:, 0, 1:6].sum(axis=0), (usual[1] - before[1])[0],
                               atol=1e-12 * np.abs(before[1]).max())
    for found in (amplitudes[0], model.failed_set((3, 17)).at(point, values).linear[:, 0]):
        np.testing.assert_allclose(found, wider[0] - usual[0], atol=1e-12 * scale)


def test_sets_of_a_small_surface_grow_to_all_elements(random_beams):
    scenario = dataclasses.replace(
        AMBIGUOUS, elements_per_side=2, failed_element_share=0.1)
    codebook = random_beams(scenario, np.random.default_rng(1))
    model = failures.FailureModel(Likelihood(System(scenario, codebook)))
    strong = 100 * MeasurementModel(scenario, codebook).mean(POSITION[None])
    search, sites = search_at_the_truth(model, strong)
    search.grow(sites)
    assert max(len(failed) for failed, _ in search.log_probabilities) == 4


def test_few_hypotheses_of_each_set_and_of_each_site_are_extended():
    ranked = [((1,), site) for site in range(10)] + [((set_,), 0) for set_ in range(2, 20)]
    chosen = failures._diverse(ranked)
    sets, sites = (collections.Counter(one) for one in zip(*chosen, strict=True))
    assert max(sets.values()) == failures._PER_SET
    assert max(sites.values()) == failures._PER_PLACE
    different = [((number,), number) for number in range(2 * failures._EXTENDED)]
    assert failures._diverse(different) == different[:failures._EXTENDED]


def test_neighbours_differ_by_one_element(ambiguous):
    search, sites = search_at_the_truth(ambiguous, sample_with(ambiguous, (3, 17), 0))
    search.try_neighbours(((3, 17), sites[0][1]))
    sets = [set(failed) for failed, _ in search.log_probabilities if failed]
    assert {3} in sets
    assert {17} in sets
    assert all(len(one ^ {3, 17}) <= 2 for one in sets)
    assert any(len(one) == 3 for one in sets)


def test_sets_grow_from_the_best_points_and_from_the_best_of_each_direction():
    # 100 ranges in each of three directions, the more probable direction first.
    points = np.array([(4 + 0.01 * n, u, 0.1) for u in (0.05, 0.35, 0.65) for n in range(100)])
    chosen = failures.first_places(points, np.array([0.1, 0.1, 0.1]))
    assert len(set(chosen)) == 64
    assert chosen[:32] == list(range(32))
    # The first direction has had its turns.
    assert chosen[32:] == [n for pair in zip(range(100, 116), range(200, 216), strict=True)
                           for n in pair]
    assert failures.first_places(points[:5], np.ones(3)) == list(range(5))


def test_signals_that_agree_with_hundreds_of_sets_and_places_determine_no_position(random_beams):
    """The largest 48 hypotheses are then a small part of the posterior, and of its evidence."""
    scenario = Scenario(
        center_frequencies_hz=(9.89e9,), n_subbands=10, subband_width_hz=1.15e6, n_frames=2,
        elements_per_side=(3, 7), element_interval_wavelengths=0.5, multipath_to_los_db=-22.0,
        max_power_w=4e-10, roi_center_m=(4.8, -0.6, -1.6), roi_size_m=(3.6, 0, 4.6),
        phase_std_rad=0.15, failed_element_share=0.0178)
    codebook = random_beams(scenario, np.random.default_rng(0))
    positions, received = System(scenario, codebook).pairs(10, 0)
    estimate = make_estimator('bayes', scenario, codebook, reject_outside=True).estimate(received)
    errors = (estimate.mean - positions)[estimate.fix][:, ::2]
    covariance = estimate.covariance[estimate.fix][:, ::2, ::2]
    squares = np.sum(errors * np.linalg.solve(covariance, errors[..., None])[..., 0], axis=1)
    assert len(squares) >= 9
    assert np.mean(squares) < 3


def test_a_gain_does_not_make_failures_of_an_intact_surface_probable(random_beams):
    """Far from a fit, the slope along a gain is steeper than its expected curvature allows."""
    scenario = Scenario(
        center_frequencies_hz=(1.8e9, 2.1e9), n_subbands=10, n_frames=1, elements_per_side=(11, 5),
        element_interval_wavelengths=0.3, multipath_to_los_db=-20.0, noise_psd_dbm_hz=-142.0,
        roi_center_m=(23.0, 18.0, -3.0), roi_size_m=(3.5, 11.0, 14.0), user_gain_std_db=0.6,
        failed_element_share=0.006)
    codebook = random_beams(scenario, np.random.default_rng(0))
    intact = dataclasses.replace(scenario, failed_element_share=0.0)
    positions, received = System(intact, codebook).pairs(6, 0)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)
    errors = estimate.mean - positions
    squares = np.sum(errors * np.linalg.solve(
        estimate.covariance, errors[..., None])[..., 0], axis=1)
    assert (squares < 16).all()
