"""The roles that are no state machines: channel, positioner and transmission."""

import itertools
import math

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.link import Beam, capacity, choose_beam, expected_capacity, steer
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.surface import onboard_matrix
from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.events import CodebookOffered, Note, Send
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.protocol.transmission import Transmission

PLACE = np.array([8.0, -2.0, 0.5])


def feed(role, events):
    """What a role sends, one list for each event."""
    return [[action.message for action in role.handle(event, float(n))
             if isinstance(action, Send)] for n, event in enumerate(events)]


@pytest.fixture
def truth():
    return m.GroundTruth(3, 1, PLACE, np.zeros(3))


@pytest.fixture
def configuration(codebooks):
    return m.RhsConfiguration(3, m.Mode.POSITIONING, 0, codebooks[0].id, codebooks[0].analog[0])


@pytest.fixture
def pilots():
    return [m.Pilot(3, 1, 0, frame, 1.0, 0.0) for frame in (0, 1)]


@pytest.fixture
def beam(scenario):
    found = steer(scenario, PLACE)
    return m.Beam(3, 1, 'x', 0, found.analog, found.digital, 5e6)


@pytest.fixture
def applied(beam):
    return m.RhsConfiguration(3, m.Mode.TRANSMISSION, 0, 'x', beam.analog[None])


@pytest.fixture
def downlink():
    return m.Data(3, 1, m.Direction.DOWNLINK, m.Stage.OFFERED, 1e-3, 1e9)


def test_they_wait_for_messages_only(scenario):
    for role in (Channel(scenario, 0), Transmission(scenario, 0),
                 Positioner(scenario, None, None)):
        assert role.next_deadline() is None


def test_the_channel_answers_pilots_in_whatever_order_things_come(
        scenario, truth, configuration, pilots):
    answers = []
    for order in itertools.permutations([truth, configuration, *pilots]):
        sent = feed(Channel(scenario, 0), order)
        # Nothing before all that an answer needs is there.
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
        report = m.RhsConfiguration(3, m.Mode.POSITIONING, 0, 'x', analog)
        pilot = m.Pilot(3, 1, 0, 0, symbol.real, symbol.imag)
        (feeds,) = feed(Channel(scenario, 0), [truth, report, pilot])[-1]
        return feeds.signals

    analog = configuration.analog
    plain = signals(analog, 1 + 0j)
    np.testing.assert_allclose(signals(analog, 0.6 - 0.8j), (0.6 - 0.8j) * plain)
    np.testing.assert_allclose(signals(analog / 2, 1 + 0j), plain / 2)
    assert (signals(0 * analog, 1 + 0j) == 0).all()
    # One element at a time: its path, board included.
    single = [signals(np.eye(16)[m_][None] * np.ones((2, 1)), 1 + 0j) for m_ in range(16)]
    np.testing.assert_allclose(signals(np.ones((2, 16)), 1 + 0j), sum(single))


def test_the_multipath_has_no_mean_and_the_line_of_sight_is_one(scenario, configuration, pilots):
    sums, n = 0, 400
    for cycle_id in range(1, n + 1):
        events = [m.GroundTruth(cycle_id, 1, PLACE, np.zeros(3)),
                  m.RhsConfiguration(cycle_id, m.Mode.POSITIONING, 0, 'x', np.ones((2, 16))),
                  m.Pilot(cycle_id, 1, 0, 0, 1.0, 0.0)]
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
def test_a_pilot_of_another_cycle_is_not_answered_and_forgotten_with_the_cycle(
        scenario, truth, configuration, example, cycle_id):
    channel = Channel(scenario, 0)
    pilot = example(m.Pilot, cycle_id=cycle_id, user=1)
    later = m.GroundTruth(5, 1, PLACE, np.zeros(3))
    assert feed(channel, [truth, configuration, pilot, later]) == [[]] * 4
    assert channel.counters == {'stale': 1}


def test_a_pilot_of_the_next_cycle_waits_for_it(scenario, truth, configuration, codebooks):
    channel = Channel(scenario, 0)
    later = m.RhsConfiguration(4, m.Mode.POSITIONING, 0, 'x', configuration.analog)
    events = [truth, configuration, m.Pilot(4, 1, 0, 0, 1.0, 0.0), later,
              m.GroundTruth(4, 1, PLACE, np.zeros(3))]
    sent = feed(channel, events)
    assert sent[:4] == [[]] * 4
    assert [f.cycle_id for f in sent[4]] == [4]


def test_the_channel_delivers_data_in_whatever_order_things_come(
        scenario, truth, beam, applied, downlink):
    for order in itertools.permutations([truth, beam, applied, downlink]):
        sent = [s for batch in feed(Channel(scenario, 0), order) for s in batch]
        assert [(s.stage, s.bits) for s in sent] == [(m.Stage.DELIVERED, sent[0].bits)]


def test_the_channel_carries_what_the_capacity_at_the_true_position_allows(
        scenario, truth, beam, applied, downlink):
    channel = Channel(scenario, 0)
    feed(channel, [truth, beam, applied])
    rate = capacity(scenario, Beam(beam.analog, beam.digital), PLACE[None])[0]
    ((delivered,),) = feed(channel, [downlink])
    assert delivered.bits == math.floor(rate * 1e-3)
    assert (delivered.direction, delivered.stage) == (m.Direction.DOWNLINK, m.Stage.DELIVERED)
    few = m.Data(3, 1, m.Direction.UPLINK, m.Stage.OFFERED, 1e-3, 10.0)
    ((delivered,),) = feed(channel, [few])
    assert (delivered.direction, delivered.bits) == (m.Direction.UPLINK, 10.0)


def test_the_channel_carries_what_the_surface_reports_not_what_was_asked(
        scenario, truth, beam, downlink):
    off = m.RhsConfiguration(3, m.Mode.TRANSMISSION, 0, 'x', np.zeros((1, 16)))
    (_, _, _, (delivered,)) = feed(Channel(scenario, 0), [truth, beam, off, downlink])
    assert delivered.bits == 0


class Fixed:
    """An estimator that finds one place and knows its codebook."""

    def __init__(self, codebook):
        self.name = f'fixed {codebook.id}'

    def estimate(self, received):
        return Estimate(PLACE, 4 * np.eye(3))


@pytest.fixture
def positioner(scenario):
    """A positioner and the codebooks that it made an estimator for; its watch ticks in seconds."""
    made, watch = [], itertools.count(10.0)

    def make(codebook):
        made.append(codebook.id)
        return Fixed(codebook)
    return Positioner(scenario, make, lambda: next(watch)), made


def test_the_positioner_uses_the_estimator_of_the_signals_codebook(
        positioner, scenario, codebooks, example):
    role, made = positioner
    for codebook in codebooks[:2]:
        role.handle(CodebookOffered(codebook), 0.0)
    assert made == [codebooks[0].id, codebooks[1].id]
    for codebook in codebooks[:2] * 2:
        received = example(m.ReceivedSignals, cycle_id=5, user=2, codebook_id=codebook.id)
        ((estimate,),) = feed(role, [received])
        assert (estimate.cycle_id, estimate.user) == (5, 2)
        assert estimate.codebook_id == codebook.id
        assert estimate.estimator == f'fixed {codebook.id}'
        assert (estimate.position == PLACE).all()
        assert (estimate.covariance_m2 == 4 * np.eye(3)).all()
        assert estimate.crlb_m2 == pytest.approx(crlb(scenario, codebook, PLACE[None])[0])
        assert estimate.latency_s == 1.0
    assert made == [codebooks[0].id, codebooks[1].id]


def test_the_positioner_drops_signals_of_a_codebook_that_it_does_not_know(
        positioner, codebooks, example):
    role, _ = positioner
    received = example(m.ReceivedSignals, codebook_id=codebooks[0].id)
    assert feed(role, [received]) == [[]]
    role.handle(CodebookOffered(codebooks[1]), 0.0)
    assert feed(role, [received]) == [[]]
    assert role.counters == {'wrong_codebook': 2}


def test_the_positioner_makes_one_estimator_for_a_codebook(positioner, codebooks):
    role, made = positioner
    notes = [role.handle(CodebookOffered(codebooks[0]), 0.0) for _ in range(3)]
    assert made == [codebooks[0].id]
    name = f'fixed {codebooks[0].id}'
    assert notes == [[Note(f'{name} is ready for codebook {codebooks[0].id} after 1.0 s')], [], []]


@pytest.fixture
def transmission(scenario, codebooks):
    role = Transmission(scenario)
    role.handle(CodebookOffered(codebooks[0]), 0.0)
    return role


@pytest.fixture
def estimate(codebooks, example):
    return example(m.PositionEstimate, cycle_id=3, user=1, codebook_id=codebooks[0].id,
                   position=PLACE + [0.5, 0.5, 0.0])


def test_the_transmission_reports_what_the_applied_beam_carries(
        transmission, scenario, truth, estimate):
    ((beam,),) = feed(transmission, [estimate])
    assert (beam.cycle_id, beam.user, beam.codebook_id) == (3, 1, estimate.codebook_id)
    weaker = m.RhsConfiguration(
        3, m.Mode.TRANSMISSION, 0, beam.codebook_id, beam.analog[None] / 2)
    (_, (report, _)) = feed(transmission, [truth, weaker])
    used = Beam(beam.analog / 2, beam.digital)
    assert report.actual_bps == pytest.approx(capacity(scenario, used, PLACE[None])[0])
    assert report.actual_bps < report.perfect_bps
    assert report.loss_bps == report.perfect_bps - report.actual_bps


def test_no_beam_is_better_than_the_perfect_one(transmission, scenario, codebooks, example):
    """Steering finds one of many maxima, but never one that is much below another."""
    rng = np.random.default_rng(0)
    for place in scenario.sample_positions(20, rng):
        near = place + rng.normal(scale=0.2, size=3)
        estimate = example(m.PositionEstimate, cycle_id=3, user=1, position=near,
                           codebook_id=codebooks[0].id)
        ((beam,),) = feed(transmission, [estimate])
        truth = m.GroundTruth(3, 1, place, np.zeros(3))
        applied = m.RhsConfiguration(3, m.Mode.TRANSMISSION, 0, 'x', beam.analog[None])
        (_, (report, _)) = feed(transmission, [truth, applied])
        assert -0.05 <= report.loss_percent < 100


@pytest.mark.parametrize('other', [{'cycle_id': 2}, {'cycle_id': 4}, {'user': 2}])
def test_the_truth_of_another_cycle_or_user_is_not_used(
        transmission, example, estimate, other):
    truth = example(m.GroundTruth, **{'cycle_id': 3, 'user': 1} | other)
    ((beam,), _) = feed(transmission, [estimate, truth])
    applied = m.RhsConfiguration(3, m.Mode.TRANSMISSION, 0, 'x', beam.analog[None])
    ((report,),) = feed(transmission, [applied])
    assert math.isnan(report.actual_bps)
    assert math.isnan(report.perfect_bps)
    assert report.expected_bps == beam.expected_bps


def test_a_report_without_a_beam_is_counted(transmission, applied):
    assert feed(transmission, [applied]) == [[]]
    assert transmission.counters == {'wrong_cycle': 1}


def reported(transmission, scenario, example, codebook, places, cycle_id=1):
    """What it sends for one cycle at each of the places, the estimates being half a metre off."""
    sent = []
    for n, place in enumerate(places, cycle_id):
        estimate = example(m.PositionEstimate, cycle_id=n, user=1, codebook_id=codebook.id,
                           position=place + [0.0, 0.5, 0.0], covariance_m2=0.1 * np.eye(3))
        ((beam,),) = feed(transmission, [estimate])
        applied = m.RhsConfiguration(
            n, m.Mode.TRANSMISSION, beam.band, codebook.id, beam.analog[None])
        sent.append(feed(transmission, [m.GroundTruth(n, 1, place, np.zeros(3)), applied])[1])
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


def test_a_report_that_is_repeated_counts_once(transmission, scenario, example, codebooks):
    (place,) = scenario.sample_positions(1, np.random.default_rng(5))
    ((report, statistics),) = reported(transmission, scenario, example, codebooks[0], [place])
    assert statistics.n_reports == 1
    applied = m.RhsConfiguration(1, m.Mode.TRANSMISSION, report.band, 'x', np.ones((1, 16)))
    ((again,),) = feed(transmission, [applied])
    assert isinstance(again, m.Capacity)
    ((_, statistics),) = reported(
        transmission, scenario, example, codebooks[0], [place], cycle_id=2)
    assert statistics.n_reports == 2


def test_without_a_true_position_there_are_no_statistics(transmission, estimate):
    ((beam,),) = feed(transmission, [estimate])
    applied = m.RhsConfiguration(3, m.Mode.TRANSMISSION, beam.band, 'x', beam.analog[None])
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


def test_the_perfect_position_has_the_choice_of_the_same_bands(
        scenario, codebooks, truth, estimate):
    for band in (None, 0, 1):
        role = Transmission(scenario, band)
        (_, (beam,)) = feed(role, [CodebookOffered(codebooks[0]), estimate])
        applied = m.RhsConfiguration(
            3, m.Mode.TRANSMISSION, beam.band, 'x', beam.analog[None])
        (_, (report, _)) = feed(role, [truth, applied])
        bands = range(2) if band is None else [band]
        assert report.perfect_bps == pytest.approx(max(
            capacity(scenario, steer(scenario, PLACE, b), PLACE[None])[0] for b in bands))


def test_the_transmission_takes_its_band(scenario, codebooks, estimate):
    role = Transmission(scenario, 1)
    (_, (beam,)) = feed(role, [CodebookOffered(codebooks[0]), estimate])
    expected = steer(scenario, estimate.position, 1)
    assert beam.band == 1
    np.testing.assert_array_equal(beam.analog, expected.analog)
    assert beam.expected_bps == capacity(scenario, expected, estimate.position[None])[0]


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('name', ['channel', 'positioner', 'transmission'])
def test_no_sequence_of_messages_breaks_them(
        scenario, codebooks, subscriptions, example, name, seed):
    role = {'channel': lambda: Channel(scenario, 0),
            'positioner': lambda: Positioner(scenario, Fixed, lambda: 0.0),
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
            role.handle(CodebookOffered(codebooks[rng.integers(3)]), float(n))
        for action in role.handle(example(kind, rng, **given), float(n)):
            assert isinstance(action, Send)
            m.check(action.message, scenario.sizes)
            sent += 1
    assert sent
    assert all(n > 0 for n in role.counters.values())
