"""The positioner, which estimates positions from received signals, and the tracks of users."""

import collections
import dataclasses
import enum
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.bounds import crlb_of
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import (
    Estimate,
    Estimator,
    Motion,
    SearchEstimator,
    SignalError,
    Tracker,
    TrackEstimate,
    surface_of,
)
from rhs_isac_ros.positioning.alternatives import describe_doubts, probabilities_of
from rhs_isac_ros.positioning.diagnosis import Diagnosis, InnovationTest
from rhs_isac_ros.positioning.tracking import MAX_GAP_S
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.base_station_memory import MAX_NAMED, MAX_USERS
from rhs_isac_ros.protocol.events import (
    Action,
    BuildEstimator,
    CodebookOffered,
    EstimatorFailed,
    EstimatorReady,
    Event,
    LogMessage,
    Outcome,
    PublishTrack,
    RevertSettings,
    Send,
    SettingsOffered,
)
from rhs_isac_ros.protocol.role import CodebookCache, NewestDict, PlainRole
from rhs_isac_ros.protocol.settings import TRACK, PendingSettings, PositionerSettings


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
            Time of the signals [s].

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
        if track is None or not track.is_of(received) or now_s < track.time_s - MAX_GAP_S:
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


# Number of residuals in the mean of a user, which bounds the memory.
_USER_WINDOW = 100


class ResidualWatch:
    """Compares residuals with the model, over all users and for each user.

    The signals of a single user with an unknown gain deviate with little effect on the mean over
    many users.
    """

    def __init__(self) -> None:
        self._codebook_id = ''
        self._all = InnovationTest()
        self._users: collections.OrderedDict[int, InnovationTest] = collections.OrderedDict()
        self._warning = ''
        self._diagnosis = Diagnosis()

    def add(self, user: int, codebook_id: str, estimate: Estimate) -> list[LogMessage]:
        """Add an estimate; return a message if a warning begins or ends."""
        if codebook_id != self._codebook_id:
            self.clear()
            self._codebook_id = codebook_id
        self._diagnosis.add(estimate)
        own = self._users.setdefault(user, InnovationTest(_USER_WINDOW))
        self._users.move_to_end(user)
        # Beyond the limit, the least recent user is forgotten.
        if len(self._users) > MAX_USERS:
            self._users.popitem(last=False)
        for monitor in (self._all, own):
            monitor.add(float(estimate.residual), float(estimate.expected_residual))
        before, self._warning = self._warning, self._describe()
        if self._warning and not before:
            return [LogMessage(self._warning, warning=True)]
        if before and not self._warning:
            return [LogMessage('the residuals match the scenario again')]
        return []

    def clear(self) -> None:
        """Forget all estimates, because the estimator or the codebook has changed."""
        self._all.clear()
        self._diagnosis.clear()
        self._users.clear()
        self._warning = ''

    def status(self) -> dict[str, str]:
        """Return the values for the diagnostics.

        Returns
        -------
        dict
            ``residual.ratio``, the mean energy of the residuals relative to the expectation;
            ``residual.spread``, the variance of the energy relative to the expectation;
            ``residual.fixes``, the number of fixes in the mean; and ``warning.residual`` during a
            warning. Before the first residual, only the values of `Diagnosis.status`, which are
            always present.
        """
        values = self._diagnosis.status(bool(self._warning))
        if not self._all.n_fixes:
            return values
        values |= {'residual.ratio': f'{self._all.ratio:.3f}',
                  'residual.spread': f'{self._all.spread:.3f}',
                  'residual.fixes': str(self._all.n_fixes)}
        return values | ({'warning.residual': self._warning} if self._warning else {})

    def _describe(self) -> str:
        """Describe the deviation; empty if there is none."""
        users = {user: monitor for user, monitor in self._users.items() if monitor.drifts}
        if not users and not self._all.drifts:
            return ''
        parts = [_deviation('', self._all)] if self._all.drifts else []
        parts += [_deviation(f'user {user}: ', users[user]) for user in sorted(users)[:MAX_NAMED]]
        if len(users) > MAX_NAMED:
            parts.append(f'{len(users) - MAX_NAMED} more users')
        return f'the signals do not match the scenario: {"; ".join(parts)}'


def _deviation(prefix: str, monitor: InnovationTest) -> str:
    return (f'{prefix}residuals {monitor.ratio:.3g} times as strong as expected, with '
            f'{monitor.spread:.3g} times the variance, over {monitor.n_fixes} cycles')


class _Loss(enum.Enum):
    """Why the signals of a user yield no position, with the text when they do so again."""

    NO_FIX = 'has a position again'
    BLOCKED = 'is in sight again'


class _Job(NamedTuple):
    """The codebook and the settings from which an estimator is built."""

    codebook: Codebook
    settings: PositionerSettings

    def equals(self, other: '_Job | None') -> bool:
        return other is not None and (self.codebook.id, self.settings) == (
            other.codebook.id, other.settings)


class _Built(NamedTuple):
    """An estimator, the job that built it, and the measurement model for its bound."""

    job: _Job
    model: MeasurementModel
    estimator: Estimator


class Positioner(PlainRole):
    """The role of the positioner.

    The codebook id of the received signals selects the estimator. Estimators are built one at a
    time in the background. Meanwhile, estimators for other codebooks remain in use, and the latest
    signals of the codebook wait for its estimator. If there is an estimator for the same codebook
    with other settings, it remains in use until the new one is ready, or permanently if the new
    one cannot be built.

    With the prior ``track``, the positioner keeps the tracks of the users; they do not survive a
    restart.

    Parameters
    ----------
    stopwatch
        Callable that returns a time [s], to measure the latency of the estimators.
    settings
        Initial settings.
    """

    SENDS = (m.PositionEstimate, m.NoFix)
    RECEIVES = (m.ReceivedSignals,)

    def __init__(
            self, scenario: Scenario, stopwatch: Callable[[], float],
            settings: PositionerSettings | None = None) -> None:
        super().__init__()
        self._scenario, self._stopwatch = scenario, stopwatch
        self._settings = PendingSettings(settings or PositionerSettings())
        # Reason why the last change of settings was reverted; empty if it was not reverted.
        self._failure = ''
        self._estimators: CodebookCache[_Built] = CodebookCache()
        self._codebook: Codebook | None = None
        # The estimator that is being built, and the latest one requested since.
        self._building: _Job | None = None
        self._next: _Job | None = None
        # Signals that wait for it, and the time of their arrival [s].
        self._waiting: tuple[m.ReceivedSignals, float] | None = None
        self._tracks = Tracks()
        # Users whose last signals yielded no position; only changes are logged. Bounded, because
        # signals may name any user.
        self._lost: NewestDict[int, _Loss] = NewestDict(MAX_USERS)
        self._residuals = ResidualWatch()
        # The last signals that were answered, and the answer.
        self._answered: tuple[m.ReceivedSignals, list[Action]] | None = None

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Process an event and return an estimate, or the request to build an estimator."""
        match event:
            case CodebookOffered(codebook):
                self._codebook = codebook
                return self._request(_Job(codebook, self._settings.latest))
            case SettingsOffered(settings):
                return self._offer_settings(settings)
            case EstimatorReady(codebook, estimator, elapsed_s):
                return [*self._keep(self._job_of(codebook), estimator, elapsed_s),
                        *self._continue()]
            case EstimatorFailed(codebook, reason):
                return [*self._revert(self._job_of(codebook), reason), *self._continue()]
            case m.ReceivedSignals():
                return self._receive(event, now_s)
        return []

    def status(self) -> Mapping[str, str]:
        """Return the settings and codebook in use, pending settings and the last failure."""
        failed = {'failed.estimator': self._failure} if self._failure else {}
        return (self._settings.describe() | failed | self._residuals.status()
                | {'codebook_id': self._estimators.in_use})

    def _offer_settings(self, settings: PositionerSettings) -> list[Action]:
        self._settings.latest, self._failure = settings, ''
        if self._codebook is None:
            return [*self._settings.apply()]
        return self._request(_Job(self._codebook, settings))

    def _request(self, job: _Job) -> list[Action]:
        built = self._estimators.peek(job.codebook.id)
        if built and job.equals(built.job):
            self._next = None
            return []
        if self._building is not None:
            self._next = None if job.equals(self._building) else job
            return []
        self._building = job
        return [BuildEstimator(job.codebook, job.settings)]

    def _job_of(self, codebook: Codebook) -> _Job:
        return self._building or _Job(codebook, self._settings.latest)

    def _keep(self, job: _Job, estimator: Estimator, elapsed_s: float) -> list[Action]:
        """Store an estimator, unless other settings were offered meanwhile."""
        codebook = job.codebook
        is_current = job.settings == self._settings.latest
        if not is_current and codebook.id in self._estimators:
            return []
        model = MeasurementModel(self._scenario, codebook, surface_of(estimator)).prepare()
        self._estimators.put(codebook.id, _Built(job, model, estimator))
        self._settings.in_use = job.settings
        self._residuals.clear()
        return [LogMessage(
            f'{estimator.name} is ready for codebook {codebook.id} after {elapsed_s:.1f} s')]

    def _revert(self, job: _Job, reason: str) -> list[Action]:
        """Revert to the settings in use if new settings caused the failure."""
        kept = self._settings.in_use
        if job.settings == kept:
            return [LogMessage(
                f'no estimator for codebook {job.codebook.id}: {reason}', warning=True)]
        if job.settings != self._settings.latest:
            return []
        self._settings.latest = kept
        self._failure = f'{job.settings.estimator}: {reason}'
        # A codebook offered meanwhile needs an estimator with the settings in use.
        self._next = _Job((self._next or job).codebook, kept)
        text = (f'cannot build estimator {job.settings.estimator}, keeping {kept.estimator}: '
                f'{reason}')
        return [LogMessage(text, warning=True), RevertSettings(kept)]

    def _continue(self) -> list[Action]:
        """Request the next estimator and process the signals that waited for the last one."""
        waiting, job = self._waiting, self._next
        self._building = self._next = self._waiting = None
        actions = self._request(job) if job else []
        return actions + (self._receive(*waiting) if waiting else [])

    def _receive(self, received: m.ReceivedSignals, now_s: float) -> list[Action]:
        if self._answered and m.same(self._answered[0], received):
            self.count(Outcome.DUPLICATE)
            return self._answered[1]
        if received.codebook_id in self._estimators:
            self._answered = received, self._locate(received, now_s)
            return self._answered[1]
        expected = {job.codebook.id for job in (self._building, self._next) if job}
        if received.codebook_id in expected:
            self._waiting = received, now_s
        else:
            self.count(Outcome.WRONG_CODEBOOK)
        return []

    def _locate(self, received: m.ReceivedSignals, now_s: float) -> list[Action]:
        job, model, estimator = self._estimators.take(received.codebook_id)
        begin = self._stopwatch()
        try:
            estimate = self._estimate(received, estimator, job.settings, now_s)
        except SignalError as error:
            return self._no_fix(received, str(error))
        latency_s = self._stopwatch() - begin
        residuals = self._residuals.add(received.user, received.codebook_id, estimate)
        if not estimate.fix:
            return [*self._no_fix(received, str(estimate.reason)), *residuals]
        return [*self._fix(received, estimate, latency_s), *residuals]

    def _fix(self, received: m.ReceivedSignals, estimate: Estimate,
             latency_s: float) -> list[Action]:
        _, model, estimator = self._estimators.take(received.codebook_id)
        bound = float(crlb_of(model, estimate.mean[None])[0])
        probabilities: dict[str, Any] = {
            f'{name}_probability': value for name, value in probabilities_of(estimate).items()}
        actions: list[Action] = [Send(m.PositionEstimate(
            cycle_id=received.cycle_id, stamp_ns=received.stamp_ns, user=received.user,
            user_instance=received.user_instance, codebook_id=received.codebook_id,
            position=np.array(estimate.mean), covariance_m2=np.array(estimate.covariance),
            crlb_m2=bound, estimator=estimator.name, latency_s=latency_s,
            **probabilities))]
        loss = None
        if isinstance(estimate, TrackEstimate):
            actions.append(PublishTrack(received.user, estimate, received.stamp_ns))
            loss = _Loss.BLOCKED if estimate.is_predicted else None
        return [*actions, *self._log(
            received, loss, f'the track of user {received.user} predicts its position: '
            f'{describe_doubts(estimate)}')]

    def _estimate(
            self, received: m.ReceivedSignals, estimator: Estimator, settings: PositionerSettings,
            now_s: float) -> Estimate:
        if settings.prior == TRACK:
            return self._tracks.locate(
                received, estimator, settings.track_speed_mps, received.time_s(now_s))
        self._tracks.clear()
        return estimator.estimate(received.signals.reshape(len(received.signals), -1))

    def _no_fix(self, received: m.ReceivedSignals, reason: str) -> list[Action]:
        self.count(Outcome.NO_FIX)
        sent = Send(m.NoFix(
            cycle_id=received.cycle_id, stamp_ns=received.stamp_ns, user=received.user,
            codebook_id=received.codebook_id, reason=reason))
        return [sent, *self._log(
            received, _Loss.NO_FIX, f'no fix of user {received.user}: {reason}')]

    def _log(self, received: m.ReceivedSignals, loss: _Loss | None, text: str = ''
             ) -> list[LogMessage]:
        """Log a change of whether the signals of a user yield a position."""
        before = self._lost.pop(received.user, None)
        if loss:
            self._lost.put(received.user, loss)
        elif before:
            text = f'user {received.user} {before.value}'
        if before is loss:
            return []
        return [LogMessage(f'cycle {received.cycle_id}: {text}', warning=loss is _Loss.NO_FIX)]


def build_estimator(
        codebook: Codebook, make: Callable[[Codebook], Estimator],
        stopwatch: Callable[[], float]) -> EstimatorReady | EstimatorFailed:
    """Build the estimator that `BuildEstimator` requests; this may run in another thread.

    Parameters
    ----------
    make
        Callable that takes a codebook and returns an estimator.
    stopwatch
        Callable that returns a time [s].
    """
    begin = stopwatch()
    try:
        estimator = make(codebook)
    # Possible causes: the codebook, the model file, a full disk or memory.
    except (ValueError, OSError, MemoryError) as error:
        return EstimatorFailed(codebook, str(error) or type(error).__name__)
    return EstimatorReady(codebook, estimator, stopwatch() - begin)
