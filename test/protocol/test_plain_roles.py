"""The roles without states: channel, positioner and transmission."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.link import Beam, capacity, choose_beam, expected_capacity, steer
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.surface import onboard_matrix
from rhs_isac_ros.positioning import Estimate, SignalError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.events import (
    BuildEstimator,
    CodebookOffered,
    EstimatorFailed,
    EstimatorReady,
    LogMessage,
    Send,
    SettingsOffered,
)
from rhs_isac_ros.protocol.positioner import Positioner, build_estimator
from rhs_isac_ros.protocol.settings import TransmissionSettings
from rhs_isac_ros.protocol.transmission import Transmission

PLACE = np.array([8.0, -2.0, 0.5])


def feed(role, events):
    """Return the messages that a role sends, one list for each event."""
    return [[action.message for action in role.handle(event, float(n))
             if isinstance(action, Send)] for n, event in enumerate(events)]


@pytest.fixture
def truth():
    return m.GroundTruth(cycle_id=3, user=1, position=PLACE, velocity=np.zeros(3))


@pytest.fixture
def configuration(codebooks):
    return m.RhsConfiguration(
        cycle_id=3, mode=m.Mode.POSITIONING, band=0, codebook_id=codebooks[0].id,
        analog=codebooks[0].analog[0])


@pytest.fixture
def pilots():
    return [m.Pilot(
        cycle_id=3, user=1, band=0, frame=frame, symbol_re=1.0, symbol_im=0.0) for frame in (0, 1)]


@pytest.fixture
def beam(scenario):
    found = steer(scenario, PLACE)
    return m.Beam(
        cycle_id=3, user=1, codebook_id='x', band=0, analog=found.analog, digital=found.digital,
        expected_bps=5e6)


@pytest.fixture
def applied(beam):
    return m.RhsConfiguration(
        cycle_id=3, mode=m.Mode.TRANSMISSION, band=0, codebook_id='x', analog=beam.analog[None])


def configured(beam):
    """The report of the surface after it has applied a beam."""
    return m.RhsConfiguration(
        cycle_id=beam.cycle_id, mode=m.Mode.TRANSMISSION, band=beam.band,
        codebook_id=beam.codebook_id, analog=beam.analog[None])


@pytest.fixture
def downlink():
    return m.Data(
        cycle_id=3, user=1, direction=m.Direction.DOWNLINK, stage=m.Stage.OFFERED, duration_s=1e-3,
        bits=1e9)


def test_they_have_no_deadlines(scenario):
    for role in (Channel(scenario, 0), Transmission(scenario),
                 Positioner(scenario, None)):
        assert role.next_deadline() is None


def test_the_channel_answers_pilots_for_any_order_of_messages(
        scenario, truth, configuration, pilots):
    answers = []
    for order in itertools.permutations([truth, configuration, *pilots]):
        sent = feed(Channel(scenario, 0), order)
        # No answer before all messages that it needs have arrived.
        known = max(order.index(truth), order.index(configuration))
        assert all(not s for s in sent[:known])
        answers.append({f.frame: f for batch in sent for f in batch})
    for found in answers:
        assert found.keys() == {0, 1}
        for frame, feeds in found.items():
            assert (feeds.cycle_id, feeds.user, feeds.band) == (3, 1, 0)
            np.testing.assert_array_equal(feeds.signals, answers[0][frame].signals)
    assert not np.isclose(answers[0][0].signals, answers[0][1].signals).any()


def test_feed_signals_follow_configuration_and_symbol(scenario, truth, configuration, pilots):
    def signals(analog, symbol):
        report = m.RhsConfiguration(
            cycle_id=3, mode=m.Mode.POSITIONING, band=0, codebook_id='x', analog=analog)
        pilot = m.Pilot(
            cycle_id=3, user=1, band=0, frame=0, symbol_re=symbol.real, symbol_im=symbol.imag)
        (feeds,) = feed(Channel(scenario, 0), [truth, report, pilot])[-1]
        return feeds.signals

    analog = configuration.analog
    plain = signals(analog, 1 + 0j)
    np.testing.assert_allclose(signals(analog, 0.6 - 0.8j), (0.6 - 0.8j) * plain)
    np.testing.assert_allclose(signals(analog / 2, 1 + 0j), plain / 2)
    assert (signals(0 * analog, 1 + 0j) == 0).all()
    # Element by element: the path, including on-board propagation.
    single = [signals(np.eye(16)[m_][None] * np.ones((2, 1)), 1 + 0j) for m_ in range(16)]
    np.testing.assert_allclose(signals(np.ones((2, 16)), 1 + 0j), sum(single))


def test_the_multipath_has_zero_mean_and_the_line_of_sight_is_1(scenario, configuration, pilots):
    sums, n = 0, 400
    for cycle_id in range(1, n + 1):
        events = [m.GroundTruth(cycle_id=cycle_id, user=1, position=PLACE, velocity=np.zeros(3)),
                  m.RhsConfiguration(
                      cycle_id=cycle_id, mode=m.Mode.POSITIONING, band=0, codebook_id='x',
                      analog=np.ones((2, 16))),
                  m.Pilot(
                      cycle_id=cycle_id, user=1, band=0, frame=0, symbol_re=1.0, symbol_im=0.0)]
        ((feeds,),) = feed(Channel(scenario, 0), events)[-1:]
        sums = sums + np.array([feeds.signals, np.abs(feeds.signals)**2])
    mean, power = sums / n
    los = los_gain(scenario, PLACE[None], 0)[0]
    expected = np.einsum('jm,jkm->jk', los, onboard_matrix(scenario)[0])
    spread = np.sqrt(np.maximum(power.real - np.abs(mean)**2, 0) / n)
    assert (spread > 0).all()
    assert (np.abs(mean - expected) < 4 * spread).all()


def test_a_pilot_of_another_user_is_not_answered(scenario, truth, configuration, example):
    channel = Channel(scenario, 0)
    pilot = example(m.Pilot, cycle_id=3, user=2)
    assert feed(channel, [truth, configuration, pilot]) == [[], [], []]
    assert channel.counters == {'wrong_user': 1}


@pytest.mark.parametrize('cycle_id', [2, 4])
def test_a_pilot_of_another_cycle_is_discarded_with_the_next_cycle(
        scenario, truth, configuration, example, cycle_id):
    channel = Channel(scenario, 0)
    pilot = example(m.Pilot, cycle_id=cycle_id, user=1)
    later = m.GroundTruth(cycle_id=5, user=1, position=PLACE, velocity=np.zeros(3))
    assert feed(channel, [truth, configuration, pilot, later]) == [[]] * 4
    assert channel.counters == {'stale': 1}


def test_a_pilot_of_the_next_cycle_waits_for_it(scenario, truth, configuration, codebooks):
    channel = Channel(scenario, 0)
    later = m.RhsConfiguration(
        cycle_id=4, mode=m.Mode.POSITIONING, band=0, codebook_id='x', analog=configuration.analog)
    events = [truth, configuration, m.Pilot(
        cycle_id=4, user=1, band=0, frame=0, symbol_re=1.0, symbol_im=0.0), later,
              m.GroundTruth(cycle_id=4, user=1, position=PLACE, velocity=np.zeros(3))]
    sent = feed(channel, events)
    assert sent[:4] == [[]] * 4
    assert [f.cycle_id for f in sent[4]] == [4]


def test_the_channel_delivers_data_for_any_order_of_messages(
        scenario, truth, beam, applied, downlink):
    for order in itertools.permutations([truth, beam, applied, downlink]):
        sent = [s for batch in feed(Channel(scenario, 0), order) for s in batch]
        assert [(s.stage, s.bits) for s in sent] == [(m.Stage.DELIVERED, sent[0].bits)]


def test_the_channel_delivers_the_capacity_at_the_true_position(
        scenario, truth, beam, applied, downlink):
    channel = Channel(scenario, 0)
    feed(channel, [truth, beam, applied])
    rate = capacity(scenario, Beam(beam.analog, beam.digital), PLACE[None])[0]
    ((delivered,),) = feed(channel, [downlink])
    assert delivered.bits == math.floor(rate * 1e-3)
    assert (delivered.direction, delivered.stage) == (m.Direction.DOWNLINK, m.Stage.DELIVERED)
    few = m.Data(
        cycle_id=3, user=1, direction=m.Direction.UPLINK, stage=m.Stage.OFFERED, duration_s=1e-3,
        bits=10.0)
    ((delivered,),) = feed(channel, [few])
    assert (delivered.direction, delivered.bits) == (m.Direction.UPLINK, 10.0)


def test_the_channel_uses_the_reported_configuration_of_the_surface(
        scenario, truth, beam, downlink):
    off = m.RhsConfiguration(
        cycle_id=3, mode=m.Mode.TRANSMISSION, band=0, codebook_id='x', analog=np.zeros((1, 16)))
    (_, _, _, (delivered,)) = feed(Channel(scenario, 0), [truth, beam, off, downlink])
    assert delivered.bits == 0


class Fixed:
    """An estimator with a fixed result that holds its codebook."""

    def __init__(self, codebook):
        self.name = f'fixed {codebook.id}'

    def estimate(self, received):
        return Estimate(PLACE, 4 * np.eye(3))


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


def made(codebook, estimator=None):
    return EstimatorReady(codebook, estimator or Fixed(codebook), 1.5)


def wanted(actions):
    """Return the ids of the codebooks for which estimators are requested."""
    return [action.codebook.id for action in actions if isinstance(action, BuildEstimator)]


def test_the_codebook_of_the_signals_selects_the_estimator(
        positioner, scenario, codebooks, signals):
    for codebook in codebooks[:2]:
        assert wanted(positioner.handle(CodebookOffered(codebook), 0.0)) == [codebook.id]
        assert positioner.handle(made(codebook), 0.0) == [
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


def test_duplicate_signals_are_answered_twice_and_estimated_once(
        positioner, codebooks, signals):
    feed(positioner, [CodebookOffered(codebooks[0]), made(codebooks[0])])
    (first,), (again,), (other,) = feed(positioner, [signals(5), signals(5), signals(6)])
    assert again is first
    assert other.cycle_id == 6
    assert positioner.counters == {'duplicate': 1}


def test_the_positioner_drops_signals_of_an_unknown_codebook(
        positioner, codebooks, signals):
    assert feed(positioner, [signals(1)]) == [[]]
    feed(positioner, [CodebookOffered(codebooks[1]), made(codebooks[1])])
    assert feed(positioner, [signals(1)]) == [[]]
    assert positioner.counters == {'wrong_codebook': 2}


def test_the_positioner_requests_one_estimator_for_a_codebook(positioner, codebooks):
    offers = [positioner.handle(CodebookOffered(codebooks[0]), 0.0) for _ in range(3)]
    assert list(map(wanted, offers)) == [[codebooks[0].id], [], []]
    positioner.handle(made(codebooks[0]), 0.0)
    assert positioner.handle(CodebookOffered(codebooks[0]), 0.0) == []


def test_the_old_estimator_is_used_while_the_new_one_is_built(
        positioner, codebooks, signals):
    feed(positioner, [CodebookOffered(codebooks[0]), made(codebooks[0]),
                      CodebookOffered(codebooks[1])])
    (old,), nothing, (old_again,), (new,) = feed(
        positioner, [signals(1), signals(2, 1), signals(3), made(codebooks[1])])
    assert nothing == []
    assert [e.cycle_id for e in (old, old_again, new)] == [1, 3, 2]
    assert new.codebook_id == codebooks[1].id
    assert positioner.counters == {}


def test_the_newest_of_waiting_signals_are_used(positioner, codebooks, signals):
    *before, (estimate,), after = feed(
        positioner, [CodebookOffered(codebooks[0]), signals(1), signals(2), made(codebooks[0]),
                     CodebookOffered(codebooks[0])])
    assert before == [[], [], []]
    assert estimate.cycle_id == 2
    assert after == []


def test_estimators_are_built_one_at_a_time_the_newest_next(
        positioner, codebooks, signals):
    first, second, third = codebooks
    offers = [wanted(positioner.handle(CodebookOffered(c), 0.0)) for c in (first, second, third)]
    assert offers == [[first.id], [], []]
    positioner.handle(signals(7, 2), 0.0)
    assert wanted(positioner.handle(made(first), 0.0)) == [third.id]
    ((estimate,),) = feed(positioner, [made(third)])
    assert (estimate.cycle_id, estimate.codebook_id) == (7, third.id)
    assert feed(positioner, [signals(8, 1)]) == [[]]
    assert positioner.counters == {'wrong_codebook': 1}


def test_no_estimator_is_built_for_a_codebook_replaced_meanwhile(positioner, codebooks):
    first, second, _ = codebooks
    feed(positioner, [CodebookOffered(c) for c in (first, second, first)])
    assert wanted(positioner.handle(made(first), 0.0)) == []


def test_the_old_estimator_is_kept_if_the_new_one_cannot_be_built(positioner, codebooks, signals):
    feed(positioner, [CodebookOffered(codebooks[0]), made(codebooks[0]),
                      CodebookOffered(codebooks[1]), signals(4, 1)])
    assert positioner.handle(EstimatorFailed(codebooks[1], 'no model'), 0.0) == [
        LogMessage(f'no estimator for codebook {codebooks[1].id}: no model', warning=True)]
    assert [len(sent) for sent in feed(positioner, [signals(5), signals(6, 1)])] == [1, 0]
    assert positioner.counters == {'wrong_codebook': 2}
    # The codebook may be offered again.
    assert wanted(positioner.handle(CodebookOffered(codebooks[1]), 0.0)) == [codebooks[1].id]


class Lost(Fixed):
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
    lost = Lost(codebooks[0], error)
    feed(positioner, [CodebookOffered(codebooks[0]), made(codebooks[0], lost)])
    send, note = positioner.handle(signals(9), 0.0)
    assert isinstance(send.message, m.NoFix)
    assert (send.message.cycle_id, send.message.user) == (9, 2)
    assert send.message.codebook_id == codebooks[0].id
    assert send.message.reason == 'received: all wrong'
    assert note == LogMessage('cycle 9: no fix: received: all wrong', warning=True)
    assert positioner.counters == {'no_fix': 1}


@pytest.mark.parametrize('error', [ValueError('bad model'), OSError('disk full'), MemoryError()])
def test_an_error_while_an_estimator_is_built_is_an_event(codebooks, error):
    def make(codebook):
        raise error
    event = build_estimator(codebooks[0], make, lambda: 0.0)
    assert isinstance(event, EstimatorFailed)
    assert event.codebook is codebooks[0]
    assert event.reason == (str(error) or 'MemoryError')


def test_a_built_estimator_is_returned_with_its_duration(codebooks):
    watch = iter([3.0, 5.5])
    event = build_estimator(codebooks[0], Fixed, lambda: next(watch))
    assert (event.codebook, event.elapsed_s) == (codebooks[0], 2.5)
    assert event.estimator.name == f'fixed {codebooks[0].id}'


@pytest.fixture
def transmission(scenario, codebooks):
    role = Transmission(scenario)
    role.handle(CodebookOffered(codebooks[0]), 0.0)
    return role


@pytest.fixture
def estimate(codebooks, example):
    return example(m.PositionEstimate, cycle_id=3, user=1, codebook_id=codebooks[0].id,
                   position=PLACE + [0.5, 0.5, 0.0])


def test_the_transmission_reports_the_capacity_of_the_applied_beam(
        transmission, scenario, truth, estimate):
    ((beam,),) = feed(transmission, [estimate])
    assert (beam.cycle_id, beam.user, beam.codebook_id) == (3, 1, estimate.codebook_id)
    weaker = m.RhsConfiguration(
        cycle_id=3, mode=m.Mode.TRANSMISSION, band=beam.band, codebook_id=beam.codebook_id,
        analog=beam.analog[None] / 2)
    (_, (report, _)) = feed(transmission, [truth, weaker])
    used = Beam(beam.analog / 2, beam.digital)
    assert report.actual_bps == pytest.approx(capacity(scenario, used, PLACE[None])[0])
    assert report.actual_bps < report.perfect_bps
    assert report.loss_bps == report.perfect_bps - report.actual_bps


def test_no_beam_exceeds_the_perfect_one(transmission, scenario, codebooks, example):
    """The search may find a local maximum, but never one much below another."""
    rng = np.random.default_rng(0)
    for cycle_id, place in enumerate(scenario.sample_positions(20, rng), 1):
        near = place + rng.normal(scale=0.2, size=3)
        estimate = example(m.PositionEstimate, cycle_id=cycle_id, user=1, position=near,
                           codebook_id=codebooks[0].id)
        ((beam,),) = feed(transmission, [estimate])
        truth = m.GroundTruth(cycle_id=cycle_id, user=1, position=place, velocity=np.zeros(3))
        applied = configured(beam)
        (_, (report, _)) = feed(transmission, [truth, applied])
        assert -0.05 <= report.loss_percent < 100


@pytest.mark.parametrize('other', [{'cycle_id': 2}, {'cycle_id': 4}, {'user': 2}])
def test_the_position_of_another_cycle_or_user_is_not_used(
        transmission, example, estimate, other):
    truth = example(m.GroundTruth, **{'cycle_id': 3, 'user': 1} | other)
    ((beam,), _) = feed(transmission, [estimate, truth])
    applied = configured(beam)
    ((report,),) = feed(transmission, [applied])
    assert math.isnan(report.actual_bps)
    assert math.isnan(report.perfect_bps)
    assert report.expected_bps == beam.expected_bps


def test_a_duplicate_estimate_is_answered_with_the_same_beam(
        transmission, estimate, truth, monkeypatch):
    ((beam,),) = feed(transmission, [estimate])
    monkeypatch.setattr('rhs_isac_ros.protocol.transmission.choose_beam', None)
    ((again,),) = feed(transmission, [dataclasses.replace(estimate)])
    assert again is beam
    assert transmission.counters == {'duplicate': 1}


def test_a_report_without_a_beam_is_counted(transmission, applied):
    assert feed(transmission, [applied]) == [[]]
    assert transmission.counters == {'wrong_cycle': 1}


@pytest.mark.parametrize(('changes', 'reason'), [
    ({'codebook_id': 'x'}, 'wrong_codebook'), ({'band': 1}, 'wrong_band'),
    ({'cycle_id': 4}, 'wrong_cycle')])
def test_a_report_of_another_beam_is_counted(transmission, estimate, changes, reason):
    ((beam,),) = feed(transmission, [estimate])
    other = {'band': 1 - beam.band} if 'band' in changes else changes
    assert feed(transmission, [dataclasses.replace(configured(beam), **other)]) == [[]]
    assert transmission.counters == {reason: 1}


def test_late_messages_of_an_older_cycle_do_not_replace_the_present_one(
        transmission, estimate, truth):
    later = dataclasses.replace(estimate, cycle_id=4)
    place = dataclasses.replace(truth, cycle_id=4)
    ((beam,), *_) = feed(transmission, [later, place, estimate, truth])
    ((report, _),) = feed(transmission, [configured(beam)])
    assert report.cycle_id == 4
    assert math.isfinite(report.actual_bps)
    assert transmission.counters == {}


def reported(transmission, scenario, example, codebook, places, cycle_id=1):
    """Return the messages of one cycle for each position, with estimates off by half a metre."""
    sent = []
    for n, place in enumerate(places, cycle_id):
        estimate = example(m.PositionEstimate, cycle_id=n, user=1, codebook_id=codebook.id,
                           position=place + [0.0, 0.5, 0.0], covariance_m2=0.1 * np.eye(3))
        ((beam,),) = feed(transmission, [estimate])
        applied = m.RhsConfiguration(
            cycle_id=n, mode=m.Mode.TRANSMISSION, band=beam.band, codebook_id=codebook.id,
            analog=beam.analog[None])
        sent.append(feed(transmission, [m.GroundTruth(
            cycle_id=n, user=1, position=place, velocity=np.zeros(3)), applied])[1])
    return sent


def test_the_statistics_are_the_quartiles_of_the_reports(
        transmission, scenario, example, codebooks):
    places = scenario.sample_positions(12, np.random.default_rng(5))
    sent = reported(transmission, scenario, example, codebooks[0], places)
    for n, (report, statistics) in enumerate(sent, 1):
        assert (statistics.cycle_id, statistics.n_reports) == (report.cycle_id, n)
        for name in ('expected_bps', 'actual_bps', 'perfect_bps', 'loss_bps', 'loss_percent'):
            values = [getattr(earlier, name) for earlier, _ in sent[:n]]
            np.testing.assert_allclose(
                getattr(statistics, name), np.percentile(values, [25, 50, 75]), rtol=1e-12)
    assert sent[-1][1].loss_percent[1] > 0


def test_a_repeated_report_is_counted_once(transmission, scenario, example, codebooks):
    (place,) = scenario.sample_positions(1, np.random.default_rng(5))
    ((report, statistics),) = reported(transmission, scenario, example, codebooks[0], [place])
    assert statistics.n_reports == 1
    applied = m.RhsConfiguration(
        cycle_id=1, mode=m.Mode.TRANSMISSION, band=report.band, codebook_id=report.codebook_id,
        analog=np.ones((1, 16)))
    ((again,),) = feed(transmission, [applied])
    assert isinstance(again, m.Capacity)
    ((_, statistics),) = reported(
        transmission, scenario, example, codebooks[0], [place], cycle_id=2)
    assert statistics.n_reports == 2


def test_without_a_true_position_there_are_no_statistics(transmission, estimate):
    ((beam,),) = feed(transmission, [estimate])
    applied = configured(beam)
    ((report,),) = feed(transmission, [applied])
    assert isinstance(report, m.Capacity)


def test_the_transmission_chooses_the_band_by_the_posterior(scenario, codebooks, example):
    covariance = np.diag([0.5, 2.0, 0.3])
    for position in scenario.sample_positions(5, np.random.default_rng(2)):
        estimate = example(m.PositionEstimate, cycle_id=3, user=1, position=position,
                           codebook_id=codebooks[0].id, covariance_m2=covariance)
        (_, (beam,)) = feed(Transmission(scenario), [CodebookOffered(codebooks[0]), estimate])
        choice = choose_beam(scenario, position, covariance)
        assert (beam.band, beam.expected_bps) == (choice.beam.band, choice.expected_bps)
        for band in range(scenario.n_bands):
            other = steer(scenario, position, band)
            assert expected_capacity(scenario, other, position, covariance) <= beam.expected_bps


def test_the_perfect_beam_is_chosen_from_the_same_bands(
        scenario, codebooks, truth, estimate):
    for band in (-1, 0, 1):
        role = Transmission(scenario, TransmissionSettings(band))
        (_, (beam,)) = feed(role, [CodebookOffered(codebooks[0]), estimate])
        applied = configured(beam)
        (_, (report, _)) = feed(role, [truth, applied])
        bands = range(2) if band < 0 else [band]
        assert report.perfect_bps == pytest.approx(max(
            capacity(scenario, steer(scenario, PLACE, b), PLACE[None])[0] for b in bands))


def test_the_transmission_uses_the_configured_band(scenario, codebooks, estimate):
    role = Transmission(scenario, TransmissionSettings(1))
    (_, (beam,)) = feed(role, [CodebookOffered(codebooks[0]), estimate])
    expected = steer(scenario, estimate.position, 1)
    assert beam.band == 1
    np.testing.assert_array_equal(beam.analog, expected.analog)
    assert beam.expected_bps == capacity(scenario, expected, estimate.position[None])[0]


def test_a_cycle_keeps_its_bands_when_the_settings_change(
        scenario, codebooks, truth, estimate):
    role = Transmission(scenario, TransmissionSettings(1))
    (_, (beam,)) = feed(role, [CodebookOffered(codebooks[0]), estimate])
    assert role.handle(SettingsOffered(TransmissionSettings(0)), 0.0) == [
        LogMessage("from now on: band '0'")]
    assert role.status()['parameter.band'] == '0'
    moved = dataclasses.replace(estimate, position=estimate.position + 0.1)
    (again,), (other,), _, (report, _) = feed(role, [estimate, moved, truth, configured(beam)])
    assert again is beam
    assert other.band == 1
    assert report.perfect_bps == pytest.approx(
        capacity(scenario, steer(scenario, PLACE, 1), PLACE[None])[0])
    ((new,),) = feed(role, [dataclasses.replace(estimate, cycle_id=4)])
    assert (new.cycle_id, new.band) == (4, 0)


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('name', ['channel', 'positioner', 'transmission'])
def test_no_sequence_of_messages_raises_an_error(
        scenario, codebooks, subscriptions, example, name, seed):
    role = {'channel': lambda: Channel(scenario, 0),
            'positioner': lambda: Positioner(scenario, lambda: 0.0),
            'transmission': lambda: Transmission(scenario)}[name]()
    rng = np.random.default_rng(seed)
    kinds = subscriptions[name]
    sent = 0
    for n in range(500):
        kind = kinds[rng.integers(len(kinds))]
        fields = kind.__dataclass_fields__
        given = {'cycle_id': int(rng.integers(0, 3))}
        if 'codebook_id' in fields:
            given['codebook_id'] = codebooks[rng.integers(3)].id
        if 'user' in fields:
            given['user'] = int(rng.integers(1, 3))
        if 'position' in fields:
            given['position'] = scenario.sample_positions(1, rng)[0]
        if name != 'channel' and rng.random() < 0.05:
            offered = CodebookOffered(codebooks[rng.integers(3)])
            for action in role.handle(offered, float(n)):
                role.handle(EstimatorReady(action.codebook, Fixed(action.codebook), 0.0), float(n))
        for action in role.handle(example(kind, rng, **given), float(n)):
            assert isinstance(action, Send)
            m.check(action.message, scenario.sizes)
            sent += 1
    assert sent
    assert all(n > 0 for n in role.counters.values())
