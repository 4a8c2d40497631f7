"""The modes of the posterior."""

import numpy as np
import pytest

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import simulate_pairs
from rhs_isac_ros.positioning.modes import LONG_SEARCH, find_modes
from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.table import LEAST_CURVATURE, TemplateTable
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.positioning.whitened import WhitenedModel


@pytest.fixture(scope='module')
def setting(shipped):
    """Modes of some phases of Table I, with the model, the whitened signals and positions."""
    scenario = Scenario()
    model = WhitenedModel(scenario, shipped)
    table = TemplateTable(scenario, tabulate(model))
    positions, received = simulate_pairs(scenario, shipped, 30, 3)
    whitened = model.whiten(received)
    return model, table, whitened, positions, [find_modes(model, table, y) for y in whitened]


def misfit(model, points, whitened):
    return np.sum(np.abs(whitened - model.mean(to_positions(points)))**2, axis=(1, 2))


def test_heights_are_those_of_the_exact_likelihood_in_the_region(setting):
    model, _, signals, _, found = setting
    low, high = model.scenario.roi_bounds_m
    errors = []
    for whitened, modes in zip(signals, found, strict=True):
        near = ((to_positions(modes.inside) > low - 0.05)
                & (to_positions(modes.inside) < high + 0.05)).all(axis=1)
        assert near.all()
        errors += list(modes.height + misfit(model, modes.inside, whitened))
    assert np.median(np.abs(errors)) < 0.05
    assert np.quantile(np.abs(errors), 0.9) < 1.0


def test_the_truth_is_not_above_the_best_mode(setting):
    """The best mode is a maximum: the truth has less likelihood, and not for want of search."""
    model, _, signals, positions, found = setting
    truths = np.array([-misfit(model, to_polar(position[None]), whitened)[0]
                       for position, whitened in zip(positions, signals, strict=True)])
    best = np.array([modes.height.max() for modes in found])
    assert (best > truths - 0.3).all()
    # Half of a chi-square variable with three degrees of freedom.
    assert 0.5 < np.mean(best - truths) < 4


def test_the_highest_mode_is_first_and_none_is_far_below(setting):
    for modes in setting[4]:
        assert 1 <= len(modes.points) <= 32
        assert (np.diff(modes.height) <= 0).all()


def test_modes_lie_apart(setting):
    for modes in setting[4]:
        gaps = np.abs(modes.inside[:, None] - modes.inside) / [0.01, 0.02, 0.02]
        assert (gaps.max(axis=2) + 2 * np.eye(len(gaps)) >= 1).all()


def test_the_curvature_is_the_information_in_polar_coordinates(setting):
    model, table, signals, _, _ = setting
    modes = find_modes(model, table, signals[0], LONG_SEARCH)
    bend = jacobian(modes.points)
    information = fisher_information(
        model.scenario, model.codebook, to_positions(modes.points))
    expected = np.swapaxes(bend, 1, 2) @ information @ bend + np.diag(LEAST_CURVATURE)
    settled = (modes.gap == 0).all(axis=1) | (np.abs(modes.gap) < 1e-9).all(axis=1)
    assert settled.any()
    for own, other in zip(modes.curvature[settled], expected[settled], strict=True):
        scale = np.sqrt(np.outer(np.diag(other), np.diag(other)))
        assert (np.abs(own - other) / scale).max() < 0.1


def test_signals_without_noise_lead_to_the_position(random_beams):
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
        roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    model = WhitenedModel(scenario, random_beams(scenario, np.random.default_rng(1)))
    table = TemplateTable(scenario, tabulate(model))
    positions = scenario.sample_positions(10, np.random.default_rng(2))
    for position, whitened in zip(positions, model.mean(positions), strict=True):
        modes = find_modes(model, table, whitened, LONG_SEARCH)
        assert np.linalg.norm(to_positions(modes.inside[0]) - position) < 1e-3
        assert modes.height[0] == pytest.approx(0, abs=1e-2)
