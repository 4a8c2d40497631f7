"""Mutations are of every kind, and repeat with their seed."""

import numpy as np
import pytest
from rclpy.serialization import serialize_message

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, topics
from system.chaos.mutations import mutate, random_message

KINDS = list(topics.NAMES)


def well_formed(kind, content):
    try:
        m.check(convert.from_bytes(kind, content), Scenario().sizes)
    except m.MessageError:
        return False
    return True


@pytest.mark.parametrize('kind', KINDS, ids=lambda kind: kind.__name__)
def test_random_messages_can_be_serialized_and_some_are_malformed(kind):
    rng = np.random.default_rng(0)
    contents = [serialize_message(random_message(convert.ros_type(kind), rng)) for _ in range(60)]
    assert len(set(contents)) > 10
    if kind not in (m.Beacon,):
        assert not all(well_formed(kind, content) for content in contents)


def test_some_mutations_are_well_formed():
    original = serialize_message(ros.PilotRequest(
        cycle_id=7, user=1, band=1, last_band=1, n_frames=Scenario().n_frames))
    rng = np.random.default_rng(1)
    mutations = [mutate(ros.PilotRequest, [original], rng) for _ in range(400)]
    valid = [content for content in mutations if well_formed(m.PilotRequest, content)]
    assert 20 < len(valid) < 380
    assert any(len(content) < len(original) for content in mutations)
    assert all(content[:4] == original[:4] for content in mutations)


def test_mutations_repeat_with_their_seed():
    """Serialization leaves the bytes between fields undefined, so only the rest is compared."""
    originals = [serialize_message(ros.Beacon(cycle_id=7))]

    def random_messages():
        return [str(random_message(ros.Beacon, np.random.default_rng(seed)))
                for seed in range(50)]

    def lengths():
        return [len(mutate(ros.Beacon, originals, np.random.default_rng(seed)))
                for seed in range(50)]
    assert random_messages() == random_messages()
    assert lengths() == lengths()


def test_mutations_are_cut_at_whole_words():
    originals = [serialize_message(ros.NoFix(cycle_id=7, user=1, codebook_id='abcde', reason='x'))]
    rng = np.random.default_rng(2)
    for _ in range(300):
        content = mutate(ros.NoFix, originals, rng)
        cut = len(content) < len(originals[0]) and originals[0].startswith(content)
        assert not cut or len(content) % 4 == 0
