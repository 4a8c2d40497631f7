"""Rate of the messages of a topic."""

import collections
import itertools
import statistics


class Rate:
    """Intervals between the latest messages of a topic.

    Parameters
    ----------
    window
        Number of intervals to keep.
    """

    def __init__(self, window: int) -> None:
        self._times_ns: collections.deque[int] = collections.deque(maxlen=window + 1)
        self._changed = False

    def add(self, time_ns: int) -> None:
        """Add a message that arrived at a time [ns]; discard the others if the clock went back."""
        if self._times_ns and time_ns < self._times_ns[-1]:
            self._times_ns.clear()
        self._times_ns.append(time_ns)
        self._changed = True

    def report(self) -> str:
        """Return two lines as ``ros2 topic hz`` prints them; empty without a new message."""
        intervals_s = [1e-9 * (after - before)
                       for before, after in itertools.pairwise(self._times_ns)]
        if not self._changed or not intervals_s:
            return ''
        self._changed = False
        mean_s = statistics.fmean(intervals_s)
        rate_hz = 1 / mean_s if mean_s else 0.0
        return (f'average rate: {rate_hz:.3f}\n\tmin: {min(intervals_s):.3f}s '
                f'max: {max(intervals_s):.3f}s std dev: {statistics.pstdev(intervals_s):.5f}s '
                f'window: {len(intervals_s)}')
