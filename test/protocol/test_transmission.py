"""The transmission."""

import dataclasses
import math

import numpy as np
import pytest
from in_memory_network import feed

from rhs_isac_ros.link import Beam, capacity, choose_beam, expected_capacities, steer
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import (
    CodebookOffered,
    LogMessage,
    SettingsOffered,
    Timeout,
)
from rhs_isac_ros.protocol.settings import TransmissionSettings
from rhs_isac_ros.protocol.transmission import Transmission

PLACE = np.array([8.0, -2.0, 0.5])


def configured(beam):
    """The report of the surface after it has applied a beam."""
    return m.RhsConfiguration(
        cycle_id=beam.cycle_id, mode=m.Mode.TRANSMISSION, band=beam.band,
        codebook_id=beam.codebook_id, analog=beam.analog[None])


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
    (*_, (report, _)) = feed(transmission, [truth, weaker, Timeout()])
    used = Beam(beam.analog / 2, beam.digital)
    assert report.actual_bps == pytest.approx(capacity(scenario, used, PLACE[None])[0])
    assert report.actual_bps < report.perfect_bps
    assert report.loss_bps == report.perfect_bps - report.actual_bps


@pytest.mark.parametrize('other', [{'cycle_id': 2}, {'cycle_id': 4}, {'user': 2}])
def test_the_position_of_another_cycle_or_user_is_not_used(
        transmission, example, estimate, other):
    truth = example(m.GroundTruth, **{'cycle_id': 3, 'user': 1} | other)
    ((beam,), _) = feed(transmission, [estimate, truth])
    applied = configured(beam)
    (_, (report,)) = feed(transmission, [applied, Timeout()])
    assert math.isnan(report.actual_bps)
    assert math.isnan(report.perfect_bps)
    assert report.expected_bps == beam.expected_bps


def test_a_report_waits_for_a_true_position_that_is_late(transmission, truth, estimate):
    ((beam,),) = feed(transmission, [estimate])
    transmission.handle(configured(beam), 1.0)
    # Without it, the report is due after a quarter of a second.
    assert transmission.next_deadline() == pytest.approx(1.25)
    transmission.handle(truth, 1.1)
    assert 1.1 < transmission.next_deadline() < 1.2
    report, _ = (action.message for action in transmission.handle(Timeout(), 1.2))
    assert report.cycle_id == beam.cycle_id
    assert math.isfinite(report.loss_percent)
    assert transmission.next_deadline() is None


def test_a_report_without_a_true_position_does_not_delay_the_next(
        transmission, truth, estimate):
    earlier = dataclasses.replace(estimate, cycle_id=2)
    first, second = (beam for (beam,) in feed(transmission, [earlier, estimate]))
    for n, event in enumerate((configured(first), configured(second), truth)):
        transmission.handle(event, 2 + 0.001 * n)
    assert transmission.next_deadline() < 2.1
    reports = [transmission.handle(Timeout(), now_s)[0].message for now_s in (2.1, 2.3)]
    assert [report.cycle_id for report in reports] == [3, 2]
    assert math.isfinite(reports[0].actual_bps)
    assert math.isnan(reports[1].actual_bps)


def test_a_duplicate_estimate_is_answered_with_the_same_beam(scenario, codebooks, estimate):
    chosen = []
    role = Transmission(
        scenario, choose=lambda *given: chosen.append(given) or choose_beam(*given))
    _, (beam,), (again,) = feed(
        role, [CodebookOffered(codebooks[0]), estimate, dataclasses.replace(estimate)])
    assert again is beam
    assert len(chosen) == 1
    assert role.counters == {'duplicate': 1}


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
    (_, (report, _)) = feed(transmission, [configured(beam), Timeout()])
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
            cycle_id=n, user=1, position=place, velocity=np.zeros(3)), applied, Timeout()])[2])
    return sent


def test_the_statistics_are_the_quartiles_of_the_newest_reports(
        scenario, example, codebooks):
    role = Transmission(scenario, window=7)
    role.handle(CodebookOffered(codebooks[0]), 0.0)
    places = scenario.sample_positions(12, np.random.default_rng(5))
    sent = reported(role, scenario, example, codebooks[0], places)
    for n, (report, statistics) in enumerate(sent, 1):
        assert (statistics.cycle_id, statistics.n_reports) == (report.cycle_id, min(n, 7))
        for name in ('expected_bps', 'actual_bps', 'perfect_bps', 'loss_bps', 'loss_percent'):
            values = [getattr(earlier, name) for earlier, _ in sent[max(n - 7, 0):n]]
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
    (_, (again,)) = feed(transmission, [applied, Timeout()])
    assert isinstance(again, m.Capacity)
    ((_, statistics),) = reported(
        transmission, scenario, example, codebooks[0], [place], cycle_id=2)
    assert statistics.n_reports == 2


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
            (bps,) = expected_capacities(scenario, [other], position, covariance)
            assert bps <= beam.expected_bps


def test_the_perfect_beam_is_chosen_from_the_same_bands(
        scenario, codebooks, truth, estimate):
    for band in (-1, 0, 1):
        role = Transmission(scenario, TransmissionSettings(band))
        (_, (beam,)) = feed(role, [CodebookOffered(codebooks[0]), estimate])
        applied = configured(beam)
        (*_, (report, _)) = feed(role, [truth, applied, Timeout()])
        bands = range(2) if band < 0 else [band]
        assert report.perfect_bps == pytest.approx(max(
            capacity(scenario, steer(scenario, PLACE, b), PLACE[None])[0] for b in bands))


def test_a_cycle_keeps_its_bands_when_the_settings_change(
        scenario, codebooks, truth, estimate):
    role = Transmission(scenario, TransmissionSettings(1))
    (_, (beam,)) = feed(role, [CodebookOffered(codebooks[0]), estimate])
    assert role.handle(SettingsOffered(TransmissionSettings(0)), 0.0) == [
        LogMessage("settings applied: band '0'")]
    assert role.status()['parameter.band'] == '0'
    moved = dataclasses.replace(estimate, position=estimate.position + 0.1)
    (again,), (other,), *_, (report, _) = feed(
        role, [estimate, moved, truth, configured(beam), Timeout()])
    assert again is beam
    assert other.band == 1
    assert report.perfect_bps == pytest.approx(
        capacity(scenario, steer(scenario, PLACE, 1), PLACE[None])[0])
    ((new,),) = feed(role, [dataclasses.replace(estimate, cycle_id=4)])
    assert (new.cycle_id, new.band) == (4, 0)


def test_a_report_waits_until_no_message_of_a_cycle_arrives(transmission, estimate, truth):
    """The beam of the next cycle is not delayed by the report of the last one."""
    (beam,) = (action.message for action in transmission.handle(estimate, 0.0))
    transmission.handle(truth, 0.1)
    assert transmission.next_deadline() is None
    assert transmission.handle(configured(beam), 0.2) == []
    assert transmission.next_deadline() == pytest.approx(0.205)
    later = dataclasses.replace(estimate, cycle_id=4)
    (answer,) = transmission.handle(later, 0.204)
    assert isinstance(answer.message, m.Beam)
    assert transmission.next_deadline() == pytest.approx(0.209)
    report, statistics = transmission.handle(Timeout(), 0.21)
    assert (report.message.cycle_id, statistics.message.n_reports) == (3, 1)
    assert transmission.next_deadline() is None


def test_messages_without_a_pause_do_not_postpone_a_report_for_ever(
        transmission, estimate, truth):
    (beam,) = (action.message for action in transmission.handle(estimate, 0.0))
    transmission.handle(truth, 0.0)
    transmission.handle(configured(beam), 0.0)
    for n in range(1, 100):
        transmission.handle(dataclasses.replace(truth, cycle_id=4 + n), n * 4e-3)
    assert transmission.next_deadline() == pytest.approx(0.25)


def test_the_next_report_waits_for_messages_that_arrived_during_the_last_one(
        transmission, estimate, truth):
    (beam,) = (action.message for action in transmission.handle(estimate, 0.0))
    for event in (truth, configured(beam), configured(beam)):
        transmission.handle(event, 0.0)
    report, statistics = transmission.handle(Timeout(), 0.005)
    assert transmission.next_deadline() == pytest.approx(0.01)
    assert len(transmission.handle(Timeout(), 0.01)) == 1
    assert transmission.handle(Timeout(), 0.02) == []


def test_every_report_is_sent(transmission, estimate):
    """When too many wait, the oldest one is computed at once."""
    (beam,) = (action.message for action in transmission.handle(estimate, 0.0))
    sent = [transmission.handle(configured(beam), 0.0) for _ in range(20)]
    while transmission.next_deadline() is not None:
        sent.append(transmission.handle(Timeout(), 1.0))
    assert sum(len(actions) for actions in sent) == 20
