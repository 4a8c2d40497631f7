"""The state of the scene, assembled from messages alone."""

import math

import numpy as np
import pytest

from rhs_isac_ros.monitoring.network_state import SceneState
from rhs_isac_ros.protocol import messages as m


def truth(user, position, cycle_id=0):
    return m.GroundTruth(
        cycle_id=cycle_id, user=user, position=np.array(position, float), velocity=np.zeros(3))


def estimate(user, position, cycle_id):
    return m.PositionEstimate(
        cycle_id=cycle_id, user=user, codebook_id='cb', position=np.array(position, float),
        covariance_m2=np.eye(3), crlb_m2=0.1, estimator='bayes', latency_s=0.01)


def beam(user, cycle_id=1):
    return m.Beam(
        cycle_id=cycle_id, user=user, codebook_id='cb', band=0, analog=np.ones(4),
        digital=np.ones((2, 2), complex), expected_bps=1e6)


def test_the_scene_is_complete_once_every_user_has_an_estimate():
    scene = SceneState()
    for message in (m.RhsConfiguration(
        cycle_id=1, mode=m.Mode.POSITIONING, band=0, codebook_id='cb', analog=np.ones((3, 4))),
                    truth(1, [9, 0, 0]), truth(2, [8, 0, 0]), estimate(1, [9, 1, 0], 1)):
        scene.add(message, 1.0)
        assert not scene.complete
    assert not scene.drawable
    scene.add(beam(1), 1.0)
    assert scene.drawable and not scene.complete
    assert scene.without_estimate == [2]
    scene.add(estimate(2, [8, 1, 0], 2), 1.0)
    assert scene.complete
    # User and beam belong to the same cycle, although the other user has a later estimate.
    assert (scene.shown_user.user, scene.shown_beam.user) == (1, 1)
    scene.add(estimate(1, [9, 1, 0], 3), 1.0)
    assert (scene.shown_user.user, scene.shown_beam) == (1, None)
    assert not scene.complete
    scene.add(beam(1, 3), 1.0)
    assert scene.complete


def test_the_number_of_users_is_bounded():
    scene = SceneState(max_users=2)
    scene.add(m.GroundTruths(
        cycle_id=0, users=np.arange(1, 4), position=np.ones((3, 3)), velocity=np.zeros((3, 3))),
        1.0)
    for message in (truth(4, [9, 0, 0]), estimate(5, [9, 0, 0], 1), estimate(1, [9, 0, 0], 1)):
        scene.add(message, 2.0)
    assert list(scene.users) == [1, 2]
    assert scene.users[1].estimate
    # The place of a user that has left is free for another.
    assert scene.discard_stale(1.5) == [2]
    scene.add(truth(4, [9, 0, 0]), 2.0)
    assert list(scene.users) == [1, 4]


def test_an_error_needs_the_true_position_of_its_cycle():
    scene = SceneState()
    scene.add(estimate(1, [9, 3, 4], 5), 0.0)
    assert math.isnan(scene.users[1].error_m)
    for message in (truth(1, [9, 0, 0], cycle_id=5), truth(1, [7, 0, 0])):
        scene.add(message, 0.0)
        assert scene.users[1].error_m == pytest.approx(5.0)
    scene.add(truth(1, [7, 0, 0], cycle_id=6), 0.0)
    assert math.isnan(scene.users[1].error_m)
    assert scene.users[1].truth.position[0] == 7


def test_paths_skip_small_steps_and_are_bounded():
    scene = SceneState()
    for step in (0.0, 0.01, 0.02, 0.5, 0.5):
        scene.add(truth(1, [9 + step, 0, 0]), 0.0)
    assert [place[0] for place in scene.users[1].true_path] == [9.0, 9.5]
    for cycle_id in range(1, 1001):
        scene.add(estimate(1, [cycle_id, 0, 0], cycle_id), 0.0)
    assert [place[0] for place in scene.users[1].estimated_path] == list(range(801, 1001))


def test_a_silent_user_is_discarded_with_its_beam():
    scene = SceneState()
    for user, time_s in ((1, 1.0), (2, 2.0)):
        scene.add(truth(user, [9, 0, 0]), time_s)
    scene.add(beam(1), 1.0)
    assert scene.discard_stale(1.0) == []
    assert scene.beam.user == 1
    scene.add(estimate(2, [9, 0, 0], 1), 3.0)
    assert scene.discard_stale(2.5) == [1]
    assert list(scene.users) == [2]
    assert scene.beam is None
    scene.add(beam(2), 3.0)
    scene.add(truth(1, [5, 0, 0]), 3.0)
    assert scene.discard_stale(2.5) == []
    assert scene.beam.user == 2
    scene.add(truth(2, [9, 0, 0]), 5.0)
    scene.add(truth(1, [5, 0, 0]), 5.0)
    assert scene.discard_stale(4.0) == []
    assert scene.beam is None
    assert len(scene.users[1].true_path) == 1
