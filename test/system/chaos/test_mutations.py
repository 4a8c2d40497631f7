"""Messages that nobody meant are of every kind, and repeat with their seed."""

import numpy as np
import pytest
from rclpy.serialization import serialize_message

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from system.chaos.mutations import lie, random_message

KINDS = list(topics.NAMES)


def verdict(kind, content):
    try:
        m.check(convert.from_bytes(kind, content), Scenario().sizes)
    except m.MessageError:
        return False
    return True


@pytest.mark.parametrize('kind', KINDS, ids=lambda kind: kind.__name__)
def test_random_messages_can_be_sent_and_some_are_malformed(kind):
    rng = np.random.default_rng(0)
    contents = [serialize_message(random_message(convert.ros_type(kind), rng)) for _ in range(60)]
    assert len(set(contents)) > 10
    if kind not in (m.Beacon,):
        assert not all(verdict(kind, content) for content in contents)


def test_mutants_of_a_true_message_are_partly_well_formed():
    true = serialize_message(ros.PilotRequest(
        cycle_id=7, user=1, band=1, n_frames=Scenario().n_frames))
    rng = np.random.default_rng(1)
    lies = [lie(ros.PilotRequest, [true], rng) for _ in range(400)]
    good = [content for content in lies if verdict(m.PilotRequest, content)]
    assert 20 < len(good) < 380
    assert any(len(content) < len(true) for content in lies)
    assert all(content[:4] == true[:4] for content in lies)


def test_a_seed_tells_the_same_lies_again():
    true = [serialize_message(ros.Beacon(cycle_id=7))]
    first, second = ([lie(ros.Beacon, true, np.random.default_rng(seed)) for seed in range(50)]
                     for _ in range(2))
    assert first == second


def test_lies_are_whole_words():
    true = [serialize_message(ros.NoFix(cycle_id=7, user=1, codebook_id='abcde', reason='x'))]
    rng = np.random.default_rng(2)
    for _ in range(300):
        content = lie(ros.NoFix, true, rng)
        cut = len(content) < len(true[0]) and true[0].startswith(content)
        assert not cut or len(content) % 4 == 0
