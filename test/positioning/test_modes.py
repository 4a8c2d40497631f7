"""The modes of the posterior."""

import numpy as np
import pytest

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import simulate_pairs
from rhs_isac_ros.positioning.modes import LONG_SEARCH_STEPS, find_modes
from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.table import MIN_CURVATURE, TemplateTable
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.positioning.whitened import WhitenedModel


@pytest.fixture(scope='module')
def setting(shipped):
    """Model, table, whitened signals, positions and modes of some phases of Table I."""
    scenario = Scenario()
    model = WhitenedModel(scenario, shipped)
    table = TemplateTable(scenario, tabulate(model))
    positions, received = simulate_pairs(scenario, shipped, 30, 3)
    whitened = model.whiten(received)
    return model, table, whitened, positions, [find_modes(model, table, y) for y in whitened]


def square_residual(model, points, whitened):
    return np.sum(np.abs(whitened - model.mean(to_positions(points)))**2, axis=(1, 2))


def test_likelihoods_match_the_exact_model_in_the_region(setting):
    model, _, signals, _, found = setting
    low, high = model.scenario.roi_bounds_m
    errors = []
    for whitened, modes in zip(signals, found, strict=True):
        near = ((to_positions(modes.roi_points) > low - 0.05)
                & (to_positions(modes.roi_points) < high + 0.05)).all(axis=1)
        assert near.all()
        exact = -square_residual(model, modes.roi_points, whitened)
        errors += list(modes.roi_log_likelihood - exact)
    assert np.median(np.abs(errors)) < 0.05
    assert np.quantile(np.abs(errors), 0.9) < 1.0


def test_the_true_position_is_not_more_likely_than_the_best_mode(setting):
    """The best mode is a maximum; a failure means that the search missed a mode."""
    model, _, signals, positions, found = setting
    truths = np.array([-square_residual(model, to_polar(position[None]), whitened)[0]
                       for position, whitened in zip(positions, signals, strict=True)])
    best = np.array([modes.roi_log_likelihood.max() for modes in found])
    assert (best > truths - 0.3).all()
    # Half of a chi-square variable with three degrees of freedom.
    assert 0.5 < np.mean(best - truths) < 4


def test_modes_are_sorted_by_likelihood(setting):
    for modes in setting[4]:
        assert 1 <= len(modes.points) <= 32
        assert (np.diff(modes.roi_log_likelihood) <= 0).all()


def test_modes_are_separate(setting):
    for modes in setting[4]:
        distances = np.abs(modes.roi_points[:, None] - modes.roi_points) / [0.01, 0.02, 0.02]
        assert (distances.max(axis=2) + 2 * np.eye(len(distances)) >= 1).all()


def test_the_curvature_is_the_information_in_polar_coordinates(setting):
    model, table, signals, _, _ = setting
    modes = find_modes(model, table, signals[0], LONG_SEARCH_STEPS)
    by_point = jacobian(modes.points)
    information = fisher_information(
        model.scenario, model.codebook, to_positions(modes.points))
    expected = np.swapaxes(by_point, 1, 2) @ information @ by_point + np.diag(MIN_CURVATURE)
    inside = (np.abs(modes.roi_offset) < 1e-9).all(axis=1)
    assert inside.any()
    for found, exact in zip(modes.curvature[inside], expected[inside], strict=True):
        scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
        assert (np.abs(found - exact) / scale).max() < 0.1


def test_noiseless_signals_give_the_exact_position(random_beams):
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    model = WhitenedModel(scenario, random_beams(scenario, np.random.default_rng(1)))
    table = TemplateTable(scenario, tabulate(model))
    positions = scenario.sample_positions(10, np.random.default_rng(2))
    for position, whitened in zip(positions, model.mean(positions), strict=True):
        modes = find_modes(model, table, whitened, LONG_SEARCH_STEPS)
        assert np.linalg.norm(to_positions(modes.roi_points[0]) - position) < 1e-3
        assert modes.roi_log_likelihood[0] == pytest.approx(0, abs=1e-2)
