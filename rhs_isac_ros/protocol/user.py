"""The users of a node, which answer beacons, send pilots and exchange data."""

import bisect
import enum
from collections.abc import Callable, Mapping

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import frames_s, reference_s
from rhs_isac_ros.model.mobility import Crowd, Mobility, state_of
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import Event, Outcome, PeersChanged, Timeout
from rhs_isac_ros.protocol.role import ANY, REMEMBERED_CYCLES, NewestDict, Row, StateMachine, on

# Number of consecutive steps in which a granted user may receive nothing: the steps that wait for
# the signals, the position, the beam and the data. The frames take their time in addition.
_SILENT_STEPS = 4


class UserState(enum.Enum):
    """States of the users of a node; at most one user is served at a time."""

    DISCONNECTED = 'disconnected'  # waits for the base station and the channel
    LISTENING = 'listening'        # waits for a beacon that invites a user
    NO_BEACON = 'no_beacon'        # has waited for a beacon for longer than the timeout
    ACKNOWLEDGED = 'acknowledged'  # waits for the grant
    GRANTED = 'granted'            # a user is being positioned and served


# States of connected users without a granted cycle.
NOT_GRANTED = (UserState.LISTENING, UserState.NO_BEACON, UserState.ACKNOWLEDGED)


class User(StateMachine):
    """The role of the users of a node, which usually has only one user.

    A cycle serves one user, so one state is enough for all users of the node. `instance`
    identifies the node, which rejects grants to other instances.

    Parameters
    ----------
    mobilities
        Mobility of each user in the frame of the surface, by id; ids start at 1.
    scenario
        Declares the pose of the surface, and the times of the frames of a cycle. Positions in
        cycles apply to its reference time: users move straight until then.
    step_s, beacon_s
        Time that the base station waits for each step, and time without a beacon after which the
        user logs a warning [s].
    world_s
        Callable that returns the time for the mobilities [s]; by default, they use the time passed
        to `handle`.
    """

    SENDS = (m.Ack, m.GroundTruth, m.GroundTruths, m.Pilot, m.Data)

    STATES = UserState
    BLOCKED_STATES = frozenset({UserState.DISCONNECTED, UserState.NO_BEACON})

    def __init__(
            self, mobilities: Mapping[int, Mobility], scenario: Scenario, step_s: float,
            beacon_s: float, instance: int = 0,
            world_s: Callable[[], float] | None = None) -> None:
        super().__init__(UserState.DISCONNECTED)
        self._step_s, self._beacon_s = step_s, beacon_s
        self.users, self._instance = tuple(sorted(mobilities)), instance
        # Instance of another node that is served under the same number, by user.
        self._conflicts: dict[int, int] = {}
        self._mobilities, self._world_s, self._scenario = mobilities, world_s, scenario
        self._crowd = Crowd([mobilities[user] for user in self.users])
        self._cycle_id = 0
        self._was_connected = False
        # Cycle, first band and last band of the pilot request that was answered last.
        self._sounded = (0, 0, 0)
        # The highest attempt received, by cycle, and the true position, by cycle and user.
        self._attempts: NewestDict[int, int] = NewestDict(REMEMBERED_CYCLES)
        self._truths: NewestDict[tuple[int, int], m.GroundTruth] = NewestDict(REMEMBERED_CYCLES)

    def ground_truths(self, now_s: float) -> m.GroundTruths:
        """Return the true positions and velocities of all users; `now_s` [s] is as in `handle`."""
        position, velocity = self._in_site(*self._crowd.states(self._time_s(now_s)))
        return m.GroundTruths(
            cycle_id=0, users=np.array(self.users), position=position, velocity=velocity)

    def _in_site(
            self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pose = self._scenario.pose
        return pose.to_site(position), pose.vectors_to_site(velocity)

    def _time_s(self, now_s: float) -> float:
        return self._world_s() if self._world_s else now_s

    def react(self, event: Event) -> None:
        """Process an event, and log that beacons have resumed."""
        before = self.state
        super().react(event)
        if before is UserState.NO_BEACON and self.state not in self.BLOCKED_STATES:
            self.log_state('beacons', 'beacons resumed', False)

    def timeout_s(self, state: enum.Enum) -> float | None:
        """Return the timeout of a state [s], or None if it has none."""
        timeouts: dict[enum.Enum, float] = {
            UserState.LISTENING: self._beacon_s, UserState.ACKNOWLEDGED: self._step_s,
            UserState.GRANTED: _SILENT_STEPS * self._step_s + frames_s(self._scenario)}
        return timeouts.get(state)

    def status(self) -> Mapping[str, str]:
        """Return ``conflict.user_<n>`` for each node that is served under the same numbers."""
        return m.describe_conflicts(self._conflicts)

    # Guards

    def _peers_missing(self, event: PeersChanged) -> bool:
        return bool(event.missing or event.lacking)

    def _stale_beacon(self, event: m.Beacon) -> bool:
        granted = self.state is UserState.GRANTED and event.cycle_id == self._cycle_id
        return granted or event.attempt <= self._attempts.get(event.cycle_id, -1)

    def _invites_others(self, event: m.Beacon) -> bool:
        return not self._invited(event)

    def _invited(self, beacon: m.Beacon) -> tuple[int, ...]:
        return self.users[bisect.bisect_left(self.users, beacon.first_user):
                          bisect.bisect_right(self.users, beacon.last_user)]

    def _other_user(self, event: m.Grant | m.PilotRequest | m.Data) -> bool:
        return event.user not in self._mobilities

    def _other_user_granted(self, event: m.Grant) -> bool:
        """Return whether the acknowledged cycle is granted to a user of another node."""
        return self._other_user(event) and event.cycle_id == self._cycle_id

    def _other_instance_granted(self, event: m.Grant) -> bool:
        """Return whether the acknowledged cycle is granted to another node of the same user."""
        return self._other_instance(event) and event.cycle_id == self._cycle_id

    def _other_instance(self, event: m.Grant | m.PilotRequest) -> bool:
        return not m.same_instance(event.user_instance, self._instance)

    def _other_granted(self, event: m.PilotRequest) -> bool:
        """Return whether the cycle is granted to another user of this node."""
        return self.state is UserState.GRANTED and (event.cycle_id, event.user) not in self._truths

    def _not_granted(self, event: m.Data) -> bool:
        return (event.cycle_id, event.user) not in self._truths

    def _wrong_cycle(self, event: m.Grant | m.PilotRequest | m.Data) -> bool:
        return event.cycle_id != self._cycle_id

    def _late_grant(self, event: m.Grant) -> bool:
        """Return whether the cycle was granted to the user before and is over."""
        return (event.cycle_id, event.user) in self._truths and self.state is not UserState.GRANTED

    def _new_request(self, event: m.PilotRequest) -> bool:
        return self._sounded != (event.cycle_id, event.band, event.last_band)

    def _not_delivered_downlink(self, event: m.Data) -> bool:
        return event.stage is m.Stage.OFFERED or event.direction is m.Direction.UPLINK

    # Steps

    def _log_connected(self, event: PeersChanged) -> None:
        self._was_connected = True
        self.log_state('peers', 'listening for beacons', False)

    def _log_missing_peers(self, event: PeersChanged) -> None:
        lacking = (event.lacking,) if event.lacking else ()
        # At the start, the other nodes may be about to start, too.
        self.log_state('peers', f'waiting for {", ".join((*event.missing, *lacking))}', True,
                       bool(lacking) or self._was_connected)

    def _log_no_beacon(self, event: Timeout) -> None:
        self.log_state('beacons', f'no beacon for {self._beacon_s:g} s', True,
                       warning=bool(self._truths))

    def _log_other_instance(self, event: m.Grant) -> None:
        if event.user not in self._conflicts:
            self.log(m.describe_conflict([event.user], event.user_instance), warning=True,
                     key=m.conflict_key(event.user_instance))
        self._conflicts[event.user] = event.user_instance

    def _note_beacon(self, event: m.Beacon) -> None:
        """Store the attempt, so that a late beacon of the same cycle is recognised."""
        self._attempts.put(event.cycle_id, event.attempt)

    def _acknowledge(self, event: m.Beacon) -> None:
        self._note_beacon(event)
        self._cycle_id = event.cycle_id
        for user in self._invited(event):
            self.send(m.Ack(cycle_id=event.cycle_id, user=user))

    def _publish_position(self, event: m.Grant | m.PilotRequest) -> None:
        self._conflicts.pop(event.user, None)
        key = event.cycle_id, event.user
        truth = self._truths.get(key)
        if truth is None:
            position, velocity = self._in_site(
                *state_of(self._mobilities[event.user], self._time_s(self.now_s)))
            truth = m.derive(
                m.GroundTruth, event, velocity=velocity,
                position=position + reference_s(self._scenario) * velocity)
        self._truths.put(key, truth)
        self.send(truth)

    def _send_pilots(self, event: m.PilotRequest) -> None:
        self._sounded = event.cycle_id, event.band, event.last_band
        for band in range(event.band, event.last_band + 1):
            self.send(m.derive(
                m.Pilot, event, band=band, symbols=np.ones(event.n_frames, complex)))

    def _send_uplink(self, event: m.Data) -> None:
        self.send(m.derive(m.Data, event, direction=m.Direction.UPLINK, stage=m.Stage.OFFERED,
                           duration_s=event.duration_s, bits=event.bits,
                           scenario_id=event.scenario_id))

    TABLE = (
        *on(PeersChanged, 'peers')(
            Row(ANY, (_log_missing_peers,), UserState.DISCONNECTED, guard=_peers_missing),
            Row((UserState.DISCONNECTED,), (_log_connected,), UserState.LISTENING),
            Row(ANY)),
        *on(Timeout, 'timeout')(
            Row((UserState.LISTENING,), (_log_no_beacon,), UserState.NO_BEACON,
                outcome=Outcome.NO_BEACON),
            Row((UserState.ACKNOWLEDGED,), target=UserState.LISTENING,
                outcome=Outcome.NOT_GRANTED),
            Row((UserState.GRANTED,), target=UserState.LISTENING, outcome=Outcome.BS_SILENT)),
        *on(m.Beacon, 'beacon')(
            Row(ANY, guard=_stale_beacon, outcome=Outcome.STALE_BEACON),
            Row((UserState.DISCONNECTED,)),
            # A beacon to other users shows that the base station is active, and the cycle is over.
            Row(NOT_GRANTED, (_note_beacon,), UserState.LISTENING, guard=_invites_others),
            Row((UserState.GRANTED,), (_note_beacon,), UserState.LISTENING, guard=_invites_others,
                outcome=Outcome.ABANDONED),
            Row(NOT_GRANTED, (_acknowledge,), UserState.ACKNOWLEDGED),
            Row((UserState.GRANTED,), (_acknowledge,), UserState.ACKNOWLEDGED,
                outcome=Outcome.ABANDONED)),
        *on(m.Grant, 'grant')(
            Row((UserState.ACKNOWLEDGED,), target=UserState.LISTENING, guard=_other_user_granted),
            Row(ANY, guard=_other_user),
            Row((UserState.ACKNOWLEDGED,), (_log_other_instance,), UserState.LISTENING,
                guard=_other_instance_granted, outcome=Outcome.NUMBER_TAKEN),
            Row(ANY, (_log_other_instance,), guard=_other_instance, outcome=Outcome.NUMBER_TAKEN),
            Row(ANY, guard=_wrong_cycle, outcome=Outcome.WRONG_CYCLE),
            Row(ANY, guard=_late_grant, outcome=Outcome.LATE_GRANT),
            # The base station may wait longer than the user, so a grant may follow the timeout.
            Row(NOT_GRANTED, (_publish_position,), UserState.GRANTED),
            Row((UserState.GRANTED,))),
        *on(m.PilotRequest, 'pilot_request', {
            _other_user: None, _other_instance: None, _wrong_cycle: Outcome.WRONG_CYCLE,
            _other_granted: Outcome.WRONG_USER})(
            # A request that overtakes the grant replaces it.
            Row((UserState.ACKNOWLEDGED,), (_publish_position, _send_pilots), UserState.GRANTED,
                guard=_new_request),
            Row((UserState.GRANTED,), (_send_pilots,), guard=_new_request, restart_timeout=True),
            # The channel may have missed the pilots or the position.
            Row((UserState.GRANTED,), (_publish_position, _send_pilots),
                outcome=Outcome.ASKED_AGAIN, restart_timeout=True)),
        *on(m.Data, 'downlink', {
            _not_delivered_downlink: None, _other_user: None, _wrong_cycle: Outcome.WRONG_CYCLE,
            _not_granted: None})(
            Row((UserState.GRANTED,), (_send_uplink,), UserState.LISTENING),
            Row((UserState.LISTENING,), (_send_uplink,), outcome=Outcome.ASKED_AGAIN)),
    )
