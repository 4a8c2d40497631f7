"""Shapes of a scene, compared with their geometry."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rhs_isac_ros.link import BeamPattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.model.hall import PathChannel
from rhs_isac_ros.model.pose import rotation_matrix
from rhs_isac_ros.model.surface import ports_of
from rhs_isac_ros.monitoring.shapes import axes_95, board, estimate, lobe, traced, user_colour
from rhs_isac_ros.protocol import messages as m

# From tables of the chi-square distribution with two and three degrees of freedom.
CHI_SQUARE_95 = {2: 5.991, 3: 7.815}


@pytest.mark.parametrize('n', CHI_SQUARE_95)
@pytest.mark.parametrize('seed', range(4))
def test_the_axes_are_those_of_the_covariance(n, seed):
    root = np.random.default_rng(seed).normal(size=(n, n))
    half_m, axes = axes_95(root @ root.T)
    assert axes @ np.diag(half_m**2) @ axes.T == pytest.approx(
        CHI_SQUARE_95[n] * root @ root.T, rel=1e-3, abs=1e-3)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_the_ellipsoid_of_an_estimate_has_the_axes_of_its_covariance():
    root = np.random.default_rng(0).normal(size=(3, 3))
    ball, shown = estimate(m.PositionEstimate(
        cycle_id=1, user=1, codebook_id='cb', position=np.array([9.0, -1.0, 0.5]),
        covariance_m2=root @ root.T, crlb_m2=0.1, estimator='bayes', latency_s=0.01))
    assert ball.positions.tolist() == shown.centres.tolist() == [[9.0, -1.0, 0.5]]
    turn = Rotation.from_quat(shown.quaternions[0]).as_matrix()
    assert turn @ np.diag(shown.half_sizes_m[0]**2) @ turn.T == pytest.approx(
        CHI_SQUARE_95[3] * root @ root.T, rel=1e-3, abs=1e-3)


def test_a_covariance_that_is_negative_by_rounding_gives_no_extent():
    half_m, _ = axes_95(np.diag([1.0, 0.0, -1e-18]))
    assert sorted(half_m) == pytest.approx([0, 0, np.sqrt(CHI_SQUARE_95[3])], rel=1e-3)


def test_the_radius_of_a_lobe_is_the_level_in_decibels():
    """0 dB is at the distance of the pattern, -20 dB at the centre."""
    directions = np.array([[[1.0, 0, 0], [0, 1, 0]], [[0, 0, 1], [0.6, 0.8, 0]]])
    relative = np.array([[1.0, 0.1], [0.01, 0.0]])
    shown = lobe(BeamPattern(directions, relative, 8.0), 1)
    assert shown.points == pytest.approx(
        np.array([[[8, 0, 0], [0, 4, 0]], [[0, 0, 0], [0, 0, 0]]]))


@pytest.mark.parametrize('intervals', [0.3, (0.4, 0.2)])
def test_the_board_is_to_scale_or_enlarged(small, intervals):
    scenario = dataclasses.replace(small.scenario, element_interval_wavelengths=intervals)
    configuration = np.linspace(0, 1, 2 * scenario.n_elements).reshape(2, -1)
    true, large = (board(scenario, configuration, enlarged=enlarged) for enlarged in (False, True))
    assert true.centres == pytest.approx(element_positions(scenario))
    factor = large.half_sizes_m[0, 1] / true.half_sizes_m[0, 1]
    assert factor > 1
    assert large.centres == pytest.approx(factor * true.centres)
    for shown in (true, large):
        assert shown.colours[:, 0] == pytest.approx(configuration.mean(axis=0))
        for axis in (1, 2):
            gap_m = np.diff(np.unique(shown.centres[:, axis])).min()
            assert 0 < 2 * shown.half_sizes_m[0, axis] < gap_m
    assert len(np.unique(board(scenario, None).colours[:, 0])) == 1


@pytest.mark.parametrize('changes', [
    {'board': 'resonant'}, {'board': {'kind': 'paper', 'masked': [3]}}])
def test_plates_grow_with_the_modulus_where_it_differs_from_the_tuning(small, changes):
    scenario = dataclasses.replace(small.scenario, **changes)
    configuration, band = np.linspace(0, 1, scenario.n_elements)[None], 0
    transfer = scenario.board.transfer(ports_of(scenario, band), configuration[None])
    order = np.argsort(np.linalg.norm(transfer[0, :, 0], axis=(0, 2)), kind='stable')
    shown = board(scenario, configuration, band)
    assert shown.colours[:, 0] == pytest.approx(configuration[0])
    sizes, full = shown.half_sizes_m, board(scenario, None).half_sizes_m
    assert (np.diff(sizes[order, 1]) >= 0).all()
    assert sizes[order[-1]] == pytest.approx(full[order[-1]])
    assert 0 < sizes[order[0], 1] < 0.5 * full[0, 1]
    # Markers of RViz keep the size of each plate only with turns.
    assert shown.quaternions == pytest.approx(np.tile([0, 0, 0, 1], (len(sizes), 1)))


def test_plates_of_a_board_face_along_the_normals(small):
    normals = np.array([[1.0, 0, 0], [-1, 0, 0], [0.6, 0, -0.8], [0.6, 0.8, 0]])
    panel = Scenario(element_positions_m=np.zeros((4, 3)), element_normals=3 * normals)
    for normal, quaternion in zip(normals, board(panel, None).quaternions, strict=True):
        assert rotation_matrix(quaternion)[:, 0] == pytest.approx(normal)
    assert board(small.scenario, None).quaternions is None


def test_the_paths_of_a_traced_scenario_are_straight_or_bend_at_the_wall():
    user, wall_y, f0 = np.array([6.0, 1.0, 0.5]), 3.0, 2.75e9
    image = np.array([6.0, 2 * wall_y - 1.0, 0.5])
    sources = np.stack([user, image, image + 9.0])
    a = 1e-3 / np.linalg.norm(sources, axis=1)
    scenario = Scenario(channel=PathChannel(
        user[None], a[None] + 0j, sources[None], np.array([[0, 1, 2]]), f0))
    near = m.GroundTruth(cycle_id=0, user=1, position=user + 0.1, velocity=np.zeros(3))
    direct, reflected = traced(scenario, near).strips
    assert direct == pytest.approx(np.stack([user, user, np.zeros(3)]))
    assert reflected[[0, 2]] == pytest.approx(np.stack([user, np.zeros(3)]))
    assert reflected[1, 1] == pytest.approx(wall_y)
    assert np.linalg.norm(np.diff(reflected, axis=0), axis=1).sum() == pytest.approx(
        np.linalg.norm(image))
    assert traced(Scenario(), near).strips == ()


def test_users_have_different_colours():
    colours = {user_colour(user) for user in (1, 2, 3, 2**32 - 1)}
    assert len(colours) == 4
    assert all(0 <= part <= 1 for colour in colours for part in colour)
