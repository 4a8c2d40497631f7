"""Who and what is in the scene of a network, as its messages tell it."""

import collections
import dataclasses
import math

import numpy as np

from rhs_isac_ros.protocol import messages as m

# Messages that the scene is made of.
RECEIVES = (m.RhsConfiguration, m.GroundTruth, m.PositionEstimate, m.Beam)
# A path holds the newest positions, and of a user that stands still only one.
_LONGEST_PATH = 200
_STEP_M = 0.05


def _path() -> collections.deque[np.ndarray]:
    return collections.deque(maxlen=_LONGEST_PATH)


@dataclasses.dataclass
class UserState:
    """One user.

    Attributes
    ----------
    user
        Its number.
    seen_s
        When it was heard of last [s].
    truth
        Where it really is; None if nobody told.
    estimate
        The newest estimate; None if there is none yet.
    true_path, path
        Its true positions and the estimates, float64 [3] [m] each, the newest last.
    """

    user: int
    seen_s: float
    truth: m.GroundTruth | None = None
    estimate: m.PositionEstimate | None = None
    true_path: collections.deque[np.ndarray] = dataclasses.field(default_factory=_path)
    path: collections.deque[np.ndarray] = dataclasses.field(default_factory=_path)
    # The true position for which the signals of a cycle were made.
    _sounded: m.GroundTruth | None = None

    @property
    def error_m(self) -> float:
        """Distance of the estimate from the true position of its cycle [m]; NaN if not known."""
        told, found = self._sounded, self.estimate
        if told is None or found is None or told.cycle_id != found.cycle_id:
            return math.nan
        return float(np.linalg.norm(found.position - told.position))

    def move(self, truth: m.GroundTruth) -> None:
        """Take a true position.

        Parameters
        ----------
        truth
            The position.
        """
        self.truth = truth
        if truth.cycle_id:
            self._sounded = truth
        if not self.true_path or math.dist(self.true_path[-1], truth.position) > _STEP_M:
            self.true_path.append(truth.position)

    def locate(self, estimate: m.PositionEstimate) -> None:
        """Take an estimate.

        Parameters
        ----------
        estimate
            The estimate.
        """
        self.estimate = estimate
        self.path.append(estimate.position)


class SceneState:
    """The scene: the surface, its beam, and every user of whom something was heard lately.

    Attributes
    ----------
    configuration
        What the surface applies; None if that is not known.
    beam
        The newest beam of a transmission; None before the first.
    users
        Users by number.
    """

    def __init__(self) -> None:
        self.configuration: m.RhsConfiguration | None = None
        self.beam: m.Beam | None = None
        self.users: dict[int, UserState] = {}
        self._beam_s = math.nan

    def add(self, message: m.Message, now_s: float) -> None:
        """Take a message.

        Parameters
        ----------
        message
            One of `RECEIVES`.
        now_s
            When it was heard [s].
        """
        match message:
            case m.RhsConfiguration():
                self.configuration = message
            case m.Beam():
                self.beam, self._beam_s = message, now_s
            case m.GroundTruth():
                self._of(message.user, now_s).move(message)
            case m.PositionEstimate():
                self._of(message.user, now_s).locate(message)

    def _of(self, user: int, now_s: float) -> UserState:
        sighting = self.users.setdefault(user, UserState(user, now_s))
        sighting.seen_s = now_s
        return sighting

    def forget(self, before_s: float) -> list[int]:
        """Forget users that were not heard of lately, a beam for one of them, and an old beam.

        Parameters
        ----------
        before_s
            What was heard of last before this time is forgotten [s].

        Returns
        -------
        list of int
            The users that are forgotten.
        """
        gone = [user for user, sighting in self.users.items() if sighting.seen_s < before_s]
        for user in gone:
            del self.users[user]
        if self.beam is not None and (self.beam.user in gone or self._beam_s < before_s):
            self.beam = None
        return gone

    @property
    def complete(self) -> bool:
        """Whether surface, beam and some users are there, and every user has an estimate."""
        return (self.configuration is not None and self.beam is not None and bool(self.users)
                and all(sighting.estimate for sighting in self.users.values()))

    @property
    def newest(self) -> UserState | None:
        """The user of the newest cycle that has an estimate; None if there is none."""
        located = [sighting for sighting in self.users.values() if sighting.estimate]
        return max(located, key=lambda sighting: sighting.estimate.cycle_id, default=None)
