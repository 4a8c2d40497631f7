"""The positioner."""

import dataclasses
import itertools

import numpy as np
import pytest
from in_memory_network import FIXED_PLACE as PLACE
from in_memory_network import Fixed, feed

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.model import Pose, Scenario, simulate_received
from rhs_isac_ros.positioning import BayesEstimator, Estimate, SignalError
from rhs_isac_ros.positioning.fusion import fuse
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import (
    BuildEstimator,
    CodebookOffered,
    EstimatorBuilt,
    LogMessage,
    PublishTrack,
)
from rhs_isac_ros.protocol.fusion import sighting_of
from rhs_isac_ros.protocol.positioner import Positioner, build_estimator
from rhs_isac_ros.protocol.settings import PRIORS, PositionerSettings
from rhs_isac_ros.system import System

NOTHING = np.full(3, np.nan), np.full((3, 3), np.nan)


@pytest.fixture
def positioner(scenario):
    """A positioner whose stopwatch advances by a second at each call."""
    watch = itertools.count(10.0)
    return Positioner(scenario, lambda: next(watch))


@pytest.fixture
def offer(positioner, codebooks):
    """Function that offers codebooks; return the ids of those whose estimators are requested."""
    def offer(*numbers):
        return requested(positioner, *(CodebookOffered(codebooks[number]) for number in numbers))
    return offer


@pytest.fixture
def locate(positioner, codebooks, example):
    """Function that returns the answers to the signals of cycles with one of the codebooks."""
    def locate(*cycle_ids, number=0):
        return [message for messages in feed(positioner, [
            example(m.ReceivedSignals, cycle_id=cycle_id, user=2,
                    codebook_id=codebooks[number].id)
            for cycle_id in cycle_ids]) for message in messages]
    return locate


def ready(codebook, estimate=None):
    """Return the event that an estimator is built; `estimate` takes the place of its method."""
    estimator = Fixed(f'fixed {codebook.id}')
    estimator.estimate = estimate or estimator.estimate
    return EstimatorBuilt(codebook, estimator, 1.5)


def requested(positioner, *events):
    """Return the ids of the codebooks for which estimators are requested."""
    return [action.codebook.id for event in events for action in positioner.handle(event, 0.0)
            if isinstance(action, BuildEstimator)]


@pytest.mark.parametrize('velocity', [[0.5, -1.0, 0.0], [np.nan] * 3])
def test_a_velocity_is_published_with_the_position_at_the_reference_time(
        positioner, codebooks, example, velocity):
    estimate = Estimate(PLACE, np.eye(3), velocity=np.array(velocity),
                        velocity_covariance=np.eye(3))
    requested(positioner, CodebookOffered(codebooks[0]))
    positioner.handle(ready(codebooks[0], lambda received: estimate), 0.0)
    signals = example(m.ReceivedSignals, codebook_id=codebooks[0].id, user=2, stamp_ns=7)
    found = [(action.user, action.stamp_ns, action.estimate.velocity.tolist())
             for action in positioner.handle(signals, 0.0) if isinstance(action, PublishTrack)]
    assert found == ([] if np.isnan(velocity).any() else [(2, 7, velocity)])


def test_the_codebook_of_the_signals_selects_the_estimator(
        positioner, scenario, codebooks, offer, locate):
    for number, codebook in enumerate(codebooks[:2]):
        assert offer(number) == [codebook.id]
        assert positioner.handle(ready(codebook), 0.0) == [
            LogMessage(f'fixed {codebook.id} is ready for codebook {codebook.id} after 1.5 s')]
    for number in (0, 1, 0, 1):
        codebook = codebooks[number]
        (estimate,) = locate(5, number=number)
        assert (estimate.cycle_id, estimate.user, estimate.codebook_id, estimate.estimator,
                estimate.latency_s) == (5, 2, codebook.id, f'fixed {codebook.id}', 1.0)
        assert (estimate.position == PLACE).all()
        np.testing.assert_allclose(
            estimate.covariance_m2, np.eye(3) + scenario.pose.scatter(PLACE), rtol=1e-12)
        assert estimate.crlb_m2 == pytest.approx(crlb(scenario, codebook, PLACE[None])[0])


@pytest.fixture(scope='module')
def beside(scenario):
    """A surface that hangs 1 m to the left of the frame of the site, and looks back along x."""
    pose = Pose((20.0, 1.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.02, 0.2))
    return dataclasses.replace(scenario, outside_probability=0.0, pose=pose)


@pytest.fixture(scope='module')
def located(beside, codebooks):
    """Function that locates signals of a user, with or without observers of the posterior."""
    def locate(observed, scenario=beside, codebook=codebooks[0], **settings):
        received = simulate_received(scenario, codebook, PLACE[None], np.random.default_rng(1))
        role = Positioner(
            scenario, lambda: 0.0, PositionerSettings(**settings), lambda: observed)
        feed(role, [CodebookOffered(codebook),
                    EstimatorBuilt(codebook, BayesEstimator(System(scenario, codebook)))])
        message = m.ReceivedSignals(
            cycle_id=3, user=2, user_instance=7, codebook_id=codebook.id, stamp_ns=5,
            signals=received[0].reshape(codebook.shape[:3]))
        return feed(role, [message])[0]
    return locate


@pytest.mark.parametrize('prior', PRIORS)
def test_a_posterior_is_sent_only_to_observers(located, prior):
    (estimate,) = located(False, prior=prior)
    again, posterior = located(True, prior=prior)
    assert m.same(again, estimate)
    assert isinstance(posterior, m.Posterior)
    assert (posterior.cycle_id, posterior.user, posterior.user_instance, posterior.stamp_ns,
            posterior.codebook_id) == (3, 2, 7, 5, estimate.codebook_id)


def test_observers_do_not_change_estimates_of_signals_below_the_noise(located, random_beams):
    """The estimate is an average over draws, of which the posterior consists."""
    weak = Scenario(elements_per_side=6, multipath_to_los_db=-30.0, noise_psd_dbm_hz=-95.0,
                    roi_center_m=(6, 0, 0), roi_size_m=(6, 6, 1))
    codebook = random_beams(weak, np.random.default_rng(0))
    (estimate,) = located(False, weak, codebook)
    again, posterior = located(True, weak, codebook)
    assert m.same(again, estimate)
    np.testing.assert_allclose(
        sighting_of(posterior).mixture.moments()[0], estimate.position, atol=1e-6)


def test_a_posterior_contains_all_that_the_fusion_needs(located, beside):
    """The fusion of a single surface is the posterior of this surface."""
    estimate, posterior = located(True)
    m.check(posterior, beside)
    assert np.exp(posterior.log_weights).sum() == pytest.approx(1)
    assert posterior.surface_pose.origin.tolist() == list(beside.pose.position_m)
    assert np.allclose(posterior.surface_pose.covariance, beside.pose.covariance)
    corners = beside.pose.to_site(beside.roi_bounds_m)
    fused = fuse([sighting_of(posterior)], np.sort(corners, axis=0))
    mean, covariance = fused.mixture.moments()
    deviation_m = np.sqrt(np.trace(covariance))
    assert np.linalg.norm(mean - estimate.position) < 0.1 * deviation_m
    assert deviation_m == pytest.approx(np.sqrt(np.trace(estimate.covariance_m2)), rel=0.1)


def test_duplicate_signals_are_answered_twice_and_estimated_once(
        positioner, codebooks, offer, locate):
    # An estimator without modes has no posterior.
    positioner._is_observed = lambda: True
    offer(0)
    positioner.handle(ready(codebooks[0]), 0.0)
    first, again, other = locate(5, 5, 6)
    assert again is first
    assert other.cycle_id == 6
    assert positioner.counters == {'duplicate': 1}


def test_the_old_estimator_is_used_while_the_new_one_is_built(
        positioner, codebooks, offer, locate):
    assert locate(1) == []
    offer(0)
    # The latest of waiting signals are used.
    assert locate(2, 3) == []
    ((waited,),) = feed(positioner, [ready(codebooks[0])])
    offer(1)
    (old,) = locate(4)
    assert locate(5, number=1) == []
    (old_again,) = locate(6)
    ((new,),) = feed(positioner, [ready(codebooks[1])])
    assert [e.cycle_id for e in (waited, old, old_again, new)] == [3, 4, 6, 5]
    assert new.codebook_id == codebooks[1].id
    assert locate(7, number=2) == []
    assert positioner.counters == {'wrong_codebook': 2}


def test_estimators_are_built_one_at_a_time_the_latest_next(
        positioner, codebooks, offer, locate):
    first, _, third = codebooks
    assert offer(0, 0, 1, 2) == [first.id]
    assert locate(7, number=2) == []
    assert requested(positioner, ready(first)) == [third.id]
    ((estimate,),) = feed(positioner, [ready(third)])
    assert (estimate.cycle_id, estimate.codebook_id) == (7, third.id)
    assert locate(8, number=1) == []
    assert positioner.counters == {'wrong_codebook': 1}
    assert offer(0, 2) == []


def test_no_estimator_is_built_for_a_codebook_replaced_meanwhile(positioner, codebooks, offer):
    offer(0, 1, 0)
    assert requested(positioner, ready(codebooks[0])) == []


def test_the_old_estimator_is_kept_if_the_new_one_cannot_be_built(
        positioner, codebooks, offer, locate):
    offer(0)
    positioner.handle(ready(codebooks[0]), 0.0)
    offer(1)
    locate(4, number=1)
    assert positioner.handle(EstimatorBuilt(codebooks[1], None, failure='no model'), 0.0) == [
        LogMessage(f'no estimator for codebook {codebooks[1].id}: no model', warning=True)]
    assert len(locate(5)) == 1
    assert locate(6, number=1) == []
    assert positioner.counters == {'wrong_codebook': 2}
    # The codebook may be offered again.
    assert offer(1) == [codebooks[1].id]


def raises(received):
    raise SignalError('received: all wrong')


@pytest.mark.parametrize(('estimate', 'reason'), [
    (raises, 'received: all wrong'),
    (lambda received: Estimate(*NOTHING, 'received: all wrong'), 'received: all wrong'),
    # A plug-in may return any position.
    (lambda received: Estimate(PLACE * [-1, 1, 1], np.eye(3)),
     'position: x = -8 m, expected x > 0'),
    # And anything else.
    (lambda received: None,
     'Fixed.estimate: None, expected an Estimate with means [3]'),
    (lambda received: Estimate(PLACE[None], np.eye(3)[None]),
     'Fixed.estimate: <1 estimates, 1 with a position>, expected an Estimate with means [3]'),
    (lambda received: Estimate(PLACE[:2], np.eye(3)),
     'Fixed.estimate: mean: shape (2,), expected [3] or [N, 3]')])
def test_without_a_fix_the_positioner_reports_the_reason(
        positioner, codebooks, example, offer, estimate, reason):
    offer(0)
    positioner.handle(ready(codebooks[0], estimate), 0.0)
    signals = example(m.ReceivedSignals, cycle_id=9, user=2, codebook_id=codebooks[0].id)
    send, note = positioner.handle(signals, 0.0)
    assert isinstance(send.message, m.NoFix)
    assert (send.message.cycle_id, send.message.user, send.message.codebook_id) == (
        9, 2, codebooks[0].id)
    assert send.message.reason.startswith(reason)
    assert note == LogMessage(
        f'cycle 9: no fix of user 2: {send.message.reason}', warning=True,
        key='signals of user 2', holds=True)
    assert positioner.counters == {'no_fix': 1}
    # The answer may be lost, but not the line of the log.
    assert positioner.handle(signals, 0.0) == [send]


def test_a_plug_in_that_fails_is_the_reason_and_its_traceback_is_logged(
        positioner, codebooks, example, offer):
    def estimate(received):
        return {}['gain']
    offer(0)
    positioner.handle(ready(codebooks[0], estimate), 0.0)
    signals = example(m.ReceivedSignals, cycle_id=9, user=2, codebook_id=codebooks[0].id)
    traced, send, _ = positioner.handle(signals, 0.0)
    assert send.message.reason == "Fixed.estimate: KeyError: 'gain'"
    assert traced.text.startswith(f'plug-in: {send.message.reason}\nTraceback ')
    assert "return {}['gain']" in traced.text and traced.warning
    assert positioner.counters == {'no_fix': 1, 'plugin_fault': 1}


def test_an_estimator_without_a_usable_system_is_built_nevertheless(
        positioner, codebooks, example, offer):
    offer(0)
    event = ready(codebooks[0])
    event.estimator.system = 'the one in the lab'
    positioner.handle(event, 0.0)
    signals = example(m.ReceivedSignals, cycle_id=9, user=2, codebook_id=codebooks[0].id)
    assert isinstance(positioner.handle(signals, 0.0)[0].message, m.PositionEstimate)


@pytest.mark.parametrize('error', [ValueError('bad model'), OSError('disk full'), MemoryError()])
def test_an_error_while_an_estimator_is_built_is_an_event(codebooks, error):
    def make(codebook):
        raise error
    event = build_estimator(codebooks[0], make, lambda: 0.0)
    assert (event.codebook, event.estimator) == (codebooks[0], None)
    assert event.failure == (str(error) or 'MemoryError')


def test_a_built_estimator_is_returned_with_its_duration(codebooks):
    watch = iter([3.0, 5.5])
    event = build_estimator(
        codebooks[0], lambda codebook: Fixed(codebook.id), lambda: next(watch))
    assert (event.codebook, event.elapsed_s) == (codebooks[0], 2.5)
    assert event.estimator.name == codebooks[0].id
