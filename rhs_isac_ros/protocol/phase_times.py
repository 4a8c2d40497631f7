"""When the phases of a cycle begin."""

import math

import numpy as np

from rhs_isac_ros.protocol import messages as m


class PhaseTimes:
    """The clock of one cycle after the other; it starts with a cycle's newest beacon."""

    def __init__(self) -> None:
        self._began_s = np.full(len(m.Phase), math.nan)

    def beacon(self, now_s: float) -> None:
        """Start the clock.

        Parameters
        ----------
        now_s
            The time, on any clock that only goes forward [s].
        """
        self._began_s[:] = math.nan
        self._began_s[m.Phase.BEACONING] = now_s

    def begin(self, phase: m.Phase, cycle_id: int, user: int, now_s: float) -> m.ProtocolState:
        """Enter a phase.

        Parameters
        ----------
        phase
            The phase.
        cycle_id, user
            Which cycle, and whose.
        now_s
            The time [s].

        Returns
        -------
        ProtocolState
            What to say of it.
        """
        self._began_s[phase] = now_s
        return self._state(phase, cycle_id, user, now_s, '')

    def end(self, outcome: str, cycle_id: int, user: int, now_s: float) -> m.ProtocolState:
        """End the cycle.

        Parameters
        ----------
        outcome
            ``served``, or why it is given up.
        cycle_id, user
            Which cycle, and whose.
        now_s
            The time [s].

        Returns
        -------
        ProtocolState
            What to say of it.
        """
        return self._state(m.Phase.BEACONING, cycle_id, user, now_s, outcome)

    def _state(
            self, phase: m.Phase, cycle_id: int, user: int, now_s: float, outcome: str
    ) -> m.ProtocolState:
        beacon_s = self._began_s[m.Phase.BEACONING]
        return m.ProtocolState(
            cycle_id, user, phase, outcome, self._began_s - beacon_s, float(now_s - beacon_s))
