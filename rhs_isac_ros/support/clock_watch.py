"""Detection of a simulated time that stands still or comes from two sources."""

import collections

# Time without progress after which the simulated time counts as standing still [s].
STILL_S = 2.0
# Time in which the simulated time goes back twice if it comes from two sources [s]. When a
# simulation restarts, it goes back once.
WINDOW_S = 5.0


class ClockWatch:
    """Watches the simulated time of a node; times `now_s` [s] are on a steady clock."""

    def __init__(self) -> None:
        self._simulated_s: float | None = None
        # Time of the last progress [s]; the latest two times at which the time went back, and by
        # how much.
        self._progress_s = 0.0
        self._jumps: collections.deque[tuple[float, float]] = collections.deque(maxlen=2)

    def update(self, simulated_s: float | None, now_s: float) -> str:
        """Process the simulated time [s], or None; return what is wrong with it, or ''."""
        before_s, self._simulated_s = self._simulated_s, simulated_s
        if simulated_s is None:
            self._jumps.clear()
            return ''
        if before_s is None or simulated_s != before_s:
            self._progress_s = now_s
        if before_s is not None and simulated_s < before_s:
            self._jumps.append((now_s, before_s - simulated_s))
        if now_s >= self._progress_s + STILL_S:
            return 'waiting for /clock'
        if len(self._jumps) == 2 and now_s < self._jumps[0][0] + WINDOW_S:
            step_s = max(step_s for _, step_s in self._jumps)
            return f'/clock goes back repeatedly, by {step_s:.0f} s: expected one publisher'
        return ''
