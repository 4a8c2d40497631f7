"""The fusion of the posteriors of several surfaces."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.bounds import site_crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.positioning import Mixture, Sighting, Site, SiteEstimator, fuse
from rhs_isac_ros.positioning.agreement import WINDOW
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import (
    AgreementsDrawn,
    LogMessage,
    PublishTrack,
    SettingsOffered,
    Timeout,
)
from rhs_isac_ros.protocol.fusion import Fusion, posterior_of, sighting_of
from rhs_isac_ros.protocol.settings import FusionSettings
from rhs_isac_ros.system import System

CONFIG = Path(__file__).parents[2] / 'config'
POSES = {'front': Pose(), 'side': Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0))}
PLACE = np.array([9.0, 1.0, 0.3])
WAIT_S = 0.2


@pytest.fixture(scope='module')
def site(scenario, codebooks):
    return Site({name: System(dataclasses.replace(scenario, pose=pose), codebooks[0])
                 for name, pose in POSES.items()}, scenario.roi_bounds_m)


@pytest.fixture
def fusion(site):
    """A fusion whose stopwatch advances by a second at each call."""
    watch = itertools.count()
    return Fusion(site, lambda: next(watch), FusionSettings(wait_s=WAIT_S))


@pytest.fixture(scope='module')
def answer(site):
    """Function that returns the posterior of a surface, 0.1 m thick and 2 m wide at a place."""
    def make(name, cycle_id=1, place=PLACE, user=2, outside_log_ratio=-5.0, **fields):
        pose = POSES[name]
        covariance = pose.covariances_to_site(np.diag([0.01, 4.0, 0.04])[None])
        sighting = Sighting(pose, Mixture(np.array([-3.0]), place[None], covariance),
                            outside_log_ratio=outside_log_ratio)
        source = m.ReceivedSignals(
            cycle_id=cycle_id, user=user, user_instance=7,
            codebook_id=site.surfaces[name].codebook.id, signals=None)
        return posterior_of(source, sighting, **{
            'scenario_id': site.surfaces[name].scenario.id, 'stamp_ns': 9} | fields)
    return make


@pytest.fixture
def no_fix(site):
    def make(name, cycle_id=1):
        return m.NoFix(cycle_id=cycle_id, user=2, codebook_id='x', reason='too weak',
                       scenario_id=site.surfaces[name].scenario.id)
    return make


def texts(actions):
    return [action.text for action in actions if isinstance(action, LogMessage)]


def sent(actions):
    return [action.message for action in actions if hasattr(action, 'message')]


def at_once(fusion, events):
    """Return the messages that the fusion sends, one list for each event."""
    return [sent(fusion.handle(event, 0.0)) for event in events]


def test_a_message_holds_what_the_fusion_needs(answer):
    sighting = sighting_of(dataclasses.replace(answer('side'), missing_probability=0.25))
    assert sighting.missing == 0.25
    assert np.allclose(sighting.pose.rotation, POSES['side'].rotation)
    assert np.allclose(sighting.pose.covariance, POSES['side'].covariance)
    assert sighting.mixture.log_mass == pytest.approx(-3.0)
    assert np.array_equal(sighting.mixture.means, PLACE[None])


@pytest.fixture(scope='module')
def small_site():
    """A site in which users outside are often near a position inside."""
    scenario = Scenario.from_yaml(CONFIG / 'quick.yaml')
    codebook = Codebook.load(CONFIG / 'codebook_quick.yaml')
    site = Site({name: System(dataclasses.replace(scenario, pose=pose), codebook)
                 for name, pose in POSES.items()}, scenario.roi_bounds_m)
    return site, SiteEstimator(site)


@pytest.mark.parametrize(('place', 'seed', 'fix'), [
    ((4.0, -2.4, -1.0), 1, False), ((13.1, -6.3, 0.8), 13, False), ((7.6, 3.3, -1.0), 1116, True)])
def test_messages_decide_as_the_library_whether_surfaces_see_a_user_outside_at_one_place(
        small_site, place, seed, fix):
    site, estimator = small_site
    received = {name: shots[0] for name, shots in site.sample(
        np.array([place]), np.random.default_rng(seed)).items()}
    sightings = estimator.sightings(received)
    expected = estimator.estimate(received)
    assert expected.fix == fix
    # Only the places decide.
    assert fuse([dataclasses.replace(one, places=None) for one in sightings.values()],
                site.bounds_m, *site.users).fix != fix
    source = m.Grant(cycle_id=1, user=2)
    answers = [posterior_of(source, one, codebook_id='x',
                            scenario_id=site.surfaces[name].scenario.id)
               for name, one in sightings.items()]
    for name, one in zip(sightings, answers, strict=True):
        m.check(one, site.surfaces[name].scenario)
    _, (found, *_) = at_once(Fusion(site, lambda: 0.0), answers)
    if not fix:
        assert found.reason == expected.reason
        return
    assert found.outside_probability == pytest.approx(expected.outside_probability, rel=1e-9)
    np.testing.assert_allclose(found.position, expected.mean, rtol=1e-9)
    np.testing.assert_allclose(found.covariance_m2, expected.covariance, rtol=1e-9)


def test_a_message_holds_the_places_of_a_user_outside_unless_they_are_unknown(
        answer, small_site):
    assert sighting_of(answer('side')).places is None
    site, estimator = small_site
    sighting = estimator.sightings({name: shots[0] for name, shots in site.sample(
        PLACE[None], np.random.default_rng(0)).items()})['side']
    found = sighting_of(posterior_of(
        m.Grant(cycle_id=1, user=2), sighting, codebook_id='x')).places
    assert found[1:] == sighting.places[1:]
    assert len(found.gaussians.means) > 1
    for one, other in zip(found.gaussians, sighting.places.gaussians, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_cycle_with_all_surfaces_is_fused_at_once(fusion, site, answer):
    first, (estimate, posterior) = at_once(fusion, [answer('side'), answer('front')])
    assert first == []
    expected = fuse([sighting_of(answer(name)) for name in ('front', 'side')], site.bounds_m)
    assert np.array_equal(estimate.position, expected.mean)
    assert np.array_equal(estimate.covariance_m2, expected.covariance)
    assert (estimate.cycle_id, estimate.user, estimate.user_instance, estimate.stamp_ns,
            estimate.estimator, estimate.latency_s) == (1, 2, 7, 9, 'fusion of front, side', 1)
    assert 0 < estimate.outside_probability < 1e-3
    assert np.linalg.norm(expected.mean - PLACE) < 0.1
    for message in (estimate, posterior):
        m.check(message, site.surfaces['front'].scenario)


@pytest.mark.parametrize('order', [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
@pytest.mark.parametrize(('log_ratio', 'kind'), [(3.0, m.PositionEstimate), (30.0, m.NoFix)])
def test_all_surfaces_decide_whether_a_user_is_outside(
        fusion, answer, no_fix, order, log_ratio, kind):
    # The front surface finds the user outside, and sends its reason and its posterior.
    reason = dataclasses.replace(
        no_fix('front'), reason='position outside of the region: probability 0.95')
    events = [reason, answer('front', outside_log_ratio=log_ratio), answer('side')]
    found = [message for messages in at_once(fusion, [events[number] for number in order])
             for message in messages if not isinstance(message, m.Posterior)]
    assert [type(message) for message in found] == [kind]
    if kind is m.NoFix:
        assert found[0].reason.startswith('position outside of the region: probability 1')


def test_a_reason_without_its_posterior_is_an_answer_when_the_cycle_is_due(
        fusion, answer, no_fix):
    at_once(fusion, [answer('side'), dataclasses.replace(
        no_fix('front'), reason='position outside of the region')])
    (estimate, _) = sent(fusion.handle(Timeout(), WAIT_S))
    assert estimate.estimator == 'fusion of side'


def test_the_bound_is_that_of_the_surfaces_with_a_position(fusion, site, answer, no_fix):
    *_, (both, _), _, (alone, _) = at_once(fusion, [
        answer('side'), answer('front'), no_fix('front', 2), answer('side', 2)])
    for estimate, names in ((both, ('front', 'side')), (alone, ('side',))):
        expected = site_crlb([site.surfaces[name] for name in names], estimate.position[None])
        assert estimate.crlb_m2 == pytest.approx(expected[0])
    assert both.crlb_m2 < 0.7 * alone.crlb_m2
    # The site has no other codebooks.
    *_, (estimate, _) = at_once(
        fusion, [answer('front', 3), answer('side', 3, codebook_id='other')])
    assert np.isnan(estimate.crlb_m2)


def tracks(fusion, events):
    """Return the tracks that the fusion publishes."""
    return [action for event in events for action in fusion.handle(event, 0.0)
            if isinstance(action, PublishTrack)]


def test_successive_cycles_are_a_track(fusion, answer):
    cycles = [answer(name, cycle_id=k, stamp_ns=int(3e8 * k))
              for k in range(1, 9) for name in POSES]
    found = tracks(fusion, cycles)
    assert [(one.user, one.stamp_ns, one.estimate.n_phases) for one in found] == [
        (2, 3e8 * k, k) for k in range(1, 9)]
    first, last = found[0].estimate, found[-1].estimate
    assert np.linalg.norm(last.mean - PLACE) < 0.1
    assert np.trace(last.covariance) < 0.7 * np.trace(first.covariance)
    assert np.trace(last.velocity_covariance) < 0.5 * np.trace(first.velocity_covariance)


def test_another_user_another_instance_and_a_late_cycle_do_not_continue_a_track(fusion, answer):
    def cycle(cycle_id, seconds, **fields):
        return tracks(fusion, [answer(name, cycle_id, stamp_ns=int(1e9 * seconds), **fields)
                               for name in POSES])
    (first,), (other,) = cycle(1, 5.0), cycle(2, 5.1, user=3)
    assert (first.estimate.n_phases, other.estimate.n_phases, other.user) == (1, 1, 3)
    assert cycle(3, 4.0) == []
    (second,) = cycle(4, 5.3)
    assert second.estimate.n_phases == 2
    (restarted,) = cycle(5, 5.6, user_instance=8)
    assert restarted.estimate.n_phases == 1


def test_the_posterior_of_the_site_is_a_likelihood_as_those_of_the_surfaces(
        fusion, site, answer):
    *_, (estimate, posterior) = at_once(fusion, [answer('side'), answer('front')])
    mixture = sighting_of(posterior).mixture
    assert np.array_equal(mixture.normalised().moments()[0], estimate.position)
    assert not posterior.surface_uncertainty.any()
    assert posterior.missing_probability == pytest.approx(1e-6)
    # The product of the two Gaussians, apart from the uncertainty of the poses.
    one, other = (sighting_of(answer(name)).mixture.widened(
        POSES[name].spread(PLACE[None])) for name in POSES)
    assert posterior.log_evidence == pytest.approx(one.product(other).log_mass, abs=0.1)


def test_a_surface_that_is_late_is_not_waited_for_and_makes_the_result_broader(fusion, answer):
    *_, (both, _) = at_once(fusion, [answer('front'), answer('side')])
    assert sent(fusion.handle(answer('front', 2), 10.0)) == []
    assert fusion.next_deadline() == pytest.approx(10.0 + WAIT_S)
    estimate, _ = sent(fusion.handle(Timeout(), fusion.next_deadline()))
    assert estimate.estimator == 'fusion of front'
    assert estimate.cycle_id == 2
    assert np.trace(estimate.covariance_m2) > 10 * np.trace(both.covariance_m2)
    assert sent(fusion.handle(answer('side', 2), 10.5)) == []
    assert fusion.counters == {'stale': 1}
    assert fusion.next_deadline() is None


def test_a_silent_surface_is_named_and_costs_no_time(fusion, answer):
    logged = []
    for cycle in range(1, 4):
        fusion.handle(answer('front', cycle), float(cycle))
        logged += texts(fusion.handle(Timeout(), cycle + WAIT_S))
    assert logged == ['surface side is silent; positions are less certain without it']
    assert fusion.status()['warning.silent.side'] == logged[0]
    estimate, _ = sent(fusion.handle(answer('front', 4), 4.0))
    assert estimate.estimator == 'fusion of front'
    assert texts(fusion.handle(answer('side', 4), 4.1)) == ['surface side answers again']
    assert 'warning.silent.side' not in fusion.status()
    assert sent(fusion.handle(answer('front', 5), 5.0)) == []
    estimate, _ = sent(fusion.handle(answer('side', 5), 5.0))
    assert estimate.estimator == 'fusion of front, side'


def test_cycles_of_several_users_do_not_mix(fusion, answer):
    other = PLACE + [3.0, 0.0, 0.0]
    *nothing, (first, _), (second, _) = at_once(fusion, [
        answer('front', user=1), answer('side', 1, other, user=2), answer('side', user=1),
        answer('front', 1, other, user=2)])
    assert nothing == [[], []]
    assert (first.user, second.user) == (1, 2)
    assert np.linalg.norm(first.position - PLACE) < 0.1
    assert np.linalg.norm(second.position - other) < 0.1


def test_an_answer_counts_once_and_a_repeated_one_gets_the_same_position(
        fusion, answer, no_fix):
    *before, (estimate, posterior) = at_once(fusion, [
        answer('front'), answer('front'), answer('side', scenario_id='other'),
        answer('side', scenario_id=''), answer('side')])
    assert before == [[]] * 4
    assert fusion.counters == {'duplicate': 1, 'wrong_scenario': 2}
    fusion.handle(answer('front', 2), 0.0)
    (late, _) = sent(fusion.handle(Timeout(), WAIT_S))
    *_, (nothing,) = at_once(fusion, [no_fix('side', 3), no_fix('front', 3)])
    assert (nothing.cycle_id, nothing.user) == (3, 2)
    assert nothing.reason == 'front: too weak; side: too weak'
    assert at_once(fusion, [answer('front'), answer('front', 2), no_fix('side', 3),
                            answer('side', 2)]) == [[estimate], [late], [nothing], []]
    assert fusion.counters == {'duplicate': 4, 'wrong_scenario': 2, 'stale': 1, 'no_fix': 1}
    # A position of the site names no codebook of a single surface.
    assert {one.codebook_id for one in (estimate, posterior, nothing)} == {''}
    # A surface without a position is not waited for.
    _, (alone, _) = at_once(fusion, [no_fix('side', 4), answer('front', 4)])
    assert alone.estimator == 'fusion of front'


def test_a_mixture_that_cannot_be_located_is_dropped_and_logged(fusion, answer):
    # `check` drops such a message from a node: in the surface, there is no direction.
    fusion.handle(answer('front', place=np.zeros(3)), 0.0)
    with np.errstate(all='ignore'):
        (action,) = fusion.handle(answer('side'), 0.0)
    assert action.text.startswith('cycle 1 of user 2: ')
    assert action.warning
    assert fusion.counters == {'malformed': 1}


def test_a_wait_beyond_the_next_cycle_is_logged(fusion, answer):
    fusion.handle(answer('front'), 0.0)
    assert texts(fusion.handle(answer('front', 2), WAIT_S / 2)) == [
        'wait_s: 0.2 s, expected less than step_timeout_s of the base station, which began '
        'another cycle meanwhile']
    fusion.handle(Timeout(), 2 * WAIT_S)
    assert texts(fusion.handle(answer('front', 3), 1.0)) == []


def test_a_new_time_to_wait_applies_to_the_next_cycle(fusion, answer):
    actions = fusion.handle(SettingsOffered(FusionSettings(wait_s=1.0)), 0.0)
    assert texts(actions) == ["settings applied: wait_s '1.0'"]
    fusion.handle(answer('front'), 5.0)
    assert fusion.next_deadline() == 6.0


@pytest.fixture(scope='module')
def agreements(site, answer):
    """Agreements of surfaces whose modes are off by their standard deviations."""
    rng = np.random.default_rng(0)
    names = ('front', 'side')
    return AgreementsDrawn([
        {names: fuse([sighting_of(answer(name, place=off(rng, name))) for name in names],
                     site.bounds_m).log_agreement} for _ in range(100)], np.tile(PLACE, (100, 1)))


def off(rng, name, shift_m=0.0):
    """Draw the mode of a surface, whose range has a standard deviation of 0.1 m."""
    return PLACE + POSES[name].vectors_to_site(
        np.array([shift_m, 0.0, 0.0]) + 0.1 * rng.normal(size=3) * [1, 0, 0])


def run(fusion, answer, shift_m, first, n=WINDOW):
    """Return the texts logged in `n` cycles in which the side surface is off by a range."""
    rng, logged = np.random.default_rng(first), []
    for cycle in range(first, first + n):
        fusion.handle(answer('front', cycle, off(rng, 'front')), float(cycle))
        logged += texts(fusion.handle(
            answer('side', cycle, off(rng, 'side', shift_m)), float(cycle)))
    return logged


def test_a_wrong_pose_is_named_and_counts_less_until_it_is_right_again(
        fusion, answer, agreements):
    fusion.handle(agreements, 0.0)
    assert run(fusion, answer, 0.0, 1) == []
    assert abs(float(fusion.status()['agreement.front.side'])) < 3
    assert 'warning.poses' not in fusion.status()
    fusion.handle(answer('front', 90), 90.0)
    before, _ = sent(fusion.handle(answer('side', 90), 90.0))
    assert run(fusion, answer, 3.0, 100) == ['surfaces front, side disagree: a pose is wrong']
    assert fusion.status()['warning.poses'] == 'surfaces front, side disagree: a pose is wrong'
    fusion.handle(answer('front', 190), 190.0)
    suspect, _ = sent(fusion.handle(answer('side', 190), 190.0))
    assert np.trace(suspect.covariance_m2) > np.trace(before.covariance_m2)
    assert run(fusion, answer, 0.0, 200, 2 * WINDOW) == ['the surfaces agree again']
    assert 'warning.poses' not in fusion.status()


def test_users_whom_all_surfaces_together_see_outside_are_no_evidence_of_a_wrong_pose(
        fusion, answer, agreements):
    fusion.handle(agreements, 0.0)
    # The side surface sees them 2 m beyond the region.
    assert run(fusion, answer, 6.0, 1) == []
    assert fusion.counters['no_fix'] > 0.9 * WINDOW
