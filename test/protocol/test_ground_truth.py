"""The true position of the user that was located."""

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.ground_truth import TruePositions


def truth(cycle_id=3, user=1, sender=7):
    return m.GroundTruth(cycle_id=cycle_id, user=user, sender=sender, position=np.ones(3),
                         velocity=np.zeros(3))


@pytest.fixture
def estimate(example):
    return example(m.PositionEstimate, cycle_id=3, user=1, user_instance=7)


def test_it_is_that_of_the_cycle_and_user_and_of_the_node_that_was_served(estimate):
    truths, expected = TruePositions(), truth()
    for one in (truth(2), truth(user=2), expected, truth(sender=8), truth(4)):
        truths.add(one)
    assert truths.of(estimate) is expected
    assert truths.of(None) is None


def test_an_unknown_node_may_be_any(example):
    truths, latest = TruePositions(), truth(sender=8)
    for one in (latest, truth(), latest):
        truths.add(one)
    assert truths.of(example(m.ReceivedSignals, cycle_id=3, user=1)) is latest


def test_positions_outside_cycles_are_of_nothing(example):
    truths = TruePositions()
    truths.add(truth(0))
    assert truths.of(example(m.PositionEstimate, cycle_id=0, user=1)) is None


def test_the_oldest_cycles_are_forgotten(estimate):
    truths = TruePositions(2)
    for cycle_id in (3, 4, 5):
        truths.add(truth(cycle_id))
    assert truths.of(estimate) is None
