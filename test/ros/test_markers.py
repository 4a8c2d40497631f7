"""Markers, compared with the shapes that they show."""

import dataclasses

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from visualization_msgs.msg import Marker

from rhs_isac_ros.link import beam_pattern, steer
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring import shapes
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import markers
from rhs_isac_ros.ros.frames import Frame

STAMP = Time(sec=3)


def of(vector):
    return np.array([vector.x, vector.y, vector.z])


def rgb(colour):
    return (colour.r, colour.g, colour.b)


def an_estimate(covariance_m2, user=1):
    """The ellipsoid of an estimate as a marker, and as a shape."""
    _, shape = shapes.estimate(m.PositionEstimate(
        cycle_id=5, user=user, codebook_id='cb', position=np.array([9.0, -1.0, 0.5]),
        covariance_m2=covariance_m2, crlb_m2=0.1, estimator='bayes', latency_s=0.01))
    return markers.marker('estimate', user, shape, STAMP), shape


def test_an_ellipsoid_keeps_its_axes():
    marker, shape = an_estimate(np.diag([4.0, 1.0, 0.25]))
    assert marker.type == Marker.SPHERE
    assert of(marker.pose.position) == pytest.approx(shape.centres[0])
    assert of(marker.scale) == pytest.approx(2 * shape.half_sizes_m[0])
    turn = marker.pose.orientation
    assert [turn.x, turn.y, turn.z, turn.w] == pytest.approx(shape.quaternions[0])
    assert of(an_estimate(np.zeros((3, 3)))[0].scale).min() > 0


def test_each_user_has_one_hue_for_truth_and_estimate():
    hues = set()
    for user in (1, 2, 2**32 - 1):
        position = np.array([user % 7, 0.0, 0.0], float)
        ball, _ = shapes.truth(m.GroundTruth(
            cycle_id=0, user=user, position=position, velocity=np.zeros(3)))
        one = markers.marker('truth', user, ball, STAMP)
        other, _ = an_estimate(np.eye(3), user)
        assert of(one.pose.position) == pytest.approx(position)
        assert (one.ns, one.id) != (other.ns, other.id)
        assert rgb(one.color) == rgb(other.color)
        assert one.color.a == 1 > other.color.a > 0
        hues.add(rgb(one.color))
    assert len(hues) == 3


def test_the_plates_of_the_board_keep_places_and_colours(small):
    board = shapes.board(small.scenario, np.linspace(0, 1, small.scenario.n_elements)[None])
    marker = markers.marker('board', 0, board, STAMP)
    assert np.array([of(point) for point in marker.points]) == pytest.approx(board.centres)
    assert np.array([rgb(colour) for colour in marker.colors]) == pytest.approx(board.colours)
    assert of(marker.scale) == pytest.approx(2 * board.half_sizes_m[0])


def test_the_region_is_translucent_and_visible_even_if_it_is_flat(small):
    flat = dataclasses.replace(small.scenario, roi_size_m=(4.0, 3.0, 0.0))
    for scenario in (small.scenario, flat):
        marker = markers.marker('region', 0, shapes.region(scenario), STAMP)
        low, high = scenario.roi_bounds_m
        (centre,), size = map(of, marker.points), of(marker.scale)
        assert centre == pytest.approx((low + high) / 2)
        assert size == pytest.approx(high - low, abs=0.01)
        assert size.min() > 0 and 0 < marker.colors[0].a < 1
        assert (marker.header.frame_id, marker.header.stamp) == ('rhs_link', STAMP)
        assert marker.pose.orientation.w == 1


def test_the_beam_points_to_its_user_and_its_triangles_look_outward():
    scenario, place = Scenario(), np.array([9.0, 3.0, 0.3])
    found = beam_pattern(scenario, steer(scenario, place), 10.0)
    marker = markers.marker('beam', 0, shapes.lobe(found, 3), STAMP)
    corners = np.array([of(point) for point in marker.points]).reshape(-1, 3, 3)
    assert (marker.type, marker.header.frame_id) == (Marker.TRIANGLE_LIST, 'rhs_link')
    lengths = np.linalg.norm(corners, axis=-1)
    assert lengths.max() == pytest.approx(10.0)
    tip = corners.reshape(-1, 3)[lengths.argmax()] / 10.0
    assert np.degrees(np.arccos(tip @ place / np.linalg.norm(place))) < 8.0
    assert corners[..., 0].min() >= -1e-9
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum('nu,nu->n', normals, corners.mean(axis=1)) >= -1e-9).all()
    assert 0 < marker.color.a < 1
    assert rgb(marker.color) == pytest.approx(shapes.user_colour(3))


def test_a_path_contains_its_positions_in_order():
    places = np.array([[9.0, 1.0, 0.0], [8.5, 1.5, 0.1], [8.0, 1.0, 0.2]])
    path = markers.path(places, STAMP, Frame())
    assert (path.header.frame_id, path.header.stamp) == ('map', STAMP)
    assert np.array([of(pose.pose.position) for pose in path.poses]) == pytest.approx(places)
    assert all(pose.header == path.header and pose.pose.orientation.w == 1
               for pose in path.poses)


def test_a_deletion_names_its_marker():
    marker = markers.deletion('truth', 4, STAMP)
    assert (marker.ns, marker.id, marker.action) == ('truth', 4, Marker.DELETE)
