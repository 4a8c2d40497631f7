"""Users outside of the region, and users without a direct path."""

import copy
import dataclasses

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import binom, norm

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario, gaussian, simulate_received
from rhs_isac_ros.model.arrays import adjoint
from rhs_isac_ros.model.geometry import to_positions
from rhs_isac_ros.model.hall import CONDITIONS, MultipathEstimate
from rhs_isac_ros.model.impairments import draw_impairments
from rhs_isac_ros.model.los import draw_blocked
from rhs_isac_ros.positioning import Mixture, Tracker, make_estimator
from rhs_isac_ros.positioning import outside as outside_table
from rhs_isac_ros.positioning.alternatives import (
    BLOCKED_LIMIT,
    LIMIT,
    Blocked,
    Outside,
    log_ratios_of,
)
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.nuisance import NuisancePrior
from rhs_isac_ros.positioning.outside import OutsideTemplates, tabulate_outside
from rhs_isac_ros.positioning.search import OneState
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.system import System


@pytest.fixture(scope='module')
def setting(random_beams):
    """A scenario with a small region, its model and the arrays."""
    scenario = Scenario(n_subbands=2, n_frames=4, elements_per_side=5, roi_center_m=(3, 0, 0),
                        roi_size_m=(1, 1, 1), max_power_w=1e-6)
    codebook = random_beams(scenario, np.random.default_rng(0))
    model = MeasurementModel(scenario, codebook).prepare()
    return scenario, model, tabulate_outside(model)


def test_the_prior_excludes_the_region_and_its_border(setting):
    scenario, _, arrays = setting
    weights = arrays['outer_weights']
    assert weights.sum() == pytest.approx(1)
    points = outside_table._points(
        outside_table._ranges(scenario), outside_table._directions(scenario))
    assert points.shape[:2] == weights.shape
    positions = to_positions(points)
    distance = np.linalg.norm(
        positions - np.clip(positions, *scenario.roi_bounds_m), axis=-1)
    # The nearest vertex of the region is at 2.5 m.
    np.testing.assert_array_equal(weights > 0, distance > 0.25)
    # The farthest corner of the region is at 3.57 m.
    assert 3 * 3.57 < points[..., 0].max() < 1.15 * 3 * 3.57


@pytest.fixture(scope='module')
def reference(setting):
    """Signals, random positions of the prior, and their exact log-likelihoods."""
    scenario, model, _ = setting
    rng = np.random.default_rng(1)
    user = np.array([[7.0, 2.0, 1.0]])
    signals = model.whiten(model.sample(user, rng))[0]
    ranges = outside_table._ranges(scenario)[[0, -1]]
    n = 80_000
    direction = rng.normal(size=(n, 3))
    direction[:, 0] = np.abs(direction[:, 0])
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    # Half a step beyond both ends, as the cells of the grid.
    ratio = np.sqrt(outside_table._RANGE_RATIO)
    distance = rng.uniform(ranges[0] / ratio, ranges[1] * ratio, n)
    positions = distance[:, None] * direction
    positions = positions[np.linalg.norm(
        positions - np.clip(positions, *scenario.roi_bounds_m), axis=1) > 0.25]
    means = model.whiten(model.mean(positions))
    return signals, positions, -np.sum(np.abs(signals - means)**2, axis=(1, 2))


def test_evidence_is_the_average_likelihood(setting, reference):
    scenario, model, arrays = setting
    signals, _, exponent = reference
    highest = exponent.max()
    expected = highest + np.log(np.mean(np.exp(exponent - highest)))
    (found,) = OutsideTemplates(scenario, arrays).log_evidence_of(
        signals[None], NuisancePrior(model))
    assert found == pytest.approx(expected, abs=0.5)


def test_the_evidence_is_the_average_over_an_unknown_gain(random_beams):
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook = random_beams(scenario, np.random.default_rng(1))
    received = MeasurementModel(scenario, codebook).sample(
        np.array([[8.0, 1.0, 0.5]]), np.random.default_rng(6))
    declared = dataclasses.replace(scenario, user_gain_std_db=0.5)
    likelihood = Likelihood(System(declared, codebook))
    arrays = tabulate_outside(likelihood.model)
    table, known = OutsideTemplates(declared, arrays), NuisancePrior(MeasurementModel(
        scenario, codebook))
    std = 0.5 * np.log(10) / 20
    gains = np.linspace(-6, 6, 601) * std
    signals = likelihood.model.whiten(received * np.exp(-gains)[:, None, None])
    exponent = table.log_evidence_of(signals, known)
    exponent += norm(scale=std).logpdf(gains) - 2 * received.size * gains
    expected = logsumexp(exponent) + np.log(gains[1] - gains[0])
    (found,) = Outside(declared, arrays).log_evidence_of(
        likelihood.model.whiten(received), np.zeros((1, 1)), likelihood.nuisance)
    assert found == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize('level_db', [-3.0, 2.0])
@pytest.mark.parametrize('median_db, std_db', [(-1.5, 1.2), (0.0, 3.0)])
def test_the_evidence_is_the_average_over_an_unknown_level(setting, level_db, median_db, std_db):
    """The multipath of the user is stronger or weaker than the covariance says."""
    scenario, model, arrays = setting
    prior, rng = NuisancePrior(model), np.random.default_rng(2)
    signals = model.whiten(model.sample(np.array([[7.0, 2.0, 1.0]]), rng))
    signals *= 10**(level_db / 20)
    normal = np.linspace(-6, 6, 121)
    levels = 10**((median_db + std_db * normal) / 10)
    exponent = [OutsideTemplates(scenario, arrays | {
        'outer_filters': arrays['outer_filters'] / np.float32(level**0.5),
        'outer_energy': arrays['outer_energy'] / np.float32(level)
    }).log_evidence_of(signals / level**0.5, prior)[0] - signals.size * np.log(level)
        for level in levels]
    expected = logsumexp(exponent + norm().logpdf(normal)) + np.log(normal[1] - normal[0])
    (found,) = Outside(scenario, arrays, level=gaussian.UnknownLevel(
        signals.size, (median_db, std_db))).log_evidence_of(signals, np.zeros((1, 0)), prior)
    assert found == pytest.approx(expected, abs=1.0)


def test_the_evidence_is_the_average_over_an_unknown_timing(random_beams):
    """Whichever parameters the signals alone suggest."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1), timing_std_s=2e-8)
    likelihood = Likelihood(System(
        scenario, random_beams(scenario, np.random.default_rng(1))))
    prior, outside = likelihood.nuisance, Outside(scenario, tabulate_outside(likelihood.model))
    signals = likelihood.signals(likelihood.model.sample(
        np.array([[8.0, 1.0, 0.5]]), np.random.default_rng(7)))
    (timing,) = np.flatnonzero(prior.moves_multipath)
    values = np.zeros((1201, len(prior)))
    values[:, timing] = np.linspace(-4, 4, len(values))
    exponent = outside.log_evidence_of(
        likelihood.whitened(values, signals), np.zeros_like(values), prior
    ) - prior.log_evidence_of_aligned(np.zeros(len(prior))) + norm().logpdf(values[:, timing])
    expected = logsumexp(exponent) + np.log(8 / 1200)
    best = values[np.argmax(exponent)]
    starts, alone = best + np.array([[-2.0], [0.0], [2.0]]) * prior.axes[0], []
    for start in starts:
        (found,), at, _ = log_ratios_of(
            outside, likelihood, signals, signals.whitened, start[None], start[None],
            np.array([expected]))
        assert found == pytest.approx(0, abs=0.05)
        np.testing.assert_allclose(at, best[None], atol=0.5 * prior.axes[0, timing])
        alone.append(found)
    # Shots that take more steps do not affect others.
    together = select(signals, [0, 0, 0])
    found, _, _ = log_ratios_of(
        outside, likelihood, together, together.whitened, starts, starts, np.full(3, expected))
    np.testing.assert_allclose(found, alone, rtol=0, atol=1e-9)


def test_the_range_of_a_user_outside_may_explain_what_a_timing_changes(random_beams):
    """The timing is then less certain than from the multipath alone."""
    scenario = Scenario(
        center_frequencies_hz=(3e9,), n_subbands=2, n_frames=1, subband_width_hz=8e6,
        delay_spread_s=5e-10, elements_per_side=6, multipath_to_los_db=-10.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1), timing_std_s=3e-8)
    likelihood = Likelihood(System(
        scenario, random_beams(scenario, np.random.default_rng(1))))
    prior, outside = likelihood.nuisance, Outside(scenario, tabulate_outside(likelihood.model))
    assert len(prior) == 1
    assert prior.axes[0, 0] < 0.25
    shots = likelihood.signals(likelihood.model.sample(np.array(
        [[8.0, 1.0, 0.5], [4.0, 0.5, 0.2], [6.0, -3.0, 1.0], [3.5, 3.0, -1.0]]),
        np.random.default_rng(7)))
    values, expected = np.linspace(-4, 4, 401)[:, None], []
    for shot in range(4):
        exponent = outside.log_evidence_of(
            likelihood.whitened(values, select(shots, [shot])), np.zeros_like(values), prior
        ) - prior.log_evidence_of_aligned(np.zeros(1)) + norm().logpdf(values[:, 0])
        expected.append(logsumexp(exponent) + np.log(8 / 400))
    start = np.zeros((4, 1))
    found, _, _ = log_ratios_of(
        outside, likelihood, shots, shots.whitened, start, start, np.array(expected))
    np.testing.assert_allclose(found, 0.0, atol=0.5)


@pytest.fixture(scope='module')
def failing(setting):
    """The likelihood if elements may have failed, their states, and some signals."""
    scenario, model, _ = setting
    declared = dataclasses.replace(scenario, failed_element_share=0.04, element_error_rms=0.02)
    likelihood = Likelihood(System(declared, model.beams))
    signals = model.sample(np.array([[7.0, 2.0, 1.0]]), np.random.default_rng(1))
    return likelihood, OneState(likelihood), signals


def test_blocked_users_have_no_errors_of_the_direct_path(failing):
    likelihood, elements, signals = failing
    states = elements.states(MeasurementModel.covariance_in_shadow)
    assert len(states) > 2
    # Users at a great distance have a negligible direct path.
    far, failures = np.array([[1e7, 0.0, 0.0]]), np.arange(len(states))
    intact, declared = (
        MeasurementModel(dataclasses.replace(likelihood.scenario, failed_element_share=share),
                         likelihood.codebook).covariance_at(far)[0] for share in (0.0, 0.04))
    (whitened,) = likelihood.model.whiten(signals)
    for n, state in zip(failures, states, strict=True):
        covariance = intact + n / (25 * 0.04) * (declared - intact)
        energy = np.sum(signals[0].conj() * np.linalg.solve(
            covariance, signals[0][..., None])[..., 0]).real
        assert state.energy(whitened) == pytest.approx(energy)
        log_det = np.linalg.slogdet(covariance)[1].sum()
        assert state.offset == pytest.approx(
            binom.logpmf(n, 25, 0.04) + likelihood.log_det - log_det, abs=1e-3)


@pytest.mark.parametrize('multipath_db', [-15.0, 0.0])
def test_the_level_of_a_blocked_user_does_not_scale_the_noise(failing, multipath_db):
    likelihood, _, signals = failing
    scenario = dataclasses.replace(likelihood.scenario, multipath_to_los_db=multipath_db)
    likelihood = Likelihood(System(scenario, likelihood.codebook))
    states = OneState(likelihood).states(MeasurementModel.covariance_in_shadow)
    blocked = Blocked(scenario, likelihood.model, states)
    normal, whitened = np.linspace(-5, 5, 401), likelihood.model.whiten(signals)
    noise, log_densities = scenario.noise_power_w * np.eye(signals.shape[-1]), []
    root = likelihood.model.combined_root
    for state in states:
        covariance = root @ np.linalg.inv(state.operator) @ adjoint(root)
        multipath = 10**normal[:, None, None, None] * (covariance - noise) + noise
        energies = np.sum((signals.conj() * np.linalg.solve(
            multipath, signals[..., None])[..., 0]).real, axis=(1, 2))
        log_densities.append(
            binom.logpmf(len(log_densities), 25, 0.04) - energies
            + likelihood.log_det - np.linalg.slogdet(multipath)[1].sum(axis=1))
    expected = logsumexp(log_densities + norm.logpdf(normal)) + np.log(normal[1] - normal[0])
    (found,) = blocked.log_evidence_of(whitened, np.zeros((1, 0)), likelihood.nuisance)
    assert found == pytest.approx(expected, abs=0.01)


def test_templates_have_the_covariance_of_their_state(failing):
    """As if the signals were whitened by this covariance."""
    likelihood, elements, signals = failing
    state = elements.states(MeasurementModel.covariance)[2]
    model, arrays = likelihood.model, tabulate_outside(likelihood.model)
    root = np.linalg.inv(adjoint(np.linalg.cholesky(state.operator)))
    changed = copy.copy(model)
    vars(changed).update(
        combined_root=model.combined_root @ root, root=model.root @ root,
        combined_whitener=np.linalg.inv(model.combined_root @ root),
        whitener=np.linalg.inv(model.root @ root))
    found, expected = (
        OutsideTemplates(model.scenario, *args).log_evidence_of(
            one.whiten(signals), likelihood.nuisance)[0]
        for one, args in ((model, (arrays, state)), (changed, (tabulate_outside(changed),))))
    assert found == pytest.approx(expected + state.offset, abs=0.02)


def test_templates_outside_fit_a_measured_multipath(pytestconfig):
    """They have other sub-bands than the survey."""
    hall, codebook = Scenario.from_yaml(
        pytestconfig.rootpath / 'config' / 'hall.yaml'), Codebook.default()
    _, received = System(hall, codebook).pairs(4, seed=2)
    inside, anywhere = (
        make_estimator('bayes', hall, codebook, reject_outside=rejects).estimate(received)
        for rejects in (False, True))
    np.testing.assert_array_equal(anywhere.mean, inside.mean)
    assert np.isfinite(anywhere.outside_probability).all()


@pytest.mark.parametrize(('range_m', 'noise_dbm_hz', 'std_db'), [
    (6.0, -135.0, 4.0), (6.0, -115.0, 4.0), (12.0, -105.0, 4.0), (6.0, -115.0, np.inf)])
def test_a_gain_outside_does_not_scale_the_noise(
        setting, random_beams, range_m, noise_dbm_hz, std_db):
    """The evidence is the average over users of known gains."""
    scenario = dataclasses.replace(
        setting[0], noise_psd_dbm_hz=noise_dbm_hz, multipath_to_los_db=-6.0,
        user_gain_std_db=std_db)
    codebook = random_beams(scenario, np.random.default_rng(0))
    likelihood = Likelihood(System(scenario, codebook))
    known = dataclasses.replace(scenario, user_gain_std_db=0.0)
    received = MeasurementModel(known, codebook).sample(
        to_positions(np.array([[range_m, 0.3, 0.1]])), np.random.default_rng(1))
    gains_db, logs = np.linspace(-12, 12, 25), []
    for gain_db in gains_db:
        one = dataclasses.replace(known, user_gain=10**(gain_db / 20))
        of_gain = Likelihood(System(one, codebook))
        logs.append(Outside(one, tabulate_outside(of_gain.model)).log_evidence_of(
            of_gain.signals(received).whitened, np.zeros((1, 0)), of_gain.nuisance)[0]
            - of_gain.log_det + likelihood.log_det)
    # Without a prior, the density is that of a Gaussian of one neper at its centre.
    width = min(std_db * np.log(10) / 20, 1.0) * np.sqrt(2 * np.pi)
    prior = np.log(np.log(10) / 20 / width) - (gains_db / std_db)**2 / 2
    expected = logsumexp(logs + prior)
    outside = Outside(scenario, tabulate_outside(likelihood.model))
    signals = likelihood.signals(received).whitened
    alone = outside.log_evidence_of(signals, np.zeros((1, 1)), likelihood.nuisance)[0]
    ratio = outside.noise_ratio(signals[0], likelihood)
    assert ratio > 0.5
    assert alone + ratio == pytest.approx(expected, abs=0.3)


def test_noise_alone_says_nothing_about_users_outside_of_an_unknown_gain(setting, random_beams):
    scenario = dataclasses.replace(setting[0], user_gain_std_db=np.inf)
    codebook = random_beams(scenario, np.random.default_rng(0))
    hidden = MeasurementModel(dataclasses.replace(
        scenario, user_gain_std_db=0.0, user_gain=1e-6), codebook)
    received = hidden.sample(
        to_positions(np.tile([3.0, 0.1, 0.1], (20, 1))), np.random.default_rng(3))
    probability = make_estimator(
        'bayes', scenario, codebook, reject_outside=True).estimate(received).outside_probability
    assert probability.mean() == pytest.approx(0.5, abs=0.1)
    assert probability.min() > 0.2


@pytest.mark.parametrize('change, n', [
    ({'failed_element_share': 0.01}, 2), ({'timing_std_s': 1e-7}, 16)], ids=['failures', 'timing'])
def test_neither_failures_nor_offsets_explain_users_elsewhere(change, n, pytestconfig):
    config, rng = pytestconfig.rootpath / 'config', np.random.default_rng(0)
    scenario = dataclasses.replace(
        Scenario.from_yaml(config / 'bandplan.yaml'), blocked_probability=0.2, **change)
    codebook = Codebook.load(config / 'codebook_bandplan.yaml')
    estimator = make_estimator('bayes', scenario, codebook, reject_outside=True)
    inside = scenario.sample_positions(n, rng)

    def n_fixes(positions, blocked):
        model = MeasurementModel(
            dataclasses.replace(scenario, blocked_probability=blocked), codebook)
        return estimator.estimate(model.sample(positions, rng)).fix.sum()
    assert n_fixes(inside, 0.0) >= n - n // 8
    assert n_fixes(inside * [1, 0, 1] + [0, 8, 0], 0.0) <= n // 8
    assert n_fixes(inside, 1.0) == 0


def test_explained_signals_have_a_small_residual(setting):
    scenario, model, arrays = setting
    table = Outside(scenario, arrays)
    signals = model.whiten(model.mean(np.array([[5.0, -2.0, 1.0]])))[0]
    assert table.explain(signals, 10.0)
    assert not table.explain(signals + 10 * np.abs(signals).max(), 10.0)


def test_a_region_that_leaves_no_space_outside_is_always_accepted(setting):
    _, model, _ = setting
    arrays = tabulate_outside(model)
    arrays['outer_weights'][:] = 0
    table = OutsideTemplates(model.scenario, arrays)
    signals = model.whiten(model.mean(np.array([[5.0, -2.0, 1.0]])))[0]
    assert table.log_evidence_of(signals[None], NuisancePrior(model)) == [-np.inf]
    assert not table.explain(signals, 1e9)


def test_templates_cover_all_ranges():
    """Wide bands and large surfaces need more templates."""
    counts = []
    for change in ({}, {'subband_width_hz': 12.5e6}, {'elements_per_side': 30}):
        scenario = dataclasses.replace(Scenario(), **change)
        ranges = outside_table._ranges(scenario)
        nodes, index = outside_table._template_ranges(scenario, ranges)
        assert (np.diff(index) >= 0).all()
        assert set(index) == set(range(len(nodes)))
        counts.append(len(nodes))
    assert counts[0] < 6
    assert counts[1] > counts[0] < counts[2]


def test_users_around_the_region_get_no_fix_or_a_probability_outside(shipped, table1_estimator):
    """The shell extends from 0.5 m to 20 m."""
    scenario, rng = Scenario(), np.random.default_rng(2)
    low, high = scenario.roi_bounds_m
    positions = rng.uniform([0, -25, -21], [35, 25, 21], (300, 3))
    distance = np.linalg.norm(positions - np.clip(positions, low, high), axis=1)
    positions = positions[(distance >= 0.5) & (distance <= 20)][:100]
    assert len(positions) == 100
    received = MeasurementModel(scenario, shipped).sample(positions, rng)
    estimator = make_estimator('bayes', scenario, shipped, reject_outside=True)
    estimate = estimator.estimate(received)
    fix = estimate.fix
    assert fix.mean() < 0.03
    assert (estimate.outside_probability <= LIMIT)[fix].all()
    reasons = [reason for reason in estimate.reason if reason]
    rejected = [
        reason for reason in reasons if reason.startswith('position outside of the region')]
    assert len(rejected) > 0.9 * len(reasons)
    inside = System(scenario, shipped).pairs(300, 5)[1]
    found = estimator.estimate(inside)
    assert found.fix.mean() > 0.97
    assert (found.outside_probability <= LIMIT)[found.fix].all()
    # Residuals of users who may be outside are not compared with an expectation.
    # Position and covariance are those of a user inside.
    plain = table1_estimator.estimate(inside)
    np.testing.assert_array_equal(found.mean[found.fix], plain.mean[found.fix])
    np.testing.assert_array_equal(found.covariance[found.fix], plain.covariance[found.fix])
    assert np.isnan(plain.outside_probability).all()
    assert np.isnan(plain.blocked_probability).all()
    assert (found.outside_probability < 0.05).mean() > 0.9
    np.testing.assert_array_equal(
        np.isfinite(found.expected_residual[found.fix]),
        found.outside_probability[found.fix] <= 0.05)


def test_the_prior_shifts_the_odds_of_a_user_outside(shipped):
    received = System(Scenario(), shipped).pairs(40, 6)[1]
    log_odds = {}
    for prior in (0.5, 0.02):
        scenario = dataclasses.replace(Scenario(), outside_probability=prior)
        found = make_estimator('bayes', scenario, shipped, reject_outside=True).estimate(received)
        log_odds[prior] = np.log(found.outside_probability / (1 - found.outside_probability))
    usual = np.abs(log_odds[0.5]) < 20
    assert usual.sum() > 10
    np.testing.assert_allclose(
        (log_odds[0.02] - log_odds[0.5])[usual], np.log(0.02 / 0.98), atol=1e-4)
    none = dataclasses.replace(Scenario(), outside_probability=0.0)
    found = make_estimator('bayes', none, shipped, reject_outside=True).estimate(received)
    assert np.isnan(found.outside_probability).all()


def test_no_position_is_less_probable_than_its_alternatives(shipped):
    """Also if users may be outside or blocked, and in a track."""
    scenario = dataclasses.replace(Scenario(), blocked_probability=0.1)
    estimator = make_estimator('bayes', scenario, shipped, reject_outside=True)
    tracker, rng = Tracker(estimator), np.random.default_rng(8)
    places = np.linspace([8.0, 2.0, 0.0], [8.0, 14.0, 0.0], 40)
    received = MeasurementModel(Scenario(), shipped).sample(places, rng)
    probable = []
    for step, one in enumerate(received):
        found, alone = tracker.update(0.2 * step, one), estimator.estimate(one)
        for estimate in (found, alone):
            if estimate.fix and not getattr(estimate, 'is_predicted', False):
                assert estimate.outside_probability + estimate.blocked_probability <= LIMIT
            elif estimate.fix:
                assert estimate.outside_probability <= LIMIT
        probable.append(alone.fix)
    # The user leaves the region at y = 5 m.
    assert np.mean(probable[:8]) > 0.8
    assert np.mean(probable[-25:]) < 0.1


N_USERS = 60
DECLARED = dataclasses.replace(Scenario(), blocked_probability=0.3)


def signals_of(scenario, codebook, seed):
    """Positions, signals and which users are blocked."""
    positions = Scenario().sample_positions(N_USERS, np.random.default_rng(0))
    received = MeasurementModel(scenario, codebook).sample(
        positions, np.random.default_rng(seed))
    # As in `MeasurementModel.sample`, after the impairments.
    rng = np.random.default_rng(seed)
    draw_impairments(scenario, N_USERS, rng)
    blocked = draw_blocked(scenario, N_USERS, rng)
    return positions, received, blocked


def test_blocked_users_have_the_multipath_alone(shipped):
    """Signals of users in sight do not depend on the probability."""
    positions, received, blocked = signals_of(DECLARED, shipped, 1)
    assert 0.2 < blocked.mean() < 0.4
    plain = MeasurementModel(Scenario(), shipped).sample(positions, np.random.default_rng(1))
    model = MeasurementModel(Scenario(), shipped)
    np.testing.assert_array_equal(received[~blocked], plain[~blocked])
    np.testing.assert_allclose(
        (plain - received)[blocked], model.mean(positions[blocked]), atol=1e-12)
    element_by_element = simulate_received(
        DECLARED, shipped, positions, np.random.default_rng(1))
    before = simulate_received(Scenario(), shipped, positions, np.random.default_rng(1))
    np.testing.assert_array_equal(
        (element_by_element != before).any(axis=(1, 2)), blocked)


@pytest.mark.parametrize(('name', 'change', 'reject_outside'), [
    ('bayes', {}, True), ('ml', {}, False), ('bayes', {'user_gain_std_db': 3.0}, False),
    ('bayes', {'carrier_offset_std_hz': 500.0, 'phase_std_rad': 6.3}, False),
    ('bayes', {'element_error_rms': 0.05}, True)],
    ids=['bayes', 'ml', 'gain', 'carrier', 'elements'])
def test_the_probability_of_blocked_users_is_calibrated(name, change, reject_outside, shipped):
    scenario = dataclasses.replace(DECLARED, **change)
    _, received, blocked = signals_of(scenario, shipped, 2)
    estimate = make_estimator(
        name, scenario, shipped, reject_outside=reject_outside).estimate(received)
    # Multipath alone may also be a weak direct path from outside.
    outside = np.nan_to_num(estimate.outside_probability)
    probability = estimate.blocked_probability + outside
    if not reject_outside:
        assert probability.mean() == pytest.approx(blocked.mean(), abs=0.12)
        assert (estimate.fix <= (probability <= BLOCKED_LIMIT)).all()
        reasons = [reason for reason in estimate.reason if reason]
        assert np.mean([one.startswith('blocked: probability') for one in reasons]) > 0.5
    assert probability[blocked].mean() > probability[~blocked].mean() + 0.3


def test_the_inflation_of_a_survey_makes_no_user_in_sight_blocked(shipped):
    """The residuals are weaker than the inflated covariance, as those of a blocked user are."""
    declared = Scenario(multipath_to_los_db=-8.0)
    scenario = dataclasses.replace(declared, blocked_probability=0.3)
    _, received, blocked = signals_of(scenario, shipped, 3)
    model, inflation = MeasurementModel(scenario, shipped), 6.0
    n_bands, n_rows = model.shape
    fields = declared.fields()
    found = {std_db: make_estimator('bayes', dataclasses.replace(
        scenario, multipath=MultipathEstimate(
            declared.multipath_to_los_db + 10 * np.log10(inflation), declared.delay_spread_s,
            declared.angular_spread_deg, np.array(model.radiation),
            np.zeros((n_bands, n_rows, n_rows), complex),
            {name: fields[name] for name in CONDITIONS},
            {'inflation': inflation, 'level_std_db': std_db})), shipped).estimate(received)
        for std_db in (1.0, 0.0)}
    estimate, fixed = found.values()
    # Without the level, signals in sight would be weaker than the multipath.
    assert estimate.fix[~blocked].mean() > 0.95
    assert estimate.fix[blocked].mean() < 0.1
    # The residual reveals the level, and with it the size of the region.
    both = estimate.fix & fixed.fix
    level = inflation * estimate.residual / estimate.expected_residual
    n, variance = n_bands * n_rows, (np.log(10) / 10)**2
    sizes = [np.trace(one.covariance[both], axis1=1, axis2=2) for one in (estimate, fixed)]
    expected = sizes[1] * level[both]**(variance / (variance + 1 / n))
    usual = np.isfinite(expected) & (expected < 10)
    assert usual.mean() > 0.8
    np.testing.assert_allclose(sizes[0][usual], expected[usual], rtol=1e-6)


def test_a_track_continues_through_a_blockage(shipped):
    scenario, rng = Scenario(), np.random.default_rng(4)
    declared = dataclasses.replace(scenario, blocked_probability=0.1)
    tracker = Tracker(make_estimator('bayes', declared, shipped))
    model = MeasurementModel(scenario, shipped)
    places = np.linspace([7.0, -1.0, 0.0], [7.0, 1.4, 0.0], 13)
    received = model.sample(places, rng)
    received[8:12] -= model.mean(places[8:12])
    found = [tracker.update(0.2 * step, one) for step, one in enumerate(received)]
    lost = [one for one in found[8:12] if one.blocked_probability > BLOCKED_LIMIT]
    assert lost
    for one in found[6:]:
        assert one.fix
        assert one.reason == ''
    errors = [np.linalg.norm(one.mean - place) for one, place in zip(found, places, strict=True)]
    assert max(errors[8:]) < 1.0
    assert np.trace(found[11].covariance) > np.trace(found[7].covariance)
    # Without signals in sight, the track ends.
    late = tracker.update(20.0, received[9])
    assert late.reason.startswith('blocked') and not late.fix


def test_a_blocked_user_near_the_prior_is_not_outside(shipped):
    """Signals without a direct path may also be those of a distant user, but not of this one."""
    scenario = Scenario(blocked_probability=0.05)
    rng = np.random.default_rng(3)
    positions = scenario.sample_positions(12, rng)
    received = MeasurementModel(
        dataclasses.replace(scenario, blocked_probability=1.0), shipped).sample(positions, rng)
    estimator = make_estimator('bayes', scenario, shipped, reject_outside=True)
    reasons = [str(estimator.posterior(one, Mixture(
        np.zeros(1), position[None], 0.09 * np.eye(3)[None])).reason)
        for one, position in zip(received, positions, strict=True)]
    assert np.mean([one.startswith('blocked') for one in reasons]) > 0.8
