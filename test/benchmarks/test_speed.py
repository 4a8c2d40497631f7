"""Comparison of two revisions; here, of this revision with itself."""

import numpy as np
from benchmarks import speed
from parts import frame, speed_worker


def test_both_revisions_measure_the_same_signals(tmp_path):
    np.savez(tmp_path / 'plain.npz', **speed_worker.signals(
        frame.CONFIG, 'plain', 3, np.random.default_rng(1)))
    times_s = speed.compare([speed.ROOT, speed.ROOT], tmp_path, 'plain', 'single', 3)
    assert times_s.shape == (2, 3)
    assert (times_s > 0).all()
