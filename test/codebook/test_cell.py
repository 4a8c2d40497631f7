"""Priors of the position for which codebooks are optimised."""

import numpy as np
import pytest
from scipy.stats import truncnorm

from rhs_isac_ros.codebook.cell import REGION, Cell
from rhs_isac_ros.model import Scenario

SCENARIO = Scenario(roi_center_m=(5, 0, 0), roi_size_m=(4, 2, 1))
CELL = Cell((6.8, 0.2, 0.0), 0.3)


def drawn(prior, n=20_000):
    return prior.positions(SCENARIO, SCENARIO.sample_positions(n, np.random.default_rng(1)))


def test_positions_of_a_cell_are_gaussian_up_to_the_border_of_the_region():
    found, (low, high) = drawn(CELL), SCENARIO.roi_bounds_m
    centre = np.array(CELL.centre_m)
    expected = truncnorm((low - centre) / 0.3, (high - centre) / 0.3, centre, 0.3)
    np.testing.assert_allclose(found.mean(axis=0), expected.mean(), atol=0.01)
    np.testing.assert_allclose(found.std(axis=0), expected.std(), rtol=0.03)
    assert ((found >= low) & (found <= high)).all()


def test_a_region_without_extent_along_an_axis_has_one_value():
    flat = Scenario(roi_center_m=(5, 0, 0.5), roi_size_m=(4, 2, 0))
    uniform = flat.sample_positions(50, np.random.default_rng(2))
    np.testing.assert_array_equal(Cell((5, 0, 0.5), 0.3).positions(flat, uniform)[:, 2], 0.5)


def test_the_box_of_a_cell_is_in_the_region_and_leaves_everything_else():
    box = CELL.box(SCENARIO)
    np.testing.assert_allclose(box.roi_bounds_m, [[5.9, -0.7, -0.5], [7.0, 1.0, 0.5]])
    assert box.center_frequencies_hz == SCENARIO.center_frequencies_hz


def test_confusions_count_with_the_root_of_the_ratio_of_the_densities():
    first, second = drawn(CELL, 30), drawn(REGION, 30)
    log_ratio = (np.sum((first - CELL.centre_m)**2, axis=1)
                 - np.sum((second - CELL.centre_m)**2, axis=1)) / (2 * 0.3**2)
    np.testing.assert_allclose(
        CELL.ratios(first, second), np.minimum(np.exp(log_ratio / 2), 1.0))
    np.testing.assert_array_equal(REGION.ratios(first, second), 1.0)
    assert CELL.ratios(second, first).max() == pytest.approx(1.0)
