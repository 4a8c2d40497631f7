"""The template table and the search on it."""

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.positioning.polar import to_polar
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.templates import RANGE_CELL_M, tabulate
from rhs_isac_ros.positioning.whitened import WhitenedModel


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    """Two bands, and a region off boresight with a range extent of 5 m."""
    return Scenario(
        center_frequencies_hz=(2.4e9, 3.1e9), n_subbands=2, n_frames=4, elements_per_side=5,
        roi_center_m=(5, 1, 0.5), roi_size_m=(4, 4, 2))


@pytest.fixture(scope='module')
def model(scenario, random_beams) -> WhitenedModel:
    return WhitenedModel(scenario, random_beams(scenario, np.random.default_rng(0)))


@pytest.fixture(scope='module')
def table(scenario, model) -> TemplateTable:
    return TemplateTable(scenario, tabulate(model))


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
    scenario, codebook = model.scenario, model.codebook
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
        scenario, model.codebook, scenario.sample_positions(1, rng), rng)[0]
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


def test_modes_of_noiseless_signals_contain_the_true_position(scenario, model, table):
    """Its accuracy is that of one Gauss-Newton step."""
    positions = scenario.sample_positions(20, np.random.default_rng(3))
    whitened = model.mean(positions)
    for point, y in zip(to_polar(positions), whitened, strict=True):
        modes = table.modes(y, 30, 10.0)
        assert 1 <= len(modes) <= 30
        distances = np.abs(modes - point) / [0.002, 0.02, 0.02]
        assert distances.max(axis=1).min() < 1


def test_modes_are_sorted_separate_and_within_the_margin(scenario, model, table, plain):
    rng = np.random.default_rng(4)
    received = simulate_received(
        scenario, model.codebook, scenario.sample_positions(1, rng), rng)[0]
    y = model.whiten(received[None])[0]
    many, few, shallow, deep = (
        table.modes(y, n, margin) for n, margin in ((30, 2.0), (3, 2.0), (30, 0.0), (1000, 30.0)))
    assert 3 < len(many)
    assert len(shallow) < len(many) < len(deep)
    np.testing.assert_array_equal(few, many[:3])
    np.testing.assert_array_equal(shallow, many[:len(shallow)])
    np.testing.assert_array_equal(many, deep[:len(many)])
    scale = np.array([0.3 * 299_792_458 / 3.1e9, 0.05, 0.05])
    for n, point in enumerate(many):
        assert all((np.abs(point - other) >= scale).any() for other in many[:n])
    exact, energy = exact_log_likelihood(plain, model, received, many)
    # The table is accurate to one Gauss-Newton step and a share of the energy.
    tolerance = 4 + 0.05 * energy.max()
    assert exact[0] > exact.max() - tolerance
    assert exact.min() > exact.max() - 2 - tolerance


def test_modes_of_each_phase_are_those_of_the_phase_alone(scenario, model, table):
    rng = np.random.default_rng(6)
    received = simulate_received(
        scenario, model.codebook, scenario.sample_positions(40, rng), rng)
    whitened = model.whiten(received)
    phases, points = table.modes_of_each(whitened, 30, 10.0)
    for phase, y in enumerate(whitened):
        np.testing.assert_array_equal(points[phases == phase], table.modes(y, 30, 10.0))
