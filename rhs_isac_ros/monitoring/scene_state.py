"""State of the scene of a network: users, beam and surface, as reported by its messages."""

import collections
import dataclasses
import math

import numpy as np

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.user_scheduler import MAX_USERS

# Messages that the scene state needs.
RECEIVES = (m.RhsConfiguration, m.GroundTruth, m.GroundTruths, m.PositionEstimate, m.Beam)
# Maximum number of positions in a path, and minimum distance between consecutive true positions.
_MAX_PATH_LENGTH = 200
_MIN_STEP_M = 0.05


def _empty_path() -> collections.deque[np.ndarray]:
    return collections.deque(maxlen=_MAX_PATH_LENGTH)


@dataclasses.dataclass
class UserState:
    """Position, estimate and paths of one user.

    Attributes
    ----------
    user
        Id of the user.
    updated_s
        Arrival of the latest message about the user [s].
    truth
        The true position; None before the first.
    estimate
        The latest estimate; None before the first.
    true_path, estimated_path
        True positions and estimates, float64 [3] [m] each, the latest last.
    """

    user: int
    updated_s: float
    truth: m.GroundTruth | None = None
    estimate: m.PositionEstimate | None = None
    true_path: collections.deque[np.ndarray] = dataclasses.field(default_factory=_empty_path)
    estimated_path: collections.deque[np.ndarray] = dataclasses.field(
        default_factory=_empty_path)
    # The true position at which the pilots of the latest cycle were sent.
    _cycle_truth: m.GroundTruth | None = None

    @property
    def error_m(self) -> float:
        """Distance of the estimate from the true position of its cycle [m]; NaN if unknown."""
        truth, estimate = self._cycle_truth, self.estimate
        if truth is None or estimate is None or truth.cycle_id != estimate.cycle_id:
            return math.nan
        return float(np.linalg.norm(estimate.position - truth.position))

    def add_truth(self, truth: m.GroundTruth) -> None:
        """Add a true position."""
        self.truth = truth
        if truth.cycle_id:
            self._cycle_truth = truth
        if not self.true_path or math.dist(self.true_path[-1], truth.position) > _MIN_STEP_M:
            self.true_path.append(truth.position)

    def add_estimate(self, estimate: m.PositionEstimate) -> None:
        """Add an estimate."""
        self.estimate = estimate
        self.estimated_path.append(estimate.position)


class SceneState:
    """The surface, its beam, and the users.

    Attributes
    ----------
    configuration
        Configuration that the surface applies; None before the first message.
    beam
        Latest beam of a transmission; None before the first.
    users
        Users by id, at most `MAX_USERS`, because the ids come from messages. Further users are
        ignored until others are discarded.
    """

    def __init__(self) -> None:
        self.configuration: m.RhsConfiguration | None = None
        self.beam: m.Beam | None = None
        self.users: dict[int, UserState] = {}
        self._beam_s = math.nan

    def add(self, message: m.Message, now_s: float) -> None:
        """Add a message of one of the types `RECEIVES` that arrived at `now_s` [s]."""
        match message:
            case m.RhsConfiguration():
                self.configuration = message
            case m.Beam():
                self.beam, self._beam_s = message, now_s
            case m.GroundTruth():
                self._add_truth(message, now_s)
            case m.GroundTruths():
                for truth in message.each():
                    self._add_truth(truth, now_s)
            case m.PositionEstimate():
                if state := self._updated_user(message.user, now_s):
                    state.add_estimate(message)

    def _add_truth(self, truth: m.GroundTruth, now_s: float) -> None:
        if state := self._updated_user(truth.user, now_s):
            state.add_truth(truth)

    def _updated_user(self, user: int, now_s: float) -> UserState | None:
        """Return the state of a user; None if it is new and there are too many."""
        state = self.users.get(user)
        if state is None:
            if len(self.users) >= MAX_USERS:
                return None
            state = self.users[user] = UserState(user, now_s)
        state.updated_s = now_s
        return state

    def discard_stale(self, before_s: float) -> list[int]:
        """Discard users and a beam without a message since `before_s` [s]; return the users.

        A beam to a discarded user is discarded as well.
        """
        stale = [user for user, state in self.users.items() if state.updated_s < before_s]
        for user in stale:
            del self.users[user]
        if self.beam is not None and (self.beam.user in stale or self._beam_s < before_s):
            self.beam = None
        return stale

    @property
    def drawable(self) -> bool:
        """Whether the surface, an estimate and its beam are known."""
        return self.configuration is not None and self.shown_beam is not None

    @property
    def complete(self) -> bool:
        """Whether the scene is drawable and every user has an estimate."""
        return self.drawable and not self.without_estimate

    @property
    def without_estimate(self) -> list[int]:
        """Ids of the users without an estimate, sorted."""
        return sorted(user for user, state in self.users.items() if not state.estimate)

    @property
    def shown_user(self) -> UserState | None:
        """The user of the latest cycle with an estimate and a beam, or else with an estimate.

        None if there is no estimate.
        """
        if self.beam is not None:
            state = self.users.get(self.beam.user)
            if state and state.estimate and state.estimate.cycle_id == self.beam.cycle_id:
                return state
        cycles = [(state.estimate.cycle_id, user) for user, state in self.users.items()
                  if state.estimate]
        return self.users[max(cycles)[1]] if cycles else None

    @property
    def shown_beam(self) -> m.Beam | None:
        """The beam of the cycle in which the shown user was estimated; None if it is unknown."""
        shown = self.shown_user
        if shown is None or shown.estimate is None or self.beam is None:
            return None
        same = (shown.user, shown.estimate.cycle_id) == (self.beam.user, self.beam.cycle_id)
        return self.beam if same else None
