"""A node that replaces ``channel`` and drives hardware."""

import collections
import dataclasses
import sys

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Send
from rhs_isac_ros.protocol.role import PlainRole
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry


class Radio(PlainRole):
    """Answers the pilots of a band with the signals that the receivers at the feeds measure.

    `measure` takes a band, its configurations [F, N_E] and the pilots. In each frame, it
    configures the surface and lets the user transmit. It returns the noisy signals at the feeds,
    complex [F, N_SB, K] [sqrt(W)].
    `carry` takes data and returns the number of bits that were received.
    """

    SENDS = (m.FeedSignals, m.Data)
    RECEIVES = (m.RhsConfiguration, m.Pilot, m.Data)

    def __init__(self, measure, carry):
        super().__init__()
        self._measure, self._carry = measure, carry
        self._cycle_id = 0
        self._applied = {}
        self._waiting = collections.deque(maxlen=256)

    def handle(self, event, now_s):
        """Process a message and return the messages to send."""
        match event:
            case m.RhsConfiguration(mode=m.Mode.POSITIONING):
                if event.cycle_id != self._cycle_id:
                    self._cycle_id, self._applied = event.cycle_id, {}
                self._applied[event.band] = event.analog
            case m.Pilot():
                self._waiting.append(event)
            case m.Data(stage=m.Stage.OFFERED):
                bits = self._carry(event)
                return [Send(dataclasses.replace(event, stage=m.Stage.DELIVERED, bits=bits))]
        return self._answer()

    def _answer(self):
        """Answer the pilots whose configuration has arrived.

        Messages of different topics may arrive in any order.
        """
        answers = []
        for _ in range(len(self._waiting)):
            pilot = self._waiting.popleft()
            if pilot.cycle_id == self._cycle_id and pilot.band in self._applied:
                feeds = self._measure(pilot.band, self._applied[pilot.band], pilot)
                answers.append(Send(m.FeedSignals(
                    cycle_id=pilot.cycle_id, user=pilot.user, user_instance=pilot.sender,
                    band=pilot.band, signals=feeds)))
            else:
                # The queue is bounded, so the oldest pilots, those of unfinished cycles, are
                # discarded.
                self._waiting.append(pilot)
        return answers


class RadioNode(RoleNode):
    """The node. It declares the parameters of ``channel`` but uses only ``scenario_file``."""

    def __init__(self, measure, carry, **node_options):
        super().__init__('channel', 'radio', **node_options)
        self.start(Radio(measure, carry))


def measure(band, configurations, pilot):
    """Measure with your hardware here."""
    raise NotImplementedError('no radio yet')


def carry(data):
    """Transmit your data here."""
    raise NotImplementedError('no radio yet')


main = entry('channel', lambda: [RadioNode(measure, carry)])

if __name__ == '__main__':
    sys.exit(main())
