"""Mean signals of neighbouring points from one evaluation of the model."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning.coordinates import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.expansion import Expansion
from rhs_isac_ros.positioning.lattice import Resolution


@pytest.mark.parametrize('changes', [{}, {'subband_width_hz': 5e6}, {'elements_per_side': 16}])
def test_points_that_share_an_expansion_have_accurate_means(changes, random_beams):
    scenario = dataclasses.replace(Scenario(n_subbands=4, n_frames=2), **changes)
    model = MeasurementModel(scenario, random_beams(scenario, np.random.default_rng(0)))
    resolution, rng = Resolution.of(scenario), np.random.default_rng(1)
    nodes = to_polar(scenario.sample_positions(5, rng))
    index = np.repeat(np.arange(5), 20)
    # Anywhere along the range, and within a twentieth of a radian at the edge of the aperture.
    points = nodes[index] + np.column_stack([
        rng.uniform(-0.5, 0.5, 100), rng.uniform(-0.05, 0.05, (100, 2)) * resolution.direction])
    mean, slopes = Expansion.of(model, nodes).at(index, points)
    exact, exact_slopes = model.mean_and_jacobian(to_positions(points), jacobian(points))
    assert np.linalg.norm(mean - exact) < 2e-3 * np.linalg.norm(exact)
    for axis in range(3):
        error = np.linalg.norm(slopes[:, axis] - exact_slopes[:, axis])
        assert error < 0.1 * np.linalg.norm(exact_slopes[:, axis])
