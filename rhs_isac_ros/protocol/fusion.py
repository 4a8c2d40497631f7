"""The fusion of a site, which multiplies the likelihoods of its surfaces and tests their poses."""

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from rhs_isac_ros.bounds import site_crlb
from rhs_isac_ros.model.arrays import log_size
from rhs_isac_ros.model.geometry import seen_bounds
from rhs_isac_ros.positioning import Estimate, Mixture, Sighting
from rhs_isac_ros.positioning.agreement import PoseTest, pair_agreements
from rhs_isac_ros.positioning.alternatives import LIMIT, Outside
from rhs_isac_ros.positioning.estimate import Places
from rhs_isac_ros.positioning.fusion import Fuser
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.sheets import Sheets
from rhs_isac_ros.positioning.site import Site
from rhs_isac_ros.positioning.tracking import MixtureTracker, Motion
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.role import NewestDict, Role
from rhs_isac_ros.protocol.settings import FusionSettings, PendingSettings
from rhs_isac_ros.protocol.user_registry import MAX_USERS

# Limits of the probability that a mixture does not contain the position of the user.
_LEAST_MISSING, _MOST_MISSING = 1e-9, 0.999
# This probability, at least, for a surface whose pose may be wrong.
_SUSPECT_MISSING = 0.5
# Number of successive cycles without an answer after which a surface is silent.
_MAX_MISSED = 3
# Number of cycles that are remembered, and of those that wait for answers.
_MAX_CLOSED, _MAX_OPEN = 256, 64


# Names of fields, in the order of those of `Sheets` and `Places`.
_SHEETS = 'sheet_log_weights', 'sheet_means', 'sheet_covariances'
_PLACES = ('outside_log_weights', 'outside_means', 'outside_covariances_m2', 'outside_log_rest',
           'outside_range_m', 'region_log_volume')
_LOG_RATIOS = 'outside_log_ratio', 'blocked_log_ratio', 'misfit_log_ratio'
_MixtureT = TypeVar('_MixtureT', bound=Mixture)


def posterior_of(source: object, sighting: Sighting, **fields: float | str) -> m.Posterior:
    """Return the message about a likelihood, with the cycle, user and codebook of a source."""
    mixture, pose = sighting.mixture.normalised(), sighting.pose
    if len(mixture.means) > m.MAX_COMPONENTS:
        mixture = mixture.reduce(m.MAX_COMPONENTS)
    known: dict[str, np.ndarray | float] = {}
    if sighting.sheets is not None:
        known.update(zip(_SHEETS, _heaviest(sighting.sheets).normalised(), strict=True))
    if sighting.places is not None:
        gaussians, *rest = sighting.places
        known.update(zip(_PLACES, (*_heaviest(gaussians), *rest), strict=True))
    return m.derive(
        m.Posterior, source, log_weights=mixture.log_weights, means=mixture.means,
        covariances_m2=mixture.covariances, log_evidence=sighting.mixture.log_mass,
        missing_probability=float(np.clip(sighting.missing, _LEAST_MISSING, _MOST_MISSING)),
        surface_position_m=pose.origin, surface_quaternion=pose.unit_quaternion,
        surface_uncertainty=pose.covariance, **known,
        **{name: getattr(sighting, name) for name in _LOG_RATIOS}, **fields)


def sighting_of(message: m.Posterior) -> Sighting:
    """Return the likelihood in a message."""
    mixture = Mixture(message.log_weights, message.means, message.covariances_m2)
    sheets = Sheets(*_values(message, _SHEETS)) if len(message.sheet_log_weights) else None
    *gaussians, log_rest, range_m, log_volume = _values(message, _PLACES)
    places = Places(Mixture._make(gaussians), log_rest, range_m, log_volume) if range_m else None
    return Sighting(message.surface_pose, mixture.weighted(message.log_evidence),
                    message.missing_probability, sheets, places=places,
                    **dict(zip(_LOG_RATIOS, _values(message, _LOG_RATIOS), strict=True)))


def _heaviest(gaussians: _MixtureT) -> _MixtureT:
    """Return the Gaussians, without those of the smallest weights beyond the most of a message."""
    return select(gaussians, np.sort(np.argsort(
        -gaussians.log_weights, kind='stable')[:m.MAX_COMPONENTS]))


def _values(message: m.Posterior, names: Sequence[str]) -> list[Any]:
    return [getattr(message, name) for name in names]


@dataclasses.dataclass
class _Fix:
    """The answers of the surfaces about one user in one cycle, by the names of the surfaces."""

    due_s: float
    answers: dict[str, m.Posterior | m.NoFix]

    @property
    def posteriors(self) -> dict[str, m.Posterior]:
        """The answers with evidence about the position."""
        return {name: answer for name, answer in sorted(self.answers.items())
                if isinstance(answer, m.Posterior)}


class Fusion(Role):
    """The role that locates users from the posteriors of all surfaces of a site.

    The scenario of an answer identifies its surface. A cycle is complete when all surfaces have
    answered, or some time after the first answer. A surface that misses several cycles is silent,
    and no cycle waits for it until it answers again. Fewer answers make a position less certain.
    `stopwatch` returns a time [s], to measure latencies.
    """

    SENDS = (m.PositionEstimate, m.Posterior, m.NoFix)
    RECEIVES = (m.Posterior, m.NoFix)

    def __init__(self, site: Site, stopwatch: Callable[[], float],
                 settings: FusionSettings | None = None) -> None:
        super().__init__()
        self._bounds_m, self._stopwatch = site.bounds_m, stopwatch
        self._users = site.users
        self._surfaces, self._scenario = site.surfaces, site.surfaces[site.leader].scenario
        for one in site.surfaces.values():
            one.prepare()
        # Positions of the site are in front of the surface that leads.
        self._pose = dataclasses.replace(self._scenario.pose, uncertainty=(0.0, 0.0))
        self._names = {one.scenario.id: name for name, one in site.surfaces.items()}
        self._settings = PendingSettings(settings or FusionSettings())
        self._test: PoseTest | None = None
        self._suspects: tuple[str, ...] = ()
        # By user: the latest instance, and its track.
        self._tracks: NewestDict[int, tuple[int, MixtureTracker]] = NewestDict(MAX_USERS)
        # Number of successive cycles without an answer of each surface.
        self._missed = dict.fromkeys(site.surfaces, 0)
        # By cycle and user.
        self._open: NewestDict[tuple[int, int], _Fix] = NewestDict(_MAX_OPEN)
        # The surfaces that had answered, and the answer of the fusion, if any.
        self._closed: NewestDict[tuple[int, int], tuple[Collection[str], m.Message | None]] = (
            NewestDict(_MAX_CLOSED))

    def next_deadline(self) -> float | None:
        """Return the time at which the wait for answers ends [s], or None."""
        return min((fix.due_s for fix in self._open.values()), default=None)

    def status(self) -> Mapping[str, str]:
        """Return the settings, silent surfaces, wrong poses, and deviations of agreements.

        ``agreement.<one>.<other>`` is how far two surfaces are from agreeing, in standard
        deviations.
        """
        deviations = self._test.deviations() if self._test else {}
        return self._settings.describe() | {
            f'agreement.{one}.{other}': f'{value:.2f}'
            for (one, other), value in deviations.items()} | {
            f'warning.silent.{name}': _silent(name) for name in self._missed
            if self._is_silent(name)} | (
            {'warning.poses': _wrong_poses(self._suspects)} if self._suspects else {})

    def react(self, event: events.Event) -> None:
        """Process an event, then locate the users of the cycles that are complete or due."""
        match event:
            case events.SettingsOffered(settings):
                self._settings.latest = settings
                self.log(self._settings.apply())
            case events.AgreementsDrawn(references, places) if references:
                self._test = PoseTest(references, places)
            case m.Posterior() | m.NoFix():
                self._receive(event)
        for key in [key for key, fix in self._open.items() if self._is_ready(fix)]:
            self._close(key, self._open.pop(key))

    def _is_silent(self, name: str) -> bool:
        return self._missed[name] >= _MAX_MISSED

    def _is_ready(self, fix: _Fix) -> bool:
        return self.now_s >= fix.due_s or all(
            (name in fix.answers and not _is_followed(fix.answers[name]))
            or self._is_silent(name) for name in self._missed)

    def _receive(self, message: m.Posterior | m.NoFix) -> None:
        name, key = self._names.get(message.scenario_id), (message.cycle_id, message.user)
        if name is None:
            self.count(events.Outcome.WRONG_SCENARIO)
            return
        if self._is_silent(name):
            self.log_state(f'surface {name}', f'surface {name} answers again', False)
        self._missed[name] = 0
        fix = self._open.get(key)
        if key in self._closed:
            if not _is_followed(message):
                self._answer_again(name, *self._closed[key])
        elif fix is None:
            wait_s = self._settings.in_use.wait_s
            if any(cycle_id < message.cycle_id for cycle_id, _ in self._open):
                self.log(f'wait_s: {wait_s:g} s, expected less than step_timeout_s of the base '
                         'station, which began another cycle meanwhile', warning=True,
                         key='wait_s')
            self.count(events.Outcome.OVERFLOW, self._open.put(
                key, _Fix(self.now_s + wait_s, {name: message})))
        elif isinstance(before := fix.answers.get(name), m.Posterior) or type(before) is type(
                message):
            # A posterior that is no position comes with its reason, in any order.
            self.count(events.Outcome.DUPLICATE, not _is_followed(message))
        else:
            fix.answers[name] = message

    def _answer(self, fix: _Fix, answer: m.PositionEstimate | m.NoFix) -> None:
        self._closed[answer.cycle_id, answer.user] = frozenset(fix.answers), answer
        self.send(answer)

    def _answer_again(
            self, name: str, answered: Collection[str], answer: m.Message | None) -> None:
        """Repeat an answer, which may have been lost, if a surface repeats its own."""
        self.count(events.Outcome.DUPLICATE if name in answered else events.Outcome.STALE)
        if answer and name in answered:
            self.send(answer)

    def _close(self, key: tuple[int, int], fix: _Fix) -> None:
        self._closed.put(key, ((), None))
        for name in self._missed.keys() - fix.answers.keys():
            self._missed[name] += 1
            if self._missed[name] == _MAX_MISSED:
                self.log_state(f'surface {name}', _silent(name), True)
        if not fix.posteriors:
            self._no_fix(fix)
            return
        begin = self._stopwatch()
        sightings = {name: dataclasses.replace(
            sighting_of(one), region_m=seen_bounds(self._surfaces[name].scenario))
            for name, one in fix.posteriors.items()}
        # Anything may be published on the topic, such as a mixture inside the surface.
        fuser = Fuser(self._bounds_m, *self._users)
        try:
            fused = fuser.fuse([self._trusted(name, one) for name, one in sightings.items()])
            agreements = pair_agreements(sightings, fuser) if self._test else {}
        except ValueError as error:
            self.counters['malformed'] += 1
            self.log(f'cycle {key[0]} of user {key[1]}: {error}', warning=True, key='malformed')
            return
        if fused.reason:
            self._no_fix(fix, str(fused.reason))
        else:
            self._publish(fix, sightings, fused, self._stopwatch() - begin)
        # Surfaces that disagree about users whom each and all of them see inside have wrong poses.
        if self._test and fused.fix and all(
                one.outside_probability <= LIMIT for one in fix.posteriors.values()):
            self._test.add(agreements, fused.mean)
            self._examine(self._test.suspects())

    def _trusted(self, name: str, sighting: Sighting) -> Sighting:
        """Return a sighting with less weight if the pose of its surface may be wrong."""
        if name not in self._suspects:
            return sighting
        return dataclasses.replace(sighting, missing=max(sighting.missing, _SUSPECT_MISSING))

    def _publish(self, fix: _Fix, sightings: Mapping[str, Sighting], fused: Estimate,
                 latency_s: float) -> None:
        answers = fix.posteriors
        source = next(iter(answers.values()))
        assert fused.mixture is not None
        common: dict[str, float | str] = {
            'stamp_ns': source.stamp_ns,
            'codebook_id': '',  # of no single surface
            # From all surfaces.
            'outside_probability': float(np.nan_to_num(fused.outside_probability)),
            'blocked_probability': math.prod(
                one.blocked_probability for one in answers.values())}
        self._answer(fix, m.derive(
            m.PositionEstimate, source, position=fused.mean, covariance_m2=fused.covariance,
            crlb_m2=self._bound_m2(answers, fused.mean),
            estimator=f'fusion of {", ".join(answers)}', latency_s=latency_s, **common))
        # The agreement is relative to a different user in the region of each surface.
        averages = (one.log_evidence - log_size(seen_bounds(self._surfaces[name].scenario))
                    for name, one in answers.items())
        log_evidence = float(fused.log_agreement) + log_size(self._bounds_m) + sum(averages)
        missing = math.prod(one.missing for one in sightings.values())
        self.send(posterior_of(source, Sighting(
            self._pose, fused.mixture.weighted(log_evidence), missing), **common))
        self._track(source, fused.mixture, missing)

    def _bound_m2(self, answers: Mapping[str, m.Posterior], position: np.ndarray) -> float:
        """Return the bound of the surfaces with a position; NaN without one of their codebooks."""
        surfaces = {name: self._surfaces[name] for name in answers}
        if any(answers[name].codebook_id != one.codebook.id for name, one in surfaces.items()):
            return math.nan
        return float(site_crlb(surfaces.values(), np.clip(position, *self._bounds_m)[None])[0])

    def _track(self, source: m.Posterior, mixture: Mixture, missing: float) -> None:
        """Update the track of a user and publish it, unless the cycle is late."""
        instance, tracker = self._tracks.get(source.user, (0, None))
        if tracker is None or not m.same_instance(instance, source.user_instance):
            tracker = MixtureTracker(
                self._scenario, self._bounds_m, Motion(self._settings.in_use.track_speed_mps))
        self._tracks.put(source.user, (source.user_instance, tracker))
        estimate = tracker.update(source.time_s(self.now_s), mixture, missing)
        if estimate:
            self.act(events.PublishTrack(source.user, estimate, source.stamp_ns))

    def _no_fix(self, fix: _Fix, reason: str = '') -> None:
        source = next(iter(fix.answers.values()))
        self.count(events.Outcome.NO_FIX)
        reason = reason or '; '.join(f'{name}: {answer.reason}' for name, answer in sorted(
            fix.answers.items()) if isinstance(answer, m.NoFix))
        self._answer(fix, m.derive(m.NoFix, source, stamp_ns=source.stamp_ns, codebook_id='',
                                   reason=reason))

    def _examine(self, suspects: tuple[str, ...]) -> None:
        """Log when poses begin or cease to be suspect."""
        if suspects != self._suspects:
            self._suspects = suspects
            self.log_state(
                'poses', _wrong_poses(suspects) if suspects else 'the surfaces agree again',
                bool(suspects))


def _is_followed(answer: m.Posterior | m.NoFix) -> bool:
    """Return whether the posterior of a user outside follows an answer, or preceded it."""
    return isinstance(answer, m.NoFix) and answer.reason.startswith(Outside.reason)


def _silent(name: str) -> str:
    return f'surface {name} is silent; positions are less certain without it'


def _wrong_poses(suspects: tuple[str, ...]) -> str:
    if len(suspects) == 1:
        return f'surface {suspects[0]} disagrees with the others: its pose is wrong'
    return f'surfaces {", ".join(suspects)} disagree: a pose is wrong'
