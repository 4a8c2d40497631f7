"""The evidence for a user outside of the region of interest."""

import dataclasses

import numpy as np
import pytest
from scipy.special import ive, logsumexp
from scipy.stats import norm

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import make_estimator, outside, simulate_pairs
from rhs_isac_ros.positioning.coordinates import to_positions
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.outside import OUTSIDE_LIMIT, Outside, tabulate_outside


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
    points = outside._points(outside._ranges(scenario), outside._directions(scenario))
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
    ranges = outside._ranges(scenario)[[0, -1]]
    n = 400_000
    direction = rng.normal(size=(n, 3))
    direction[:, 0] = np.abs(direction[:, 0])
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    # Half a step beyond both ends, as the cells of the grid.
    ratio = np.sqrt(outside._RANGE_RATIO)
    distance = rng.uniform(ranges[0] / ratio, ranges[1] * ratio, n)
    positions = distance[:, None] * direction
    positions = positions[np.linalg.norm(
        positions - np.clip(positions, *scenario.roi_bounds_m), axis=1) > 0.25]
    means = model.whiten(model.mean(positions))
    return signals, positions, -np.sum(np.abs(signals - means)**2, axis=(1, 2))


def test_evidence_is_the_average_likelihood(setting, reference):
    scenario, _, arrays = setting
    signals, _, exponent = reference
    highest = exponent.max()
    expected = highest + np.log(np.mean(np.exp(exponent - highest)))
    found = Outside(scenario, arrays).log_evidence(signals)[0]
    assert found == pytest.approx(expected, abs=0.5)


def test_the_evidence_is_the_average_over_an_unknown_gain(random_beams):
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook = random_beams(scenario, np.random.default_rng(1))
    received = MeasurementModel(scenario, codebook).sample(
        np.array([[8.0, 1.0, 0.5]]), np.random.default_rng(6))
    declared = dataclasses.replace(scenario, user_gain_std_db=0.5)
    likelihood = Likelihood(declared, codebook)
    table = Outside(declared, tabulate_outside(likelihood.model))
    std = 0.5 * np.log(10) / 20
    gains = np.linspace(-6, 6, 601) * std
    signals = likelihood.model.whiten(received * np.exp(-gains)[:, None, None])
    exponent = np.array([table.log_evidence(one)[0] for one in signals])
    exponent += norm(scale=std).logpdf(gains) - 2 * received.size * gains
    expected = logsumexp(exponent) + np.log(gains[1] - gains[0])
    found = table.log_evidence_of(
        likelihood.model.whiten(received)[0], np.zeros(1), 0.0, likelihood.nuisance)
    assert found == pytest.approx(expected, abs=0.1)


def test_a_factor_is_that_of_the_signals(setting, reference):
    """Weak signals make directions more alike, so that more of them matter."""
    scenario, _, arrays = setting
    table, signals = Outside(scenario, arrays), 3 * reference[0]
    scales = (0.02, 0.2, 1.0, 3.0)
    expected = [table.log_evidence(scale * signals)[0] for scale in scales]
    np.testing.assert_allclose(table.log_evidence(signals, scales), expected, rtol=0, atol=1e-3)


def test_bessel_function():
    argument = np.concatenate([np.linspace(0, 5, 100), np.geomspace(5, 1e4, 50)])
    expected = argument + np.log(ive(0, argument))
    np.testing.assert_allclose(outside._log_bessel(argument), expected, rtol=0, atol=0.04)


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
    table = Outside(model.scenario, arrays)
    signals = model.whiten(model.mean(np.array([[5.0, -2.0, 1.0]])))[0]
    assert table.log_evidence(signals)[0] == -np.inf
    assert not table.explain(signals, 1e9)


def test_templates_cover_all_ranges():
    """Wide bands and large surfaces need more templates."""
    counts = []
    for change in ({}, {'subband_width_hz': 12.5e6}, {'elements_per_side': 30}):
        scenario = dataclasses.replace(Scenario(), **change)
        ranges = outside._ranges(scenario)
        nodes, index = outside._template_ranges(scenario, ranges)
        assert (np.diff(index) >= 0).all()
        assert set(index) == set(range(len(nodes)))
        counts.append(len(nodes))
    assert counts[0] < 6
    assert counts[1] > counts[0] < counts[2]


@pytest.mark.slow
@pytest.mark.parametrize('name', ['bayes', 'ml'])
def test_users_around_the_region_get_no_fix_or_a_probability_outside(name, shipped):
    """The shell extends from 0.5 m to 20 m."""
    scenario, rng = Scenario(), np.random.default_rng(2)
    low, high = scenario.roi_bounds_m
    positions = rng.uniform([0, -25, -21], [35, 25, 21], (600, 3))
    distance = np.linalg.norm(positions - np.clip(positions, low, high), axis=1)
    positions = positions[(distance >= 0.5) & (distance <= 20)][:200]
    assert len(positions) == 200
    received = MeasurementModel(scenario, shipped).sample(positions, rng)
    estimator = make_estimator(name, scenario, shipped, reject_outside=True)
    estimate = estimator.estimate(received)
    fix = estimate.fix
    assert fix.mean() < 0.1
    assert (estimate.outside_probability[fix] > 0.05).mean() > 0.7
    assert (estimate.outside_probability <= OUTSIDE_LIMIT)[fix].all()
    # Residuals of users who may be outside are not compared with an expectation.
    assert np.isnan(estimate.expected_residual[fix]).mean() > 0.5
    reasons = [reason for reason in estimate.reason if reason]
    rejected = [
        reason for reason in reasons if reason.startswith('position outside of the region')]
    assert len(rejected) > 0.9 * len(reasons)
    inside = simulate_pairs(scenario, shipped, 300, 5)[1]
    found = estimator.estimate(inside)
    assert found.fix.mean() > 0.99
    # Position and covariance are those of a user inside.
    plain = make_estimator(name, scenario, shipped).estimate(inside)
    np.testing.assert_array_equal(found.mean[found.fix], plain.mean[found.fix])
    np.testing.assert_array_equal(found.covariance[found.fix], plain.covariance[found.fix])
    assert np.isnan(plain.outside_probability).all()
    assert (found.outside_probability < 0.05).mean() > 0.9
    np.testing.assert_array_equal(
        np.isfinite(found.expected_residual[found.fix]),
        found.outside_probability[found.fix] <= 0.05)
