"""The lattice, and expansions, at every wavelength, aperture, bandwidth and region."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.geometry import element_positions, jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.lattice import PHASE_ERROR, Expansion, Resolution, lay_grid

REGIONS = {
    'small': {'roi_center_m': (5, 1, 0.5), 'roi_size_m': (4, 4, 2)},
    'Table I': {},
    # At wide angles, a step in direction spans a large depth.
    'wide': {'roi_center_m': (3, 0, 0), 'roi_size_m': (5, 14, 6)},
    # Ranges from almost zero.
    'near': {'roi_center_m': (1, 0, 0), 'roi_size_m': (1.9, 2, 2)},
    'millimetre waves': {'center_frequencies_hz': (28e9,), 'elements_per_side': 16},
}


@pytest.mark.parametrize('changes', REGIONS.values(), ids=REGIONS)
def test_grid_covers_the_region(changes):
    """Nearly every position is within half a step of a grid point in range and direction."""
    scenario = Scenario(**{'n_subbands': 1, 'n_frames': 2, 'elements_per_side': 4} | changes)
    grid, resolution = lay_grid(scenario), Resolution.of(scenario)
    steps = np.array([1.0, *2 * PHASE_ERROR * resolution.direction])

    def scaled(points):
        """Points whose range is in units of the relative width of a range bin."""
        return np.column_stack([np.log(points[:, 0]) / 0.1, points[:, 1:] / steps[1:]])

    targets = to_polar(scenario.sample_positions(4000, np.random.default_rng(1)))
    targets = targets[targets[:, 0] > 2 * resolution.nearest_m]
    distance, _ = cKDTree(scaled(grid.points)).query(scaled(targets), p=np.inf)
    # The grid is irregular at the rim of the half space.
    assert distance.max() < 0.76
    assert np.mean(distance < 0.53) > 0.98


@pytest.mark.parametrize('changes, factor', [
    ({'elements_per_side': 20}, 4), ({'center_frequencies_hz': (6e9,)}, 4),
    ({'roi_size_m': (10, 10, 0.5)}, 0.4)], ids=['aperture', 'wavelength', 'region'])
def test_the_grid_follows_the_number_of_distinguishable_directions(changes, factor):
    base = dataclasses.replace(
        Scenario(), center_frequencies_hz=(3e9,), element_interval_wavelengths=0.5)
    if 'center_frequencies_hz' in changes:
        # The same aperture in metres.
        changes = changes | {'element_interval_wavelengths': 1.0}
    counts = [len(lay_grid(scenario).nodes) / len(lay_grid(scenario).shells)
              for scenario in (base, dataclasses.replace(base, **changes))]
    assert counts[1] / counts[0] == pytest.approx(factor, rel=0.35)


def test_every_part_of_the_grid_has_templates():
    """The first range bins reach beyond the corners of the region."""
    grid = lay_grid(Scenario(
        center_frequencies_hz=(1.5e9,), element_interval_wavelengths=0.59, n_subbands=1,
        roi_center_m=(0.9, -0.71, 0.55), roi_size_m=(0.996, 0.642, 0.841)))
    assert all(one.start < one.stop for shell in grid.shells for one in shell)


def test_a_step_in_direction_changes_the_phase_at_the_edge_by_one_radian():
    scenario = Scenario()
    edge_m = np.abs(element_positions(scenario)).max()
    wavenumber = 2 * np.pi * (
        max(scenario.center_frequencies_hz)
        + (scenario.n_subbands - 1) / 2 * scenario.subband_width_hz) / 299_792_458
    assert Resolution.of(scenario).direction == pytest.approx(1 / (wavenumber * edge_m), rel=1e-9)
    single = dataclasses.replace(scenario, elements_per_side=1, n_feeds=1)
    assert list(Resolution.of(single).direction) == [0.4, 0.4]


def test_range_cells_follow_the_bandwidth():
    narrow, wide = (Scenario(subband_width_hz=width) for width in (1e5, 25e6))
    assert lay_grid(narrow).widths_m.min() == pytest.approx(0.1 * 5, rel=0.02)
    assert lay_grid(wide).widths_m.max() == pytest.approx(
        2 * PHASE_ERROR * 299_792_458 / (np.pi * 8 * 25e6))


@pytest.mark.parametrize('changes', [{}, {'subband_width_hz': 5e6}, {'elements_per_side': 16}])
def test_an_expansion_has_accurate_means_in_its_cell(changes, random_beams):
    scenario = dataclasses.replace(Scenario(n_subbands=4, n_frames=2), **changes)
    model = MeasurementModel(scenario, random_beams(scenario, np.random.default_rng(0)))
    resolution, rng = Resolution.of(scenario), np.random.default_rng(1)
    nodes = to_polar(scenario.sample_positions(5, rng))
    index = np.repeat(np.arange(5), 20)
    # Anywhere along the range, and up to the largest phase error at the edge of the aperture.
    directions = rng.uniform(-PHASE_ERROR, PHASE_ERROR, (100, 2)) * resolution.direction
    points = nodes[index] + np.column_stack([rng.uniform(-0.5, 0.5, 100), directions])
    mean, slopes = Expansion.of(model, nodes).at(index, points)
    exact, exact_slopes = model.mean_and_jacobian(to_positions(points), jacobian(points))
    assert np.linalg.norm(mean - exact) < 1e-2 * np.linalg.norm(exact)
    for axis in range(3):
        error = np.linalg.norm(slopes[:, axis] - exact_slopes[:, axis])
        assert error < PHASE_ERROR * np.linalg.norm(exact_slopes[:, axis])


def test_a_part_of_the_grid_keeps_its_pairs_and_the_templates_that_they_need():
    grid, rng = lay_grid(Scenario()), np.random.default_rng(2)
    chosen = rng.random(len(grid.node)) < 0.03
    part = grid.within(chosen)
    np.testing.assert_array_equal(part.points, grid.points[chosen])
    assert set(part.node) == set(range(len(part.nodes)))
    for nodes, bins, cells in part.shells:
        assert ((part.node[cells] >= nodes.start) & (part.node[cells] < nodes.stop)).all()
        assert ((part.range_bin[cells] >= bins.start) & (part.range_bin[cells] < bins.stop)).all()
    assert sum(cells.stop - cells.start for *_, cells in part.shells) == chosen.sum()
