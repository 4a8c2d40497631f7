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
)
from rhs_isac_ros.protocol.fusion import sighting_of
from rhs_isac_ros.protocol.positioner import Positioner, build_estimator
from rhs_isac_ros.protocol.settings import PRIORS, PositionerSettings


@pytest.fixture
def positioner(scenario):
    """A positioner whose stopwatch advances by a second at each call."""
    watch = itertools.count(10.0)
    return Positioner(scenario, lambda: next(watch))


@pytest.fixture
def signals(codebooks, example):
    """Function that returns received signals of a cycle with one of the codebooks."""
    def make(cycle_id, number=0):
        return example(m.ReceivedSignals, cycle_id=cycle_id, user=2,
                       codebook_id=codebooks[number].id)
    return make


def ready(codebook, estimator=None):
    return EstimatorBuilt(codebook, estimator or Fixed(codebook), 1.5)


def requested(actions):
    """Return the ids of the codebooks for which estimators are requested."""
    return [action.codebook.id for action in actions if isinstance(action, BuildEstimator)]


def test_the_codebook_of_the_signals_selects_the_estimator(
        positioner, scenario, codebooks, signals):
    for codebook in codebooks[:2]:
        assert requested(positioner.handle(CodebookOffered(codebook), 0.0)) == [codebook.id]
        assert positioner.handle(ready(codebook), 0.0) == [
            LogMessage(f'fixed {codebook.id} is ready for codebook {codebook.id} after 1.5 s')]
    for number in (0, 1, 0, 1):
        codebook = codebooks[number]
        ((estimate,),) = feed(positioner, [signals(5, number)])
        assert (estimate.cycle_id, estimate.user) == (5, 2)
        assert estimate.codebook_id == codebook.id
        assert estimate.estimator == f'fixed {codebook.id}'
        assert (estimate.position == PLACE).all()
        assert (estimate.covariance_m2 == 4 * np.eye(3)).all()
        assert estimate.crlb_m2 == pytest.approx(crlb(scenario, codebook, PLACE[None])[0])
        assert estimate.latency_s == 1.0


class Observers:
    """Whether anyone receives posteriors."""

    present = False

    def __call__(self):
        return self.present


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
        observers = Observers()
        role = Positioner(scenario, lambda: 0.0, PositionerSettings(**settings), observers)
        feed(role, [CodebookOffered(codebook),
                    ready(codebook, BayesEstimator(scenario, codebook))])
        observers.present = observed
        message = m.ReceivedSignals(
            cycle_id=3, user=2, user_instance=7, codebook_id=codebook.id, stamp_ns=5,
            signals=received[0].reshape(codebook.shape[:3]))
        return feed(role, [message])[0]
    return locate


@pytest.mark.parametrize('prior', PRIORS)
def test_a_posterior_is_sent_only_to_observers(located, prior):
    (estimate,) = located(False, prior=prior)
    again, posterior = located(True, prior=prior)
    assert m.same(dataclasses.replace(again, latency_s=estimate.latency_s), estimate)
    assert isinstance(posterior, m.Posterior)
    assert (posterior.cycle_id, posterior.user, posterior.user_instance, posterior.stamp_ns,
            posterior.codebook_id) == (3, 2, 7, 5, estimate.codebook_id)


def test_observers_do_not_change_estimates_of_signals_below_the_noise(located, random_beams):
    """The estimate is an average over draws, but the posterior consists of modes."""
    weak = Scenario(elements_per_side=6, multipath_to_los_db=-30.0, noise_psd_dbm_hz=-95.0,
                    roi_center_m=(6, 0, 0), roi_size_m=(6, 6, 1))
    codebook = random_beams(weak, np.random.default_rng(0))
    (estimate,) = located(False, weak, codebook)
    again, posterior = located(True, weak, codebook)
    assert m.same(again, estimate)
    assert np.linalg.norm(
        sighting_of(posterior).mixture.moments()[0] - estimate.position) > 1e-3


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


def test_an_estimator_without_modes_has_no_posterior(positioner, codebooks, signals):
    positioner._is_observed = lambda: True
    feed(positioner, [CodebookOffered(codebooks[0]), ready(codebooks[0])])
    (sent,) = feed(positioner, [signals(5)])
    assert [type(message) for message in sent] == [m.PositionEstimate]


def test_duplicate_signals_are_answered_twice_and_estimated_once(
        positioner, codebooks, signals):
    feed(positioner, [CodebookOffered(codebooks[0]), ready(codebooks[0])])
    (first,), (again,), (other,) = feed(positioner, [signals(5), signals(5), signals(6)])
    assert again is first
    assert other.cycle_id == 6
    assert positioner.counters == {'duplicate': 1}


def test_the_positioner_drops_signals_of_an_unknown_codebook(
        positioner, codebooks, signals):
    assert feed(positioner, [signals(1)]) == [[]]
    feed(positioner, [CodebookOffered(codebooks[1]), ready(codebooks[1])])
    assert feed(positioner, [signals(1)]) == [[]]
    assert positioner.counters == {'wrong_codebook': 2}


def test_the_positioner_requests_one_estimator_for_a_codebook(positioner, codebooks):
    offers = [positioner.handle(CodebookOffered(codebooks[0]), 0.0) for _ in range(3)]
    assert list(map(requested, offers)) == [[codebooks[0].id], [], []]
    positioner.handle(ready(codebooks[0]), 0.0)
    assert positioner.handle(CodebookOffered(codebooks[0]), 0.0) == []


def test_the_old_estimator_is_used_while_the_new_one_is_built(
        positioner, codebooks, signals):
    feed(positioner, [CodebookOffered(codebooks[0]), ready(codebooks[0]),
                      CodebookOffered(codebooks[1])])
    (old,), nothing, (old_again,), (new,) = feed(
        positioner, [signals(1), signals(2, 1), signals(3), ready(codebooks[1])])
    assert nothing == []
    assert [e.cycle_id for e in (old, old_again, new)] == [1, 3, 2]
    assert new.codebook_id == codebooks[1].id
    assert positioner.counters == {}


def test_the_latest_of_waiting_signals_are_used(positioner, codebooks, signals):
    *before, (estimate,), after = feed(
        positioner, [CodebookOffered(codebooks[0]), signals(1), signals(2), ready(codebooks[0]),
                     CodebookOffered(codebooks[0])])
    assert before == [[], [], []]
    assert estimate.cycle_id == 2
    assert after == []


def test_estimators_are_built_one_at_a_time_the_latest_next(
        positioner, codebooks, signals):
    first, second, third = codebooks
    offers = [requested(positioner.handle(CodebookOffered(codebook), 0.0))
              for codebook in codebooks]
    assert offers == [[first.id], [], []]
    positioner.handle(signals(7, 2), 0.0)
    assert requested(positioner.handle(ready(first), 0.0)) == [third.id]
    ((estimate,),) = feed(positioner, [ready(third)])
    assert (estimate.cycle_id, estimate.codebook_id) == (7, third.id)
    assert feed(positioner, [signals(8, 1)]) == [[]]
    assert positioner.counters == {'wrong_codebook': 1}


def test_no_estimator_is_built_for_a_codebook_replaced_meanwhile(positioner, codebooks):
    first, second, _ = codebooks
    feed(positioner, [CodebookOffered(c) for c in (first, second, first)])
    assert requested(positioner.handle(ready(first), 0.0)) == []


def test_the_old_estimator_is_kept_if_the_new_one_cannot_be_built(positioner, codebooks, signals):
    feed(positioner, [CodebookOffered(codebooks[0]), ready(codebooks[0]),
                      CodebookOffered(codebooks[1]), signals(4, 1)])
    assert positioner.handle(EstimatorBuilt(codebooks[1], None, failure='no model'), 0.0) == [
        LogMessage(f'no estimator for codebook {codebooks[1].id}: no model', warning=True)]
    assert [len(sent) for sent in feed(positioner, [signals(5), signals(6, 1)])] == [1, 0]
    assert positioner.counters == {'wrong_codebook': 2}
    # The codebook may be offered again.
    assert requested(positioner.handle(CodebookOffered(codebooks[1]), 0.0)) == [codebooks[1].id]


class WithoutFix(Fixed):
    """An estimator that returns no fix, or raises an error."""

    def __init__(self, codebook, error=False):
        super().__init__(codebook)
        self._error = error

    def estimate(self, received):
        if self._error:
            raise SignalError('received: all wrong')
        return Estimate(np.full(3, np.nan), np.full((3, 3), np.nan), 'received: all wrong')


@pytest.mark.parametrize('error', [False, True])
def test_without_a_fix_the_positioner_reports_the_reason(positioner, codebooks, signals, error):
    lost = WithoutFix(codebooks[0], error)
    feed(positioner, [CodebookOffered(codebooks[0]), ready(codebooks[0], lost)])
    send, note = positioner.handle(signals(9), 0.0)
    assert isinstance(send.message, m.NoFix)
    assert (send.message.cycle_id, send.message.user) == (9, 2)
    assert send.message.codebook_id == codebooks[0].id
    assert send.message.reason == 'received: all wrong'
    assert note == LogMessage(
        'cycle 9: no fix of user 2: received: all wrong', warning=True, key='signals of user 2',
        holds=True)
    assert positioner.counters == {'no_fix': 1}
    # The answer may be lost, but not the line of the log.
    assert positioner.handle(signals(9), 0.0) == [send]


@pytest.mark.parametrize('error', [ValueError('bad model'), OSError('disk full'), MemoryError()])
def test_an_error_while_an_estimator_is_built_is_an_event(codebooks, error):
    def make(codebook):
        raise error
    event = build_estimator(codebooks[0], make, lambda: 0.0)
    assert event.estimator is None
    assert event.codebook is codebooks[0]
    assert event.failure == (str(error) or 'MemoryError')


def test_a_built_estimator_is_returned_with_its_duration(codebooks):
    watch = iter([3.0, 5.5])
    event = build_estimator(codebooks[0], Fixed, lambda: next(watch))
    assert (event.codebook, event.elapsed_s) == (codebooks[0], 2.5)
    assert event.estimator.name == f'fixed {codebooks[0].id}'


def test_a_plug_in_that_returns_a_position_behind_the_surface_gives_no_fix(
        positioner, signals, codebooks):
    class Behind(Fixed):
        def estimate(self, received):
            return Estimate(PLACE * [-1, 1, 1], np.eye(3))
    *_, (sent,) = feed(positioner, [
        CodebookOffered(codebooks[0]), ready(codebooks[0], Behind(codebooks[0])), signals(1)])
    assert isinstance(sent, m.NoFix)
    assert sent.reason.startswith('position: x = -8 m, expected x > 0')
