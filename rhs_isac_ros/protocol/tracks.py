"""The tracks of all users."""

import dataclasses

from rhs_isac_ros.positioning import Estimate, Estimator, Motion, SearchEstimator, Tracker
from rhs_isac_ros.positioning.tracking import MAX_GAP_S
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.newest import NewestDict
from rhs_isac_ros.protocol.user_scheduler import MAX_USERS


@dataclasses.dataclass
class _Track:
    """A track, and the latest signals that continued it with the time of their arrival [s]."""

    tracker: Tracker
    latest: m.ReceivedSignals
    time_s: float

    def is_late(self, received: m.ReceivedSignals) -> bool:
        """Return whether signals belong to an earlier cycle; base stations number their own."""
        return received.sender == self.latest.sender and (
            received.cycle_id <= self.latest.cycle_id)

    def is_of(self, received: m.ReceivedSignals) -> bool:
        """Return whether signals come from the instance of the user that has the track."""
        return m.same_instance(received.user_instance, self.latest.user_instance)


class Tracks:
    """A track for each user, started and ended by the signals alone.

    A track ends with a gap, with another instance of the user, or if thousands of other users have
    been located since. Signals of an earlier cycle are located without the track.
    """

    def __init__(self) -> None:
        self._tracks: NewestDict[int, _Track] = NewestDict(MAX_USERS)

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self._tracks)

    def clear(self) -> None:
        """End all tracks."""
        self._tracks.clear()

    def locate(
            self, received: m.ReceivedSignals, estimator: Estimator, speed_mps: float,
            now_s: float) -> Estimate:
        """Estimate the position of a user; a `TrackEstimate` if the signals continue its track.

        Parameters
        ----------
        speed_mps
            Typical speed of the users [m/s], for new tracks.
        now_s
            Time at which the signals arrived [s].

        Raises
        ------
        SignalError
            If the signals cannot be used.
        """
        signals = received.signals.reshape(len(received.signals), -1)
        self._end_old(now_s)
        track = self._tracks.get(received.user)
        if not isinstance(estimator, SearchEstimator) or track and track.is_late(received):
            return estimator.estimate(signals)
        if track is None or not track.is_of(received):
            track = _Track(Tracker(estimator, Motion(speed_mps)), received, now_s)
        track.tracker.estimator = estimator
        estimate = track.tracker.update(now_s, signals)
        if estimate.fix:
            track.latest, track.time_s = received, now_s
            self._tracks.put(received.user, track)
        return estimate

    def _end_old(self, now_s: float) -> None:
        # The oldest track comes first.
        while self._tracks:
            user, track = next(iter(self._tracks.items()))
            if now_s <= track.time_s + MAX_GAP_S:
                return
            del self._tracks[user]
