"""The grid of templates, the search on it, and the suppression of points in the same mode."""

import numpy as np
import pytest

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.geometry import jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.grid import TemplateTable, heaviest, separate
from rhs_isac_ros.positioning.lattice import lay_grid, subband_wavenumbers
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.segments import Segments, select
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.system import System


def test_arrays_of_the_table_match_their_definitions(random_beams):
    scenario = Scenario(center_frequencies_hz=(2.4e9, 3.1e9), n_subbands=2, n_frames=3,
                        elements_per_side=4, roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook = random_beams(scenario, np.random.default_rng(0))
    model = MeasurementModel(scenario, codebook).prepare()
    table, grid = tabulate(model), lay_grid(scenario)
    wavenumbers = np.repeat(subband_wavenumbers(scenario), 3, axis=1)

    def template(points):
        """Means over exp(-i k r) / r."""
        range_m = points[:, :1, None]
        mean = model.mean(to_positions(points))
        return mean * range_m * np.exp(1j * wavenumbers * range_m)

    def by_frame(array):
        return array.reshape(len(array), 2, 2, 3)

    templates = template(grid.nodes)
    scale = np.abs(templates).max()
    np.testing.assert_allclose(
        np.moveaxis(table['filters'], 2, 0), by_frame(templates.conj()), atol=1e-6 * scale)
    step = 1e-5
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (template(grid.nodes + shift) - template(grid.nodes - shift)) / (2 * step)
        np.testing.assert_allclose(
            np.moveaxis(table['slope_filters'][..., axis, :], 2, 0), by_frame(slope.conj()),
            atol=1e-4 * np.abs(slope).max())
    means = model.whiten(model.mean(to_positions(grid.points)))
    energy = np.sum(np.abs(means)**2, axis=(1, 2))
    np.testing.assert_allclose(table['energy'], energy, rtol=2e-3)
    users = model.whiten(model.mean(scenario.sample_positions(20_000, np.random.default_rng(1))))
    spread = np.einsum('cir,cis->irs', users, users.conj()) / len(users)
    np.testing.assert_allclose(table['spread'], spread, atol=0.02 * np.abs(spread).max())
    np.testing.assert_array_equal(table['limiter'], np.tile(np.eye(6), (2, 1, 1)))
    by_point = jacobian(grid.points)
    model = MeasurementModel(scenario, codebook)
    information = fisher_information(model, to_positions(grid.points))
    expected = np.swapaxes(by_point, 1, 2) @ information @ by_point
    scale = np.sqrt(np.einsum('caa->ca', expected))
    scale = scale[:, :, None] * scale[:, None]
    np.testing.assert_allclose(table['curvature'] / scale, expected / scale, atol=0.02)


@pytest.mark.parametrize('changes', [
    {}, {'delay_spread_s': 0.0}, {'delay_spread_s': 5e-9},
    {'delay_spread_s': 0.0, 'multipath_to_los_db': -20.0}], ids=str)
def test_no_template_promises_more_than_the_maximum(shipped, changes):
    """Without noise, the true position has the largest log-likelihood, half of the energy."""
    scenario, rng = Scenario(**changes), np.random.default_rng(5)
    likelihood = Likelihood(System(scenario, shipped))
    table = TemplateTable(scenario, tabulate(likelihood.model))
    positions = scenario.sample_positions(30, rng)
    whitened = likelihood.signals(likelihood.model.mean(positions)).whitened
    query = table.query(whitened, likelihood.nuisance, 8.0)
    peaks = table._peaks(query)[0]
    assert (peaks.value <= query.energies[peaks.shots] + 0.5).all()
    starts = table.starts(whitened, likelihood.nuisance, 8.0)
    for phase, position in enumerate(positions):
        offsets = to_positions(starts.points[starts.shots == phase]) - position
        assert np.abs(offsets).max(axis=1).min() < 0.1


@pytest.mark.parametrize('gain_std_db', [0.0, 1.0])
def test_the_value_of_a_peak_is_that_of_its_range_and_of_the_most_likely_gain(
        shipped, gain_std_db):
    scenario, rng = Scenario(multipath_to_los_db=-20.0, user_gain_std_db=gain_std_db), (
        np.random.default_rng(5))
    likelihood = Likelihood(System(scenario, shipped))
    table = TemplateTable(scenario, tabulate(likelihood.model))
    signals = likelihood.signals(
        likelihood.model.sample(scenario.sample_positions(10, rng), rng))
    query = table.query(signals.whitened, likelihood.nuisance, 8.0)
    peaks = table._peaks(query)[0]
    scale = peaks.centre_m / peaks.range_m
    assert np.abs(scale - 1).max() > 0.02
    gain = np.linspace(-5, 5, 2001 if gain_std_db else 1)[:, None] * gain_std_db
    factor = 10**(-gain / 20)
    values = (-factor**2 * query.energies[peaks.shots] * bool(gain_std_db)
              + 2 * factor * scale * peaks.outputs.real.sum(axis=1)
              + 2 * signals.received[0].size * np.log(factor)
              - (gain / max(gain_std_db, 1.0))**2 / 2)
    energy = scale**2 * table.cells.template_energy_at(peaks.cell, peaks.centre_m)
    expected = values.max(axis=0) - energy
    # Far below the best peak of a shot, a gain is a poor guess.
    best = np.array([expected[peaks.shots == shot].max() for shot in peaks.shots])
    likely = expected > best - 30
    assert likely.sum() > 10
    np.testing.assert_allclose(peaks.value[likely], expected[likely], atol=0.5)


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    """Two bands, and a region off boresight with a range extent of 5 m."""
    return Scenario(
        center_frequencies_hz=(2.4e9, 3.1e9), n_subbands=2, n_frames=4, elements_per_side=5,
        roi_center_m=(5, 1, 0.5), roi_size_m=(4, 4, 2))


@pytest.fixture(scope='module')
def likelihood(scenario, random_beams) -> Likelihood:
    return Likelihood(System(scenario, random_beams(scenario, np.random.default_rng(0))))


@pytest.fixture(scope='module')
def table(scenario, likelihood) -> TemplateTable:
    return TemplateTable(scenario, tabulate(likelihood.model))


def test_windows_have_the_outputs_and_energies_of_their_centres(scenario, likelihood, table):
    model = likelihood.model
    y = model.whiten(model.mean(scenario.sample_positions(1, np.random.default_rng(5))))
    query = table.query(y, likelihood.nuisance, 10.0)
    cells = np.arange(len(table.cells.template_energy))
    windows = table.evaluate_windows(query, 0, cells, table.grid.nodes[table.grid.node, 1:])
    assert len(windows.row) > len(cells)
    directions = table.grid.nodes[table.grid.node[windows.row], 1:]
    means = model.whiten(model.mean(to_positions(np.column_stack([windows.range_m, directions]))))
    energy = np.sum(np.abs(means)**2, axis=(1, 2))
    np.testing.assert_allclose(windows.energy, energy, rtol=0.01)
    outputs = np.einsum('wir,ir->wi', means.conj(), y[0])
    np.testing.assert_allclose(
        windows.outputs, outputs, atol=0.02 * np.abs(outputs).max())


def test_starts_are_sorted_separate_and_within_the_margin(scenario, likelihood, table):
    rng = np.random.default_rng(4)
    signals = likelihood.signals(likelihood.model.sample(scenario.sample_positions(1, rng), rng))
    shallow, many, deep = (
        table.starts(signals.whitened, likelihood.nuisance, margin).points
        for margin in (0.5, 3.0, 30.0))
    assert 1 <= len(shallow) < len(many) < len(deep)
    radii = likelihood.resolution.separation(is_coarse=False)
    for few, all_of_them in ((shallow, many), (many, deep)):
        distance = np.linalg.norm((few[:, None] - all_of_them) / radii, axis=2)
        assert (distance < 1).any(axis=1).all()
    for n, point in enumerate(many):
        assert (np.linalg.norm((point - many[:n]) / radii, axis=1) >= 0.999).all()
    exact = likelihood.local(
        many, np.zeros((len(many), 0)), select(signals, np.zeros(len(many), int))).value
    means = likelihood.model.whiten(likelihood.model.mean(to_positions(many)))
    # The table is accurate to one Gauss-Newton step and a share of the energy.
    tolerance = 4 + 0.05 * np.sum(np.abs(means)**2, axis=(1, 2)).max()
    assert exact[0] > exact.max() - tolerance
    assert exact.min() > exact.max() - 3 - np.log(len(many)) - tolerance


@pytest.mark.parametrize('changes', [
    {'center_frequencies_hz': (28e9, 28.4e9), 'elements_per_side': 16},
    {'center_frequencies_hz': (28e9,), 'n_subbands': 16, 'subband_width_hz': 25e6},
    {'center_frequencies_hz': (28e9, 28.5e9), 'elements_per_side': 16,
     'roi_center_m': (1.0, 0.0, 0.0), 'roi_size_m': (1.0, 1.0, 0.5)},
    {'roi_center_m': (30.0, 0.0, 0.0), 'roi_size_m': (50.0, 40.0, 4.0)},
], ids=['aperture', 'bandwidth', 'near field', 'large region'])
def test_the_search_finds_the_true_mode_at_every_scale(changes, random_beams):
    scenario = Scenario(n_frames=4, multipath_to_los_db=-10.0, **changes)
    likelihood = Likelihood(System(scenario, random_beams(scenario, np.random.default_rng(0))))
    table = TemplateTable(scenario, tabulate(likelihood.model))
    positions = scenario.sample_positions(20, np.random.default_rng(1))
    radii = likelihood.resolution.separation(is_coarse=False)
    signals = likelihood.signals(likelihood.model.sample(positions, np.random.default_rng(2)))
    found = table.starts(signals.whitened, likelihood.nuisance, 10.0)
    for phase, point in enumerate(to_polar(positions)):
        points = found.points[found.shots == phase]
        assert (np.linalg.norm((points - point) / radii, axis=1) < 1).any()


@pytest.mark.parametrize('n_points', [1, 30, 150])
@pytest.mark.parametrize('n_shots', [1, 3, 20])
def test_the_best_of_close_points_remains(n_points, n_shots):
    rng = np.random.default_rng(6)
    shots = np.sort(rng.integers(n_shots, size=n_points))
    points, radii = rng.uniform(0, 4, (n_points, 3)), np.array([0.8, 1.0, 1.2])
    # One mode is much longer than the ellipsoid, but narrow.
    curvature = np.tile(np.diag([100.0, 100.0, 100.0]), (n_points, 1, 1))
    curvature[n_points // 2] = np.diag([1.0, 100.0, 100.0])
    for precision in (None, curvature):
        kept = []
        for n, point in enumerate(points):
            offset = points[kept] - point
            close = np.linalg.norm(offset / radii, axis=1) < 1
            if precision is not None:
                close |= np.einsum('ka,ab,kb->k', offset, precision[n], offset) < 2
            if not (close & (shots[kept] == shots[n])).any():
                kept.append(n)
        chosen = separate(shots, points, radii, precision)
        assert np.flatnonzero(chosen).tolist() == kept


def test_the_heaviest_points_leave_out_a_share_of_the_weight():
    rng = np.random.default_rng(7)
    shots = np.sort(rng.integers(4, size=400))
    value = -rng.exponential(6.0, 400)
    order = np.lexsort((-value, shots))
    value = value[order]
    # Whatever the weights of the other shots are.
    value[shots == 3] -= 700
    kept = heaviest(Segments.of_keys(shots), value, 3.0)
    for shot in range(4):
        weights = np.exp(value[shots == shot] - value[shots == shot].max())
        left_out = weights[~kept[shots == shot]].sum() / weights.sum()
        assert 0 < left_out < np.exp(-3.0)
        assert kept[shots == shot][:10].all()
