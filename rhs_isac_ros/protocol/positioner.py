"""The positioner, which estimates positions from received signals."""

import collections
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from rhs_isac_ros.bounds import crlb_of
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.positioning import (
    Estimate,
    Estimator,
    SignalError,
    TrackEstimate,
    surface_of,
)
from rhs_isac_ros.positioning.innovation_test import InnovationTest
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import (
    Action,
    BuildEstimator,
    CodebookOffered,
    EstimatorFailed,
    EstimatorReady,
    Event,
    LogMessage,
    PublishTrack,
    RevertSettings,
    Send,
    SettingsOffered,
)
from rhs_isac_ros.protocol.newest import CodebookCache
from rhs_isac_ros.protocol.outage_log import MAX_NAMED
from rhs_isac_ros.protocol.outcomes import Outcome
from rhs_isac_ros.protocol.role import PendingSettings, PlainRole
from rhs_isac_ros.protocol.settings import TRACK, PositionerSettings
from rhs_isac_ros.protocol.tracks import Tracks
from rhs_isac_ros.protocol.user_scheduler import MAX_USERS

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

    def add(self, user: int, codebook_id: str, estimate: Estimate) -> list[LogMessage]:
        """Add the residual of an estimate; return a message if a warning begins or ends."""
        if codebook_id != self._codebook_id:
            self.clear()
            self._codebook_id = codebook_id
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
        """Forget all residuals, because the estimator or the codebook has changed."""
        self._all.clear()
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
            warning. Empty before the first residual.
        """
        if not self._all.n_fixes:
            return {}
        values = {'residual.ratio': f'{self._all.ratio:.3f}',
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
        # Users whose last signals yielded no position; only the first of consecutive failures is
        # logged. Bounded, because signals may name any user.
        self._without_fix: collections.OrderedDict[int, None] = collections.OrderedDict()
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
        actions: list[Action] = [Send(m.PositionEstimate(
            cycle_id=received.cycle_id, user=received.user,
            user_instance=received.user_instance, codebook_id=received.codebook_id,
            position=np.array(estimate.mean), covariance_m2=np.array(estimate.covariance),
            crlb_m2=bound, estimator=estimator.name, latency_s=latency_s,
            outside_probability=float(np.nan_to_num(estimate.outside_probability))))]
        if isinstance(estimate, TrackEstimate):
            actions.append(PublishTrack(received.user, estimate))
        if received.user in self._without_fix:
            del self._without_fix[received.user]
            actions.append(LogMessage(
                f'cycle {received.cycle_id}: user {received.user} has a position again'))
        return actions

    def _estimate(
            self, received: m.ReceivedSignals, estimator: Estimator, settings: PositionerSettings,
            now_s: float) -> Estimate:
        if settings.prior == TRACK:
            return self._tracks.locate(received, estimator, settings.track_speed_mps, now_s)
        self._tracks.clear()
        return estimator.estimate(received.signals.reshape(len(received.signals), -1))

    def _no_fix(self, received: m.ReceivedSignals, reason: str) -> list[Action]:
        self.count(Outcome.NO_FIX)
        sent = Send(m.NoFix(
            cycle_id=received.cycle_id, user=received.user, codebook_id=received.codebook_id,
            reason=reason))
        is_known = received.user in self._without_fix
        self._without_fix[received.user] = None
        self._without_fix.move_to_end(received.user)
        if is_known:
            return [sent]
        if len(self._without_fix) > MAX_USERS:
            self._without_fix.popitem(last=False)
        text = f'cycle {received.cycle_id}: no fix of user {received.user}: {reason}'
        return [sent, LogMessage(text, warning=True)]


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
