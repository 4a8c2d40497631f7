"""The positioner, which estimates the positions and the tracks of users from received signals."""

import collections
import dataclasses
import enum
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.codebook.library import EMPTY, Library
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import position_problem
from rhs_isac_ros.model.measurement import KnownSurface
from rhs_isac_ros.positioning import (
    BayesEstimator,
    Estimate,
    Estimator,
    Motion,
    SearchEstimator,
    SignalError,
    Tracker,
)
from rhs_isac_ros.positioning.alternatives import describe_doubts, probabilities_of
from rhs_isac_ros.positioning.diagnosis import WINDOW, InnovationTest, diagnose
from rhs_isac_ros.positioning.estimate import MISS_PROBABILITY, estimate_of
from rhs_isac_ros.positioning.tracking import MAX_GAP_S
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import EstimatorBuilt, Event, Outcome
from rhs_isac_ros.protocol.following import proposal
from rhs_isac_ros.protocol.fusion import posterior_of
from rhs_isac_ros.protocol.role import CodebookCache, NewestDict, Role
from rhs_isac_ros.protocol.settings import TRACK, PendingSettings, PositionerSettings
from rhs_isac_ros.protocol.user_registry import MAX_USERS
from rhs_isac_ros.support.plugins import PluginError, calling
from rhs_isac_ros.support.texts import MAX_LISTED, counted
from rhs_isac_ros.system import System

# Maximum number of tracks, each of which takes about 0.1 MB.
_MAX_TRACKS = 512


@dataclasses.dataclass
class _Track:
    """A track, and the latest signals that it includes, which were measured at `time_s` [s].

    `interval_s` is the time since the signals before [s]; 0 if there are none.
    """

    tracker: Tracker
    latest: m.ReceivedSignals
    time_s: float
    interval_s: float = 0.0

    def is_late(self, received: m.ReceivedSignals) -> bool:
        """Return whether signals have the same sender as `latest`, and are not newer."""
        return received.sender == self.latest.sender and (
            received.cycle_id <= self.latest.cycle_id)

    def is_over(self, now_s: float) -> bool:
        """Return whether the gap to signals is too long, or the clock has been reset."""
        return abs(now_s - self.time_s) > MAX_GAP_S


class Tracks:
    """One track for each user, derived from the received signals.

    A track ends after a gap of `MAX_GAP_S` or a reset of the clock, when another instance of the
    user is located, or after `_MAX_TRACKS` other users. Late signals neither use nor change a
    track. The times of signals are only compared with those of the same user, because they come
    from the clock of the user's host.
    """

    def __init__(self) -> None:
        self._tracks: NewestDict[int, _Track] = NewestDict(_MAX_TRACKS)
        #: Posterior of the latest signals if they belong to a track.
        self.posterior: Estimate | None = None

    def clear(self) -> None:
        """End all tracks."""
        self._tracks.clear()

    def locate(
            self, received: m.ReceivedSignals, estimator: Estimator, speed_mps: float,
            now_s: float) -> Estimate:
        """Estimate the position of a user from signals that were measured at `now_s` [s].

        If the signals begin or continue a track, the result has a number of phases, and
        `posterior` is that of the latest signals. A new track assumes the typical speed
        `speed_mps`. Raises SignalError if the signals are unusable.
        """
        signals, self.posterior = received.stacked, None
        track = self._tracks.get(received.user)
        if track and track.is_over(now_s):
            track = None
        if not isinstance(estimator, SearchEstimator) or track and track.is_late(received):
            return estimate_of(estimator, signals)
        if track is None or not m.same_instance(
                received.user_instance, track.latest.user_instance):
            track = _Track(Tracker(estimator, Motion(speed_mps)), received, now_s)
        track.tracker.estimator = estimator
        with calling(type(estimator).__name__, SignalError):
            estimate = track.tracker.update(now_s, signals)
        self.posterior = track.tracker.latest
        if estimate.fix:
            track.interval_s = now_s - track.time_s
            track.latest, track.time_s = received, now_s
            self._tracks.put(received.user, track)
        return estimate

    def predict(self, user: int) -> tuple[np.ndarray, float, float] | None:
        """Predict a user's position at its next signals, if these come after equal intervals.

        Returns the position in the frame of the surface, float64 [3] [m], the root of the mean
        variance of its coordinates [m], and the interval [s]. The result is None without two
        signals, or if the latest signals contradict the track.
        """
        track = self._tracks.get(user)
        if not (track and track.interval_s > 0 and self.posterior) or self.posterior.is_elsewhere:
            return None
        predicted = track.tracker.predict(track.time_s + track.interval_s)
        return predicted and (
            predicted[0], float(np.trace(predicted[1]) / 3)**0.5, track.interval_s)


# Number of residuals that are kept for each user.
_USER_WINDOW = 100


class ResidualWatch:
    """Compares residuals with the model, for all users together and for each user separately.

    If only one user deviates, for instance by an unknown gain, the mean over many users hardly
    changes. `level_db` is as in `InnovationTest`.
    """

    def __init__(self, level_db: tuple[float, float] = (0.0, 0.0)) -> None:
        self._level_db = level_db
        self._all = InnovationTest(WINDOW, level_db)
        self._users: NewestDict[int, InnovationTest] = NewestDict(MAX_USERS)
        self._warning = ''
        self._estimates: collections.deque[Estimate] = collections.deque(maxlen=WINDOW)

    def add(self, user: int, estimate: Estimate) -> tuple[str, bool]:
        """Add an estimate; return a text if a warning begins or ends, and whether it begins."""
        self._estimates.append(estimate)
        own = self._users.get(user) or InnovationTest(_USER_WINDOW, self._level_db)
        self._users.put(user, own)
        for monitor in (self._all, own):
            monitor.add(float(estimate.residual), float(estimate.expected_residual))
        before, self._warning = self._warning, self._describe()
        if bool(before) == bool(self._warning):
            return '', False
        return self._warning or 'the residuals match the scenario again', bool(self._warning)

    def clear(self) -> None:
        """Forget all estimates, because the estimator of the whole region has changed."""
        self._all.clear()
        self._estimates.clear()
        self._users.clear()
        self._warning = ''

    def status(self) -> dict[str, str]:
        """Return details for the diagnostics, including the result of `diagnose`.

        ``residual.ratio`` and ``residual.spread`` are the mean and the variance of the energies of
        the residuals, relative to the model. Both cover ``residual.fixes`` residuals.
        ``warning.residual`` is the text of the current warning.
        """
        details = diagnose(self._estimates, bool(self._warning), self._level_db[1])
        if self._all.n_residuals:
            details |= {'residual.ratio': f'{self._all.ratio:.3f}',
                       'residual.spread': f'{self._all.spread:.3f}',
                       'residual.fixes': str(self._all.n_residuals)}
        return details | ({'warning.residual': self._warning} if self._warning else {})

    def _describe(self) -> str:
        users = sorted(user for user, monitor in self._users.items() if monitor.drifts)
        parts = [_deviation('', self._all)] if self._all.drifts else []
        parts += [_deviation(f'user {user}: ', self._users[user]) for user in users[:MAX_LISTED]]
        if len(users) > MAX_LISTED:
            parts.append(counted(len(users) - MAX_LISTED, 'more user'))
        return f'the signals do not match the scenario: {"; ".join(parts)}' if parts else ''


def _deviation(prefix: str, monitor: InnovationTest) -> str:
    return (f'{prefix}residuals {monitor.ratio:.3g} times as strong as expected, with '
            f'{monitor.spread:.3g} times the variance, over {monitor.n_residuals} cycles')


class _Loss(enum.Enum):
    """Reason why signals yield no position; the value is logged when they yield one again."""

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
    """An estimator, the job that built it, and the system for its bound."""

    job: _Job
    system: System
    estimator: Estimator


class Positioner(Role):
    """The role that estimates the positions of users.

    The codebook id of the received signals selects the estimator. Estimators are built one at a
    time in the background. Meanwhile, existing estimators remain in use; the latest signals wait
    if their estimator is being built. New settings take effect once an estimator is built with
    them; if the build fails, the old settings and estimator remain in use. The tracks of the prior
    ``track`` do not survive a restart. `stopwatch` returns a time [s], to measure latencies, and
    `is_observed` whether anyone receives posteriors, which take a moment to convert.

    Estimates from a track propose the codebook of the `library` for the predicted position. The
    estimator of such a codebook, with the option `left_out`, is created when it is first used. Its
    table of the region is computed in the background, or when a track does not explain the
    signals, or there is none.
    """

    SENDS = (m.PositionEstimate, m.Posterior, m.NoFix)
    RECEIVES = (m.ReceivedSignals,)

    def __init__(
            self, scenario: Scenario, stopwatch: Callable[[], float],
            settings: PositionerSettings | None = None,
            is_observed: Callable[[], bool] = lambda: False, library: Library = EMPTY,
            left_out: float = MISS_PROBABILITY) -> None:
        super().__init__()
        self._library, self._left_out = library, left_out
        self._scenario, self._stopwatch = scenario, stopwatch
        self._is_observed = is_observed
        self._settings = PendingSettings(settings or PositionerSettings())
        # Reason why the latest change of settings was reverted; empty if it was not.
        self._failure = ''
        self._estimators: CodebookCache[_Built] = CodebookCache(library.by_id)
        self._surface: KnownSurface | None = None  # knowledge of the surface in the estimators
        self._codebook: Codebook | None = None
        # The job whose estimator is being built, and the job that comes next.
        self._building: _Job | None = None
        self._next: _Job | None = None
        # Signals that wait for an estimator, and the time of their arrival [s].
        self._waiting: tuple[m.ReceivedSignals, float] | None = None
        self._tracks = Tracks()
        # Users whose latest signals yielded no position, so that only changes are logged.
        self._lost: NewestDict[int, _Loss] = NewestDict(MAX_USERS)
        self._residuals = ResidualWatch(scenario.multipath_level_db)
        # The last signals that were answered, and the messages of the answer.
        self._answered: tuple[m.ReceivedSignals, list[events.Action]] | None = None

    def status(self) -> Mapping[str, str]:
        """Return the settings, the codebook in use, the last failure and the residuals."""
        failed = {'failed.estimator': self._failure} if self._failure else {}
        return (self._settings.describe() | failed | self._residuals.status()
                | {'codebook_id': self._estimators.in_use})

    def react(self, event: Event) -> None:
        """Process an event: answer received signals, or request or store an estimator."""
        match event:
            case events.CodebookOffered(codebook):
                self._codebook = codebook
                self._request(_Job(codebook, self._settings.latest))
            case events.SettingsOffered(settings):
                self._settings.latest, self._failure = settings, ''
                if self._codebook:
                    self._request(_Job(self._codebook, settings))
                else:
                    self.log(self._settings.apply())
            case EstimatorBuilt(codebook, estimator, elapsed_s, failure):
                job = self._building or _Job(codebook, self._settings.latest)
                try:
                    if estimator is None:
                        self._revert(job, failure)
                    else:
                        self._keep(job, estimator, elapsed_s)
                except PluginError as error:
                    self._revert(job, str(error))
                self._continue()
            case m.ReceivedSignals():
                self._receive(event, self.now_s)

    def _request(self, job: _Job) -> None:
        """Request an estimator unless it exists; if another one is being built, queue the job."""
        built = self._estimators.get(job.codebook.id)
        if (built and job.equals(built.job)) or job.equals(self._building):
            self._next = None
        elif self._building:
            self._next = job
        else:
            self._building = job
            self.act(events.BuildEstimator(job.codebook, job.settings))

    def _keep(self, job: _Job, estimator: Estimator, elapsed_s: float) -> None:
        """Store an estimator, unless it is outdated and there is another one for the codebook."""
        codebook = job.codebook
        if job.settings != self._settings.latest and codebook.id in self._estimators:
            return
        for known in self._library.by_id:
            self._estimators.pop(known, None)
        self._surface = self._put(job, estimator).surface
        self._settings.in_use = job.settings
        self._residuals.clear()
        self.log(f'{estimator.name} is ready for codebook {codebook.id} after {elapsed_s:.1f} s')

    def _put(self, job: _Job, estimator: Estimator) -> System:
        """Store an estimator, and return its system, which a plug-in need not have."""
        system = getattr(estimator, 'system', None)
        if not isinstance(system, System):
            system = System(self._scenario, job.codebook)
        system.prepare()
        self._estimators.put(job.codebook.id, _Built(job, system, estimator))
        return system

    def _has_estimator(self, codebook_id: str) -> bool:
        """Return whether there is an estimator; first create one for a codebook of the library."""
        settings, cell = self._settings.in_use, self._library.by_id.get(codebook_id)
        if cell and settings.prior == TRACK and codebook_id not in self._estimators:
            estimator = BayesEstimator(
                System(self._scenario, cell, self._surface),
                reject_outside=settings.reject_outside, lazy=True, left_out=self._left_out)
            self._put(_Job(cell, settings), estimator)
            self.act(events.PrepareEstimator(estimator))
        return codebook_id in self._estimators

    def _revert(self, job: _Job, reason: str) -> None:
        """Handle a failed build; if it had the latest settings, revert to the settings in use."""
        kept = self._settings.in_use
        if job.settings == kept:
            self.log(f'no estimator for codebook {job.codebook.id}: {reason}', warning=True)
        elif job.settings == self._settings.latest:
            self._settings.latest = kept
            self._failure = f'{job.settings.estimator}: {reason}'
            # A codebook offered meanwhile needs an estimator with the settings in use.
            self._next = _Job((self._next or job).codebook, kept)
            self.log(f'cannot build estimator {job.settings.estimator}, keeping '
                     f'{kept.estimator}: {reason}', warning=True)
            self.act(events.RevertSettings(kept))

    def _continue(self) -> None:
        waiting, job = self._waiting, self._next
        self._building = self._next = self._waiting = None
        if job:
            self._request(job)
        if waiting:
            self._receive(*waiting)

    def _receive(self, received: m.ReceivedSignals, now_s: float) -> None:
        if self._answered and m.same(self._answered[0], received):
            self.count(Outcome.DUPLICATE)
            self._actions += self._answered[1]
        elif self._has_estimator(received.codebook_id):
            self._locate(received, now_s)
            self._answered = received, [
                action for action in self._actions if isinstance(action, events.Send)]
        elif received.codebook_id in {
                job.codebook.id for job in (self._building, self._next) if job}:
            self._waiting = received, now_s
        else:
            self.count(Outcome.WRONG_CODEBOOK)

    def _locate(self, received: m.ReceivedSignals, now_s: float) -> None:
        job, system, estimator = self._estimators.take(received.codebook_id)
        begin, problem, crlb_m2 = self._stopwatch(), '', np.nan
        try:
            estimate = self._estimate(received, job.settings, estimator, now_s)
            latency_s = self._stopwatch() - begin
            if estimate.fix and not (problem := position_problem(estimate.mean)):
                crlb_m2 = float(system.crlb(estimate.mean[None])[0])
        except (SignalError, PluginError) as error:
            if error.__cause__ and isinstance(error, PluginError):
                self.act(self.noted(error))
            self._no_fix(received, str(error))
            return
        probabilities = {f'{name}_probability': value
                         for name, value in probabilities_of(estimate).items()}
        if estimate.fix and not problem:
            of_site = estimate.to_site(self._scenario.pose)
            self.send(m.derive(
                m.PositionEstimate, received, stamp_ns=received.stamp_ns,
                position=of_site.mean, covariance_m2=of_site.covariance, crlb_m2=crlb_m2,
                estimator=estimator.name, latency_s=latency_s, **probabilities, **proposal(
                    self._library, self._tracks.predict(received.user)
                    if self._library.by_id and estimate.n_phases else None)))
            self._publish_track(received, of_site)
        else:
            self._no_fix(received, f'position: {problem}' if problem else str(estimate.reason))
        if self._is_observed() and not problem and (sighting := estimate.sighting):
            self.send(posterior_of(
                received, sighting, stamp_ns=received.stamp_ns, **probabilities))
        text, begins = self._residuals.add(received.user, estimate)
        if text:
            self.log_state('residuals', text, begins)

    def _estimate(
            self, received: m.ReceivedSignals, settings: PositionerSettings, estimator: Estimator,
            now_s: float) -> Estimate:
        """Estimate a position; if posteriors are observed, the result has a sighting."""
        if settings.prior == TRACK:
            return self._tracks.locate(
                received, estimator, settings.track_speed_mps, received.time_s(now_s))
        self._tracks.clear()
        if self._is_observed() and isinstance(estimator, SearchEstimator):
            with calling(f'{type(estimator).__name__}.posterior', SignalError):
                return estimator.posterior(received.stacked)
        return estimate_of(estimator, received.stacked)

    def _publish_track(self, received: m.ReceivedSignals, estimate: Estimate) -> None:
        user, loss = received.user, _Loss.BLOCKED if estimate.is_predicted else None
        if np.isfinite(estimate.velocity).all():
            self.act(events.PublishTrack(user, estimate, received.stamp_ns))
        self._log_change(received, loss, f'the track of user {user} predicts its position: '
                         f'{describe_doubts(estimate)}')

    def _no_fix(self, received: m.ReceivedSignals, reason: str) -> None:
        self.count(Outcome.NO_FIX)
        self.send(m.derive(m.NoFix, received, stamp_ns=received.stamp_ns, reason=reason))
        self._log_change(received, _Loss.NO_FIX, f'no fix of user {received.user}: {reason}')

    def _log_change(self, received: m.ReceivedSignals, loss: _Loss | None, text: str) -> None:
        """Log a new reason why a user's signals yield no position, and the end of such a loss."""
        before = self._lost.pop(received.user, None)
        if loss:
            self._lost.put(received.user, loss)
        elif before:
            text = f'user {received.user} {before.value}'
        if before is not loss:
            self.log_state(
                f'signals of user {received.user}', f'cycle {received.cycle_id}: {text}',
                loss is not None, warning=loss is _Loss.NO_FIX)


def build_estimator(
        codebook: Codebook, make: Callable[[Codebook], Estimator],
        stopwatch: Callable[[], float]) -> EstimatorBuilt:
    """Build an estimator, and return it or the reason for a failure; any thread may call this."""
    begin = stopwatch()
    try:
        estimator = make(codebook)
    # Possible causes: the codebook, the model file, a full disk or memory.
    except (ValueError, OSError, MemoryError) as error:
        return EstimatorBuilt(codebook, None, failure=str(error) or type(error).__name__)
    return EstimatorBuilt(codebook, estimator, stopwatch() - begin)
