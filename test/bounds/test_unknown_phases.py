"""Distances of signals with unknown phases, compared with a search over all phases."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds.unknown_phases import best_phases, phase_scales
from rhs_isac_ros.model import Scenario


def declare(**phases):
    return dataclasses.replace(Scenario(), **phases)


def test_scales_have_a_column_for_each_declared_phase():
    assert phase_scales(declare(timing_std_s=1e-8)).shape == (2, 0)
    np.testing.assert_array_equal(phase_scales(declare(phase_std_rad=0.3)), [[0.3], [0.3]])
    np.testing.assert_array_equal(
        phase_scales(declare(phase_std_rad=0.3, band_phase_std_rad=0.5)),
        [[0.3, 0.5, 0.0], [0.3, 0.0, 0.5]])


@pytest.mark.parametrize('phases', [
    {'phase_std_rad': 0.2}, {'phase_std_rad': 6.3}, {'band_phase_std_rad': 0.2},
    {'band_phase_std_rad': 6.3}, {'phase_std_rad': 0.5, 'band_phase_std_rad': 0.5}])
def test_hardly_any_phases_are_better(phases):
    rng, scales = np.random.default_rng(0), phase_scales(declare(**phases))
    products = rng.exponential(3.0, (50, 2)) * np.exp(2j * np.pi * rng.uniform(size=(50, 2)))
    found, penalties = best_phases(products, scales)
    grid = np.linspace(-np.pi, np.pi, 181)
    if scales.shape[1] == 1:
        every = np.stack([grid, grid], axis=1)
    else:
        every = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    inverse = np.linalg.pinv(scales @ scales.T)

    def cost(theta, penalty):
        return penalty - 2 * np.sum((products * np.exp(-1j * theta)).real, axis=-1)

    least = np.min([cost(theta, theta @ inverse @ theta) for theta in every], axis=0)
    excess = cost(found, penalties) - least
    assert excess.max() < 0.05
    assert np.mean(excess < 1e-3) > 0.9
    np.testing.assert_allclose(
        penalties, np.einsum('na,ab,nb->n', found, inverse, found), atol=1e-9)


def test_small_phases_are_those_of_the_linear_model():
    """Minimise |a (1 + i theta) - b|^2 with a prior: theta = 2 Im a^H b / (2 |a|^2 + 1 / s^2)."""
    products, scale = np.array([[4.0 * np.exp(1e-3j)]]), np.array([[0.7]])
    (found,), _ = best_phases(products, scale)
    assert found[0] == pytest.approx(4e-3 / (4 + 1 / 0.7**2), rel=1e-3)
