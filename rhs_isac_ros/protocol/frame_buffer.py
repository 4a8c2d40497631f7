"""The feed signals of a cycle, frame by frame."""

from collections.abc import Mapping

import numpy as np

from rhs_isac_ros.protocol import messages as m


class FrameBuffer:
    """Collects the feed signals of a cycle.

    Parameters
    ----------
    sizes
        The sizes of the scenario; ``N_B`` and ``F`` count here.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self._n_bands, self._n_frames = sizes['N_B'], sizes['F']
        self._signals: dict[tuple[int, int], np.ndarray] = {}

    def __contains__(self, feeds: m.FeedSignals) -> bool:
        """Tell whether a band's frame is there already."""
        return (feeds.band, feeds.frame) in self._signals

    def keep(self, feeds: m.FeedSignals) -> None:
        """Keep a frame.

        Parameters
        ----------
        feeds
            Its signals.
        """
        self._signals[feeds.band, feeds.frame] = feeds.signals

    def missing(self, band: int | None = None) -> int:
        """Count what has not come yet.

        Parameters
        ----------
        band
            The last band that counts, from 0; by default the last of all.

        Returns
        -------
        int
            The number of frames.
        """
        n_bands = self._n_bands if band is None else band + 1
        return n_bands * self._n_frames - len(self._signals)

    def stack(self) -> np.ndarray:
        """Put all frames together; none may be missing.

        Returns
        -------
        numpy.ndarray
            Complex128 [N_B, F, N_SB, K].
        """
        return np.stack([[self._signals[band, frame] for frame in range(self._n_frames)]
                         for band in range(self._n_bands)])
