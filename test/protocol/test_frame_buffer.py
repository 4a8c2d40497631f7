"""The frames of a cycle."""

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.frame_buffer import FrameBuffer


@pytest.fixture
def feeds(scenario):
    """Feed signals of two bands and two frames, out of order."""
    rng = np.random.default_rng(3)
    return [m.FeedSignals(cycle_id=1, user=1, band=band, frame=frame,
                          signals=rng.random((3, 2)) + 0j)
            for band, frame in [(1, 0), (0, 1), (1, 1), (0, 0)]]


def test_frames_are_missing_until_they_are_added(scenario, feeds):
    frames = FrameBuffer(scenario.sizes)
    missing = []
    for signals in feeds:
        assert signals not in frames
        frames.add(signals)
        assert signals in frames
        missing.append(frames.n_missing())
    assert missing == [3, 2, 1, 0]
    first = FrameBuffer(scenario.sizes)
    assert (first.n_missing(0), first.n_missing(1)) == (2, 4)


def test_frames_are_stacked_by_band_and_frame(scenario, feeds):
    frames = FrameBuffer(scenario.sizes)
    for signals in feeds:
        frames.add(signals)
    stack = frames.stack()
    assert stack.shape == (2, 2, 3, 2)
    for signals in feeds:
        np.testing.assert_array_equal(stack[signals.band, signals.frame], signals.signals)
