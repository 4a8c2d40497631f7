"""The frames of a cycle."""

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.frame_buffer import FrameBuffer


@pytest.fixture
def feeds(scenario):
    """Feed signals of two bands and two frames, in no order."""
    rng = np.random.default_rng(3)
    return [m.FeedSignals(1, 1, band, frame, rng.random((3, 2)) + 0j)
            for band, frame in [(1, 0), (0, 1), (1, 1), (0, 0)]]


def test_what_has_not_come_is_missing_and_what_has_is_there(scenario, feeds):
    frames = FrameBuffer(scenario.sizes)
    missing = []
    for signals in feeds:
        assert signals not in frames
        frames.keep(signals)
        assert signals in frames
        missing.append(frames.missing())
    assert missing == [3, 2, 1, 0]
    first = FrameBuffer(scenario.sizes)
    assert (first.missing(0), first.missing(1)) == (2, 4)


def test_they_are_stacked_by_band_and_frame(scenario, feeds):
    frames = FrameBuffer(scenario.sizes)
    for signals in feeds:
        frames.keep(signals)
    stack = frames.stack()
    assert stack.shape == (2, 2, 3, 2)
    for signals in feeds:
        np.testing.assert_array_equal(stack[signals.band, signals.frame], signals.signals)
