"""A node that replaces ``channel`` and controls a real radio."""

import dataclasses
import itertools
import sys

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import NewestDict, Role
from rhs_isac_ros.ros.role_node import RoleNode
from rhs_isac_ros.ros.run import entry

# Maximum number of configurations and of unanswered pilots; older ones belong to ended cycles.
_MAX_PENDING = 256


class Radio(Role):
    """Answers the pilots of a band with the signals that the receivers at the feeds measure.

    `measure` takes a band, its configurations [F, N_E] and the `Pilot` message. In each frame, it
    configures the surface and lets the user transmit. It returns the noisy signals at the feeds,
    complex [F, N_SB, K] [sqrt(W)], which `Radio` divides by the symbols of the pilots.
    `carry` transmits the data of a `Data` message and returns the number of received bits.
    """

    SENDS = (m.FeedSignals, m.Data)
    RECEIVES = (m.RhsConfiguration, m.Pilot, m.Data)

    def __init__(self, measure, carry):
        super().__init__()
        self._measure, self._carry = measure, carry
        # Configurations by cycle and band: messages of different topics arrive in any order.
        self._applied = NewestDict(_MAX_PENDING)
        # Pilots without a configuration, in order, by serial number.
        self._waiting = NewestDict(_MAX_PENDING)
        self._serial = itertools.count()

    def react(self, event):
        """Process a message, and answer the pilots whose configurations have arrived."""
        match event:
            case m.RhsConfiguration(mode=m.Mode.POSITIONING):
                self._applied.put((event.cycle_id, event.band), event.analog)
            case m.Pilot():
                self._waiting.put(next(self._serial), event)
            case m.Data(stage=m.Stage.OFFERED):
                self.send(dataclasses.replace(
                    event, stage=m.Stage.DELIVERED, bits=self._carry(event)))
        for serial, pilot in list(self._waiting.items()):
            applied = self._applied.get((pilot.cycle_id, pilot.band))
            if applied is None:
                continue
            del self._waiting[serial]
            feeds = self._measure(pilot.band, applied, pilot)
            self.send(m.FeedSignals(
                cycle_id=pilot.cycle_id, user=pilot.user, user_instance=pilot.sender,
                band=pilot.band, signals=(feeds.T / pilot.symbols).T))


class RadioNode(RoleNode):
    """The ROS node. It has the parameters of ``channel``, but uses only ``scenario_file``."""

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
