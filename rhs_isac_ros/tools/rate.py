"""How often messages come."""

import collections
import itertools
import statistics


class Rate:
    """Intervals between the latest messages of a topic.

    Parameters
    ----------
    window
        How many intervals to keep.
    """

    def __init__(self, window: int) -> None:
        self._times_ns: collections.deque[int] = collections.deque(maxlen=window + 1)
        self._fresh = False

    def add(self, time_ns: int) -> None:
        """LogMessage a message; if the clock was set back, forget those before.

        Parameters
        ----------
        time_ns
            When it came [ns].
        """
        if self._times_ns and time_ns < self._times_ns[-1]:
            self._times_ns.clear()
        self._times_ns.append(time_ns)
        self._fresh = True

    def report(self) -> str:
        """Write the rate if a message came since the last report.

        Returns
        -------
        str
            Two lines as of ``ros2 topic hz``, or nothing.
        """
        intervals_s = [1e-9 * (after - before)
                       for before, after in itertools.pairwise(self._times_ns)]
        if not self._fresh or not intervals_s:
            return ''
        self._fresh = False
        mean_s = statistics.fmean(intervals_s)
        rate_hz = 1 / mean_s if mean_s else 0.0
        return (f'average rate: {rate_hz:.3f}\n\tmin: {min(intervals_s):.3f}s '
                f'max: {max(intervals_s):.3f}s std dev: {statistics.pstdev(intervals_s):.5f}s '
                f'window: {len(intervals_s)}')
