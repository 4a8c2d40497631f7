"""The feed signals of a cycle, frame by frame."""

from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.protocol import messages as m


class FrameBuffer:
    """Collects the feed signals of a cycle.

    Parameters
    ----------
    sizes
        Sizes of the scenario; ``N_B`` and ``F`` are used.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self._n_bands, self._n_frames = sizes['N_B'], sizes['F']
        self._signals: dict[tuple[int, int], np.ndarray] = {}

    def __contains__(self, feeds: m.FeedSignals) -> bool:
        """Return whether the frame of a band was added before."""
        return (feeds.band, feeds.frame) in self._signals

    def add(self, feeds: m.FeedSignals) -> None:
        """Add the signals of a frame."""
        self._signals[feeds.band, feeds.frame] = feeds.signals

    def n_missing(self, band: int | None = None) -> int:
        """Return the number of frames missing up to and including `band`; by default of all."""
        n_bands = self._n_bands if band is None else band + 1
        return n_bands * self._n_frames - len(self._signals)

    def stack(self) -> np.ndarray:
        """Return the signals of all frames, complex128 [N_B, F, N_SB, K]; none may be missing."""
        return np.stack([[self._signals[band, frame] for frame in range(self._n_frames)]
                         for band in range(self._n_bands)])
