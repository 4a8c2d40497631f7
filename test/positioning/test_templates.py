"""The polar grid and the templates on it."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning.polar import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.templates import (
    DIRECTION_STEP,
    RANGE_CELL_M,
    polar_grid,
    tabulate,
)
from rhs_isac_ros.positioning.whitened import WhitenedModel


@pytest.mark.parametrize('region', [
    {'roi_center_m': (5, 1, 0.5), 'roi_size_m': (4, 4, 2)},
    {},
    # At wide angles, a step in direction spans a large depth.
    {'roi_center_m': (3, 0, 0), 'roi_size_m': (5, 14, 6)},
    # Ranges from almost zero.
    {'roi_center_m': (1, 0, 0), 'roi_size_m': (1.9, 2, 2)},
], ids=['small', 'Table I', 'wide', 'near'])
def test_grid_covers_the_region(region):
    """Nearly every position is within half a step of a grid point in range and direction."""
    scenario = Scenario(n_subbands=1, n_frames=2, elements_per_side=2, **region)
    points = polar_grid(scenario)
    steps = np.array([RANGE_CELL_M, DIRECTION_STEP, DIRECTION_STEP])
    targets = to_polar(scenario.sample_positions(4000, np.random.default_rng(1))) / steps
    distance, _ = cKDTree(points / steps).query(targets, p=np.inf)
    # The grid is irregular at the rim of the half space and at range 0.
    assert distance.max() < 0.76
    assert np.mean(distance < 0.5 + 1e-9) > 0.98


def test_arrays_of_the_table_match_their_definitions(random_beams):
    scenario = Scenario(center_frequencies_hz=(2.4e9, 3.1e9), n_subbands=2, n_frames=3,
                        elements_per_side=4, roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook = random_beams(scenario, np.random.default_rng(0))
    model = WhitenedModel(scenario, codebook)
    table = tabulate(model)
    points = table['points']
    np.testing.assert_array_equal(points, polar_grid(scenario))
    # More than one block.
    assert len(points) > 300
    carrier = np.exp(2j * np.pi * np.array([2.4e9, 3.1e9]) / 299_792_458 * points[:, :1])

    def template(points):
        """Whitened means times the carriers at the grid points."""
        received = MeasurementModel(scenario, codebook).mean(to_positions(points))
        return model.whiten(received) * carrier[..., None]

    templates = template(points)
    scale = np.abs(templates).max()
    filters = np.moveaxis(table['filters'], 0, 1)
    np.testing.assert_allclose(filters, templates.conj(), atol=1e-6 * scale)
    energy = np.sum(np.abs(templates)**2, axis=(1, 2))
    np.testing.assert_allclose(table['energy'], energy, rtol=1e-5)
    step = 1e-5
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        up, down = template(points + shift), template(points - shift)
        slope = ((up - down) / (2 * step)).reshape(len(points), -1).conj()
        np.testing.assert_allclose(
            np.moveaxis(table['slope_filters'], 0, 2)[:, axis].reshape(slope.shape), slope,
            atol=1e-4 * np.abs(slope).max())
        energy_slope = np.sum(np.abs(up)**2 - np.abs(down)**2, axis=(1, 2)) / (2 * step)
        np.testing.assert_allclose(table['energy_slope'][:, axis], energy_slope,
                                   atol=1e-4 * np.abs(energy_slope).max())
    by_point = jacobian(points)
    information = fisher_information(scenario, codebook, to_positions(points))
    np.testing.assert_allclose(
        table['curvature'], np.swapaxes(by_point, 1, 2) @ information @ by_point, rtol=1e-8,
        atol=1e-9 * np.abs(table['curvature']).max())
