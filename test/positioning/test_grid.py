"""The grid of templates, the search on it, and the suppression of points that are close."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.model import MeasurementModel, Scenario, simulate_received
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.positioning import grid
from rhs_isac_ros.positioning.coordinates import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.grid import (
    DIRECTION_STEP,
    RANGE_CELL_M,
    TemplateTable,
    polar_grid,
    suppress,
    tabulate,
)
from rhs_isac_ros.positioning.likelihood import Likelihood


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
    model = MeasurementModel(scenario, codebook).prepare(jacobian=True)
    table = tabulate(model)
    points = table['points']
    np.testing.assert_array_equal(points, polar_grid(scenario))
    # More than one block.
    assert len(points) > 300
    carrier = np.exp(2j * np.pi * np.array([2.4e9, 3.1e9]) / 299_792_458 * points[:, :1])

    def template(points):
        """Whitened means times the carriers at the grid points."""
        return model.whiten(model.mean(to_positions(points))) * carrier[..., None]

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


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    """Two bands, and a region off boresight with a range extent of 5 m."""
    return Scenario(
        center_frequencies_hz=(2.4e9, 3.1e9), n_subbands=2, n_frames=4, elements_per_side=5,
        roi_center_m=(5, 1, 0.5), roi_size_m=(4, 4, 2))


@pytest.fixture(scope='module')
def likelihood(scenario, random_beams) -> Likelihood:
    return Likelihood(scenario, random_beams(scenario, np.random.default_rng(0)))


@pytest.fixture(scope='module')
def model(likelihood) -> MeasurementModel:
    return likelihood.model


@pytest.fixture(scope='module')
def table(scenario, model) -> TemplateTable:
    return TemplateTable(scenario, tabulate(model))


@pytest.fixture
def starts(likelihood, table, monkeypatch):
    """Function that finds at most some starts of each phase, without nuisance parameters."""
    def starts(whitened, max_points, margin):
        monkeypatch.setitem(
            grid._EFFORTS, False, grid._EFFORTS[False]._replace(modes=max_points))
        return table.starts(whitened, likelihood.nuisance, margin)
    return starts


def test_range_steps_resolve_the_shortest_wavelength(scenario, table):
    quarter = 299_792_458 / 3.1e9 / 4
    offsets = table.range_offsets_m
    assert np.diff(offsets).max() <= quarter
    # Distance from the last step of a cell to the first of the next.
    assert RANGE_CELL_M - (offsets[-1] - offsets[0]) <= quarter
    ranges = np.unique(table.points[:, 0])
    np.testing.assert_allclose(np.diff(ranges), RANGE_CELL_M)


def exact_log_likelihood(plain, model, received, points):
    """Log-likelihood and energy at polar points, from unwhitened signals and the plain model."""
    scenario, codebook = model.scenario, model.beams
    p = plain(scenario, codebook.analog, codebook.digital)
    spatial = multipath_covariance(scenario)
    distance, u, v = points.T
    positions = np.stack([distance * np.sqrt(1 - u**2 - v**2), distance * u, distance * v], axis=1)
    likelihood = energy = 0.0
    for band in range(scenario.n_bands):
        mean = p.mean(positions, band)
        solved = np.linalg.solve(p.covariance(band, spatial[band]), mean.T).T
        likelihood = likelihood + 2 * (solved.conj() @ received[band]).real
        energy = energy + np.sum(mean.conj() * solved, axis=1).real
    return likelihood - energy, energy


def test_log_likelihood_matches_the_exact_one(scenario, model, table, plain):
    rng = np.random.default_rng(2)
    received = simulate_received(
        scenario, model.beams, scenario.sample_positions(1, rng), rng)[0]
    likelihood = table.log_likelihood(model.whiten(received[None])[0])
    assert likelihood.shape == (len(table.points), len(table.range_offsets_m))
    cells = rng.integers(len(table.points), size=300)
    center = np.abs(table.range_offsets_m).argmin()
    strength = np.sum(np.abs(model.whiten(received[None]))**2)
    for fine in (center, 0, len(table.range_offsets_m) - 1):
        offset = table.range_offsets_m[fine]
        points = table.points[cells] + [offset, 0, 0]
        exact, energy = exact_log_likelihood(plain, model, received, points)
        # Off the centre, the template is inexact: its amplitude decreases as 1 / r, and the
        # phases of the sub-bands rotate.
        relative = 1e-5 + 1.5 * abs(offset) / points[:, 0]
        tolerance = relative * (2 * np.sqrt(strength * energy) + energy)
        assert (np.abs(likelihood[cells, fine] - exact) < tolerance).all()


def test_starts_for_noiseless_signals_contain_the_true_position(scenario, model, starts):
    """Its accuracy is that of one Gauss-Newton step."""
    positions = scenario.sample_positions(20, np.random.default_rng(3))
    whitened = model.whiten(model.mean(positions))
    for point, y in zip(to_polar(positions), whitened, strict=True):
        points = starts(y[None], 30, 10.0).points
        assert 1 <= len(points) <= 30
        distances = np.abs(points - point) / [0.002, 0.02, 0.02]
        assert distances.max(axis=1).min() < 1


def test_starts_are_sorted_separate_and_within_the_margin(scenario, model, starts, plain):
    rng = np.random.default_rng(4)
    received = simulate_received(
        scenario, model.beams, scenario.sample_positions(1, rng), rng)[0]
    whitened = model.whiten(received[None])
    many, few, shallow, deep = (
        starts(whitened, n, margin).points
        for n, margin in ((30, 2.0), (3, 2.0), (30, 0.0), (1000, 30.0)))
    assert 3 < len(many)
    assert len(shallow) < len(many) < len(deep)
    np.testing.assert_array_equal(few, many[:3])
    np.testing.assert_array_equal(shallow, many[:len(shallow)])
    np.testing.assert_array_equal(many, deep[:len(many)])
    radii = np.array([0.37 * 299_792_458 / 3.1e9, 0.062, 0.062])
    for n, point in enumerate(many):
        assert (np.linalg.norm((point - many[:n]) / radii, axis=1) >= 0.999).all()
    exact, energy = exact_log_likelihood(plain, model, received, many)
    # The table is accurate to one Gauss-Newton step and a share of the energy.
    tolerance = 4 + 0.05 * energy.max()
    assert exact[0] > exact.max() - tolerance
    assert exact.min() > exact.max() - 2 - tolerance


def test_starts_of_each_phase_are_those_of_the_phase_alone(scenario, model, starts):
    rng = np.random.default_rng(6)
    received = simulate_received(
        scenario, model.beams, scenario.sample_positions(40, rng), rng)
    whitened = model.whiten(received)
    found = starts(whitened, 30, 10.0)
    assert (np.diff(found.phases) >= 0).all()
    for phase, y in enumerate(whitened):
        np.testing.assert_array_equal(
            found.points[found.phases == phase], starts(y[None], 30, 10.0).points)


def within_boxes(points):
    """Closeness of points [L, N, D] that differ by less than 1 in all coordinates."""
    close = (np.abs(points[:, :, None] - points[:, None]) < 1).all(axis=-1)
    lists = np.arange(len(points))[:, None, None]
    return lambda first, second: close[lists, first[:, :, None], second[:, None]]


def first_of_close(points, max_points):
    """Indices of the points that are separate from all earlier ones which remain."""
    kept = []
    for n, point in enumerate(points):
        if all(max(abs(point - points[k])) >= 1 for k in kept):
            kept.append(n)
    return kept[:max_points]


def test_the_first_of_close_points_remains():
    points = np.random.default_rng(5).uniform(0, 4, (200, 3))
    kept = first_of_close(points, 1000)
    assert len(kept) > 7
    for max_points, expected in ((1000, kept), (7, kept[:7])):
        (chosen,) = suppress(
            within_boxes(points[None]), np.ones((1, 200), bool), max_points)
        assert np.flatnonzero(chosen).tolist() == expected


def test_a_list_may_have_no_points():
    nothing = within_boxes(np.ones((1, 0, 3)))
    assert suppress(nothing, np.ones((1, 0), bool), 5).shape == (1, 0)


@pytest.mark.parametrize('n_points', [1, 30, 150])
@pytest.mark.parametrize('n_lists', [0, 1, 3, 20])
@pytest.mark.parametrize('max_points', [1, 7, 1000])
def test_points_of_every_list_are_suppressed_alone(n_points, n_lists, max_points):
    rng = np.random.default_rng(6)
    points = rng.uniform(0, 4, (n_lists, n_points, 3))
    valid = rng.uniform(size=points.shape[:2]) < rng.uniform(size=(n_lists, 1))
    valid[:1] = False
    chosen = suppress(within_boxes(points), valid, max_points)
    assert chosen.shape == valid.shape
    for number in range(n_lists):
        (own,) = np.nonzero(valid[number])
        expected = own[first_of_close(points[number, own], max_points)]
        np.testing.assert_array_equal(np.flatnonzero(chosen[number]), expected)
