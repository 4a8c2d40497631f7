"""The states and the memory of a base station: users, the current cycle, and logged outages."""

import bisect
import collections
import dataclasses
import enum
import math
import re
from collections.abc import Callable, Iterable, Sequence, Set
from typing import TYPE_CHECKING

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import LogMessage, Outcome
from rhs_isac_ros.protocol.role import NewestDict

if TYPE_CHECKING:
    # The settings import the limits of the users.
    from rhs_isac_ros.protocol.settings import BaseStationSettings


class State(enum.Enum):
    """States of the base station."""

    WAITING = 'waiting'            # waits for a codebook and the other roles
    PAUSED = 'paused'              # waits for an operator to resume or step the cycles
    RESTING = 'resting'            # waits between cycles
    BEACONING = 'beaconing'        # waits for acks
    CONFIGURING = 'configuring'    # waits for the RHS to report the configurations of all bands
    SOUNDING = 'sounding'          # waits for the feed signals of all bands
    ESTIMATING = 'estimating'      # waits for the position estimate
    STEERING = 'steering'          # waits for the beam and for the RHS to apply it
    TRANSMITTING = 'transmitting'  # waits for the uplink data


# Steps of a granted cycle: each waits for a reply and may request it again.
STEPS = (State.CONFIGURING, State.SOUNDING, State.ESTIMATING, State.STEERING, State.TRANSMITTING)
NOT_BEACONING = tuple(state for state in State if state is not State.BEACONING)


def timeouts(settings: 'BaseStationSettings', pausing: bool) -> dict[State, float]:
    """Return the timeouts by state [s]; that of a step is divided equally among its attempts.

    There is no rest before a pause.
    """
    attempt_s = settings.step_timeout_s / (settings.retries + 1)
    return {State.RESTING: 0.0 if pausing else settings.rest_s,
            State.BEACONING: settings.ack_timeout_s, **dict.fromkeys(STEPS, attempt_s)}


POLICIES = ('round_robin', 'first', 'random')
# Highest number of a user, which bounds the memory whatever numbers the acks contain.
MAX_USERS = 4096
LAST_NUMBER = 2**32 - 1
# Number of registered users that the first beacon of a cycle invites, and the factor by which
# each further beacon of the cycle extends it. All acks of a cycle take time, but one user is
# served.
INVITED, _EXTENSION = 8, 8
# Number of consecutive beacons without an answer after which a user is removed.
_MAX_MISSED = 3


class UserScheduler:
    """Registers the users that answer beacons and selects the next one to serve.

    Parameters
    ----------
    policy
        ``round_robin``: the user served longest ago; ``first``: the first to answer; ``random``.
    rng
        Source of randomness, for ``random``.

    Attributes
    ----------
    all_invited
        Whether the latest beacon invited all users.
    answered
        Users that answered in this cycle, in order; the values have no meaning.

    Raises
    ------
    ValueError
        If the policy is unknown.
    """

    def __init__(self, policy: str, rng: np.random.Generator) -> None:
        self._rng = rng
        self.set_policy(policy)
        # By user: (turn, 1) if it was served in that turn, (turn, 0) if it was registered after
        # it and not served yet.
        self._served: dict[int, tuple[int, int]] = {}
        # By user: consecutive beacons without an answer.
        self._missed: dict[int, int] = {}
        # The registered users in ascending order.
        self._numbers: list[int] = []
        # The registered users that were invited and have not answered yet.
        self._awaited: set[int] = set()
        # Users that are served before others once, in the order of the requests.
        self._requested: dict[int, None] = {}
        self._turn = 0
        self.all_invited = True
        self.answered: dict[int, None] = {}

    def set_policy(self, policy: str) -> None:
        """Change the policy; the turns of the users are kept.

        Raises
        ------
        ValueError
            If the policy is unknown.
        """
        if policy not in POLICIES:
            raise ValueError(f'policy: {policy!r}, expected one of {list(POLICIES)}')
        self._policy = policy

    def begin_cycle(self) -> None:
        """Clear the answers, and wait for all registered users until `invite` is called."""
        self.answered = {}
        self.all_invited, self._awaited = True, set(self._missed)

    def invite(self, attempt: int) -> tuple[int, int]:
        """Choose the users to wait for, and return their first and last number.

        The range contains the user whose turn it is. The ranges of all turns cover every number,
        so that new users are invited within a round.

        Parameters
        ----------
        attempt
            Number of beacons of this cycle that nobody answered; each extends the range.
        """
        numbers, size = self._numbers, INVITED * _EXTENSION**min(attempt, 8)
        self.all_invited = size >= len(numbers)
        if self.all_invited:
            self._awaited = set(numbers)
            return 1, LAST_NUMBER
        begin = bisect.bisect_left(numbers, self._next()) // size * size
        invited = numbers[begin:begin + size]
        self._awaited = set(invited)
        return (numbers[begin - 1] + 1 if begin else 1,
                invited[-1] if begin + size < len(numbers) else LAST_NUMBER)

    def request(self, user: int) -> None:
        """Serve a user before others once, as soon as it answers."""
        self._requested[user] = None

    def _next(self) -> int:
        """Return the registered user whose turn it is."""
        if requested := next((user for user in self._requested if user in self._missed), 0):
            return requested
        match self._policy:
            case 'first':
                return self._numbers[self._turn * INVITED % len(self._numbers)]
            case 'random':
                return int(self._rng.choice(self._numbers))
        # Without a function of the user, because this is done in every cycle.
        return min(zip(self._served.values(), self._served, strict=True))[1]

    def register(self, user: int) -> None:
        """Wait for a user, without counting it among those that answered.

        A user that was invited to this cycle and has not answered in time loses its turn.
        Otherwise, the range of a user that is always late would be invited in every cycle, and
        the users of the other ranges never.
        """
        # A new user comes after all that wait and before the one served last, so that users that
        # leave and return do not gain turns.
        if user not in self._missed:
            self._served[user] = self._turn, 0
            bisect.insort(self._numbers, user)
        elif self._policy == 'round_robin' and user in self._awaited:
            self._served[user] = self._turn, 0
        self._missed[user] = 0

    def add_answer(self, user: int) -> None:
        """Register a user as answering in this cycle."""
        self._awaited.discard(user)
        self.register(user)
        self.answered[user] = None

    def remove(self, user: int) -> None:
        """Stop waiting for a user until it answers again."""
        if self._missed.pop(user, None) is not None:
            del self._served[user]
            del self._numbers[bisect.bisect_left(self._numbers, user)]
            self._awaited.discard(user)

    @property
    def awaited(self) -> Set[int]:
        """Registered users that were invited and have not answered yet."""
        return self._awaited

    @property
    def n_users(self) -> int:
        """Number of registered users."""
        return len(self._missed)

    def remove_all_except(self, is_allowed: Callable[[int], bool]) -> list[int]:
        """Remove and return the users that are not allowed."""
        removed = [user for user in sorted(self._missed) if not is_allowed(user)]
        for user in removed:
            self.remove(user)
        return removed

    def is_complete_with(self, user: int) -> bool:
        """Return whether no further answers are needed once `user` has answered."""
        if user in self._requested:
            return True
        if self._policy == 'first' and not self._awaited & self._requested.keys():
            return True
        return self._awaited <= {user}

    def remove_absent(self) -> list[int]:
        """Count missed beacons; remove and return the users that missed too many in a row.

        Beacons that do not invite a user do not count.
        """
        lost = []
        for user in sorted(self._awaited):
            self._missed[user] += 1
            if self._missed[user] >= _MAX_MISSED:
                self.remove(user)
                lost.append(user)
        return lost

    def select(self) -> int:
        """Return the user to serve, one of those that answered."""
        if requested := [user for user in self._requested if user in self.answered]:
            chosen = requested[0]
            del self._requested[chosen]
        elif self._policy == 'first':
            chosen = next(iter(self.answered))
        elif self._policy == 'random':
            chosen = int(self._rng.choice(list(self.answered)))
        else:
            chosen = min(self.answered, key=lambda user: (self._served[user], user))
        self._turn += 1
        self._served[chosen] = self._turn, 1
        return chosen


_RANGE = re.compile(r'\s*(\d+)\s*(?:-\s*(\d+)\s*)?')


class AckFilter:
    """Restricts the users whose acks are accepted, and the acks of each user per second.

    Parameters
    ----------
    allowed
        Ids of the users, as returned by `parse_users`; empty: all.
    rate_hz
        Maximum number of acks of each user in a second.
    max_users
        Highest number of a user.
    """

    def __init__(self, allowed: tuple[range, ...] = (), rate_hz: float = math.inf,
                 max_users: int = MAX_USERS) -> None:
        self._allowed, self._rate_hz, self._max_users = allowed, rate_hz, max_users
        # Acks by user in the current second; they are discarded every second, which bounds the
        # memory.
        self._acks: collections.Counter[int] = collections.Counter()
        self._second: int | None = None

    def allows(self, user: int) -> bool:
        """Return whether acks of a user may be accepted at all."""
        return user <= self._max_users and (
            not self._allowed or any(user in numbers for numbers in self._allowed))

    def within_rate(self, user: int, now_s: float) -> bool:
        """Return whether another ack of a user is within the rate.

        Parameters
        ----------
        now_s
            Time on any monotonic clock [s].
        """
        counted = self._acks[user] if math.floor(now_s) == self._second else 0
        return counted + 1 <= self._rate_hz

    def count(self, user: int, now_s: float) -> None:
        """Count an ack of a user, at a time on the clock of `within_rate` [s]."""
        second = math.floor(now_s)
        if second != self._second:
            self._second = second
            self._acks.clear()
        self._acks[user] += 1


def parse_users(text: str) -> tuple[range, ...]:
    """Parse a list of users, such as ``1, 4, 10-20``.

    Parameters
    ----------
    text
        User numbers from 1 and ranges, separated by commas; may be empty.

    Raises
    ------
    ValueError
        If a part is neither a number nor an ascending range.
    """
    return tuple(_parse_range(part) for part in text.split(',')) if text.strip() else ()


def _parse_range(part: str) -> range:
    match = _RANGE.fullmatch(part)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
    if not 1 <= first <= last <= LAST_NUMBER:
        raise ValueError(f'{part.strip()!r}, expected numbers from 1 to {LAST_NUMBER} and ranges '
                         'such as 10-20')
    return range(first, last + 1)


# The owner of a number is silent when it has not answered for this time [s], while others with its
# number have answered as many beacons: a beacon invites all of them or none.
SILENT_S = 1.0
# Time without a rejected ack after which a conflict has ended [s].
_CONFLICT_S = 5.0


@dataclasses.dataclass
class _Owner:
    """The instance that owns a number.

    Attributes
    ----------
    answered_s
        Time of its last ack [s].
    rejected
        Acks of other instances since then.
    """

    instance: int
    answered_s: float
    rejected: int = 0


class UserInstances:
    """Assigns each user number to one node: the first to answer, until it is silent."""

    def __init__(self) -> None:
        self._owners: dict[int, _Owner] = {}
        # By user: time of the last conflict, and a description.
        self._conflicts: dict[int, tuple[float, str]] = {}

    def owner(self, user: int) -> int:
        """Return the instance that owns a number; 0 if none does or if it is unknown."""
        owner = self._owners.get(user)
        return owner.instance if owner else 0

    def is_taken(self, user: int, instance: int, now_s: float) -> bool:
        """Return whether another instance owns a number and is not silent."""
        owner = self._owners.get(user)
        return owner is not None and instance != owner.instance and (
            owner.rejected < _MAX_MISSED or now_s < owner.answered_s + SILENT_S)

    def accept(self, user: int, instance: int, now_s: float) -> list[LogMessage]:
        """Record an ack of the owner of a number, or of its next owner.

        Returns
        -------
        list of LogMessage
            A warning at the first ack after one of another instance was rejected.
        """
        owner = self._owners.get(user)
        self._owners[user] = _Owner(instance, now_s)
        if owner is None or owner.instance != instance or not owner.rejected:
            return []
        text = (f'user {user}: two nodes have this number; the first one, {m.started(instance)}, '
                'is served')
        known = user in self._conflicts
        self._conflicts[user] = now_s, text
        return [] if known else [LogMessage(text, warning=True)]

    def reject(self, user: int) -> None:
        """Count an ack of an instance that does not own the number."""
        self._owners[user].rejected += 1

    def forget(self, users: Iterable[int], now_s: float) -> None:
        """Release the numbers of users that no longer answer, and end old conflicts."""
        for user in users:
            self._owners.pop(user, None)
        self._conflicts = {user: entry for user, entry in self._conflicts.items()
                           if now_s - entry[0] < _CONFLICT_S}

    def conflicts(self) -> dict[str, str]:
        """Return a description of each conflict, by key of the diagnostics."""
        return {f'conflict.user_{user}': text for user, (_, text) in self._conflicts.items()}


# Maximum number of users that one text names.
MAX_NAMED = 8


def join_users(users: Iterable[int]) -> str:
    """Return the numbers of users as a list, which ends with a count of those beyond `MAX_NAMED`.

    Examples
    --------
    >>> join_users(range(1, 12))
    '1, 2, 3, 4, 5, 6, 7, 8 and 3 others'
    """
    names = [str(user) for user in users]
    n_others = len(names) - MAX_NAMED
    others = f' and {n_others} other{"s" * (n_others > 1)}' if n_others > 0 else ''
    return f'{", ".join(names[:MAX_NAMED])}{others}'


# The reasons that concern one user; all others concern the whole network.
_USER_REASONS = {Outcome.USER_GONE.value, Outcome.NO_FIX.value}


class OutageLog:
    """Suppresses repeated log messages about the same outage.

    Missing roles are logged again once a cycle has begun. The reason for a lost cycle is logged
    again once service has resumed: to the same user for ``user_gone`` and ``no_fix``, to any user
    for other reasons.
    """

    def __init__(self) -> None:
        # Reason and user of each outage; user 0 for the whole network.
        self._open: NewestDict[tuple[str, int], None] = NewestDict(MAX_USERS)
        self._waiting_for: tuple[str, ...] = ()
        # Whether a cycle was served since something was missing.
        self._serving = False

    def log_waiting(self, missing: Iterable[str]) -> list[LogMessage]:
        """Return a warning about what is missing, unless the last one had the same text."""
        previous, self._waiting_for = self._waiting_for, tuple(missing)
        self._serving = False
        if self._waiting_for == previous:
            return []
        return [LogMessage(f'waiting for {", ".join(self._waiting_for)}', warning=True)]

    def clear_waiting(self) -> None:
        """Record that nothing is missing, because a cycle has begun."""
        self._waiting_for = ()

    @staticmethod
    def log_lost_users(users: Sequence[int]) -> list[LogMessage]:
        """Return a warning about users that stopped answering beacons, if any."""
        if not users:
            return []
        text = (f'users {join_users(users)} no longer answer' if len(users) > 1
                else f'user {users[0]} no longer answers')
        return [LogMessage(text, warning=True)]

    def log_lost_cycle(self, cycle_id: int, user: int, reason: str) -> list[LogMessage]:
        """Return a warning about a cycle without service, unless its reason was logged before."""
        key = reason, user if reason in _USER_REASONS else 0
        if key in self._open:
            return []
        self._open.put(key, None)
        return [LogMessage(f'cycle {cycle_id} of user {user} given up: {reason}', warning=True)]

    @staticmethod
    def log_removed_users(users: Iterable[int], allowed: str) -> list[LogMessage]:
        """Return a message for each user that is not in the new list of allowed users."""
        return [LogMessage(f'user {user} removed: not in allowed_users {allowed!r}')
                for user in users]

    def log_served_cycle(
            self, cycle_id: int, user: int, codebook_id: str, n_users: int) -> list[LogMessage]:
        """Return messages that service begins, and about the outages that a cycle ends, if any."""
        messages = []
        if not self._serving:
            self._serving = True
            messages.append(LogMessage(
                f'serving: codebook {codebook_id}, {n_users} user{"s" * (n_users != 1)}'))
        if ended := {key for key in self._open if key[1] in (0, user)}:
            for key in ended:
                del self._open[key]
            reasons = ', '.join(sorted(reason for reason, _ in ended))
            messages.append(LogMessage(
                f'cycle {cycle_id}: user {user} served again after: {reasons}'))
        return messages


@dataclasses.dataclass
class Cycle:
    """The memory of one cycle."""

    id: int
    attempt: int = 0  # number of beacons sent before the current one
    user: int = 0     # user that was granted the cycle; 0 before the grant
    # The granted instance of the user; if unknown, that of the first signals; otherwise 0.
    user_instance: int = 0
    # Instance of the channel that sent the first signals; 0 before them or if unknown.
    channel: int = 0
    # Bands whose configurations the RHS has reported.
    configured: set[int] = dataclasses.field(default_factory=set)
    # Feed signals by band, complex128 [F, N_SB, K].
    signals: dict[int, np.ndarray] = dataclasses.field(default_factory=dict)
    stamp_ns: int = 0  # time of the first of them [ns]; 0 if unknown
    # Signals that were sent to the positioner, once all bands are complete.
    received: m.ReceivedSignals | None = None
    beam: m.Beam | None = None
    beam_applied: bool = False  # whether the RHS has reported the configuration of the beam
    # Time at which each phase began [s]; NaN before. The latest beacon begins the first.
    began_s: np.ndarray = dataclasses.field(
        default_factory=lambda: np.full(len(m.Phase), math.nan))

    def add_signals(self, feeds: m.FeedSignals) -> None:
        """Store the feed signals of a band, and their instances and time if they are the first."""
        self.user_instance = self.user_instance or feeds.user_instance
        self.channel = self.channel or feeds.sender
        self.stamp_ns = self.stamp_ns or feeds.stamp_ns
        self.signals[feeds.band] = feeds.signals

    def pilot_request(self, n_bands: int, n_frames: int) -> m.PilotRequest:
        """Return a request of the pilots of all bands, from the first whose signals lack."""
        return m.PilotRequest(
            cycle_id=self.id, user=self.user, user_instance=self.user_instance,
            band=min(set(range(n_bands)) - self.signals.keys()), last_band=n_bands - 1,
            n_frames=n_frames)

    def report(self, phase: m.Phase, now_s: float, outcome: str = '') -> m.ProtocolState:
        """Return the message about a phase that has begun, or about the end of the cycle."""
        beacon_s = self.began_s[m.Phase.BEACONING]
        return m.ProtocolState(
            cycle_id=self.id, user=self.user, phase=phase, outcome=outcome,
            began_s=self.began_s - beacon_s, elapsed_s=float(now_s - beacon_s))
