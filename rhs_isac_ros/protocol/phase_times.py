"""The times at which the phases of a cycle begin."""

import math

import numpy as np

from rhs_isac_ros.protocol import messages as m


class PhaseTimes:
    """Measures the phases of one cycle at a time, from its latest beacon.

    All times are on the same monotonic clock [s].
    """

    def __init__(self) -> None:
        self._began_s = np.full(len(m.Phase), math.nan)

    def start(self, now_s: float) -> None:
        """Start a cycle, or restart it with another beacon."""
        self._began_s[:] = math.nan
        self._began_s[m.Phase.BEACONING] = now_s

    def begin_phase(
            self, phase: m.Phase, cycle_id: int, user: int, now_s: float) -> m.ProtocolState:
        """Record the beginning of a phase and return the message that announces it."""
        self._began_s[phase] = now_s
        return self._state(phase, cycle_id, user, now_s, '')

    def end_cycle(
            self, outcome: str, cycle_id: int, user: int, now_s: float) -> m.ProtocolState:
        """Return the message that ends the cycle.

        Parameters
        ----------
        outcome
            ``served``, or the value of the `Outcome` that ended the cycle.
        """
        return self._state(m.Phase.BEACONING, cycle_id, user, now_s, outcome)

    def _state(
            self, phase: m.Phase, cycle_id: int, user: int, now_s: float, outcome: str
    ) -> m.ProtocolState:
        beacon_s = self._began_s[m.Phase.BEACONING]
        return m.ProtocolState(
            cycle_id=cycle_id, user=user, phase=phase, outcome=outcome,
            began_s=self._began_s - beacon_s, elapsed_s=float(now_s - beacon_s))
