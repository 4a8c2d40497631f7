"""The transmission."""

import dataclasses
import math

import numpy as np
import pytest
from in_memory_network import feed, plain_choice

from rhs_isac_ros.link import (
    Beamformer,
    CapacityReport,
    capacity,
    choose_beam,
    expected_capacities,
    steer,
)
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import CodebookOffered, LogMessage, SettingsOffered, Timeout
from rhs_isac_ros.protocol.settings import TransmissionSettings
from rhs_isac_ros.protocol.transmission import Transmission

PLACE = np.array([8.0, -2.0, 0.5])


def configured(beam, share=1.0):
    """The report of the surface after it has applied a share of a beam."""
    return m.derive(m.RhsConfiguration, beam, mode=m.Mode.TRANSMISSION,
                    analog=share * beam.analog[None])


@pytest.fixture
def make(scenario, codebooks):
    def make(*args, **options):
        role = Transmission(scenario, *args, **options)
        role.handle(CodebookOffered(codebooks[0]), 0.0)
        return role
    return make


@pytest.fixture
def transmission(make):
    return make()


@pytest.fixture
def estimate(codebooks, example):
    return example(m.PositionEstimate, cycle_id=3, user=1, codebook_id=codebooks[0].id,
                   position=PLACE + [0.5, 0.5, 0.0], covariance_m2=np.diag([0.5, 2.0, 0.3]))


@pytest.fixture
def beam(transmission, estimate):
    """The beam of the transmission for the estimate."""
    (action,) = transmission.handle(estimate, 0.0)
    return action.message


def test_the_beam_is_that_of_the_posterior(beam, scenario, estimate):
    choice = choose_beam(scenario, estimate.position, estimate.covariance_m2)
    assert (beam.band, beam.expected_bps) == (choice.beam.band, choice.expected_bps)
    assert beam.expected_bps == pytest.approx(expected_capacities(
        scenario, [choice.beam], estimate.position, estimate.covariance_m2)[0])
    assert (beam.cycle_id, beam.user, beam.codebook_id) == (3, 1, estimate.codebook_id)
    np.testing.assert_array_equal(beam.analog, choice.beam.analog)


def test_the_transmission_reports_the_capacities_of_the_beam_and_of_the_applied_one(
        transmission, scenario, truth, estimate, beam):
    (*_, (report, _)) = feed(transmission, [truth, configured(beam, 0.5), Timeout()])
    used = Beamformer(beam.analog / 2, beam.digital, beam.band)
    sent = Beamformer(beam.analog, beam.digital, beam.band)
    assert (report.band, report.expected_bps) == (beam.band, beam.expected_bps)
    assert report.at_estimate_bps == pytest.approx(
        capacity(scenario, sent, estimate.position[None])[0])
    assert report.actual_bps == pytest.approx(capacity(scenario, used, PLACE[None])[0])
    assert report.actual_bps < report.perfect_bps
    assert report.loss_bps == report.perfect_bps - report.actual_bps
    assert report.loss_percent == pytest.approx(100 * report.loss_bps / report.perfect_bps)


@pytest.mark.parametrize('other', [{'cycle_id': 2}, {'cycle_id': 4}, {'user': 2}])
def test_the_position_of_another_cycle_or_user_is_not_used(
        transmission, example, beam, other):
    truth = example(m.GroundTruth, **{'cycle_id': 3, 'user': 1} | other)
    *_, (report,) = feed(transmission, [truth, configured(beam), Timeout()])
    assert np.isnan([report.actual_bps, report.perfect_bps]).all()
    assert report.expected_bps == beam.expected_bps


def test_a_duplicate_estimate_is_answered_with_the_same_beam(make, estimate):
    chosen = []
    role = make(choose=lambda *given: chosen.append(given) or choose_beam(*given))
    (beam,), (again,) = feed(role, [estimate, dataclasses.replace(estimate)])
    assert again is beam
    assert len(chosen) == 1
    assert role.counters == {'duplicate': 1}


@pytest.mark.parametrize(('changes', 'reason'), [
    ({'codebook_id': 'x'}, 'wrong_codebook'), ({'band': 1}, 'wrong_band'),
    ({'cycle_id': 4}, 'wrong_cycle')])
def test_a_report_of_another_beam_is_counted(transmission, beam, changes, reason):
    other = {'band': 1 - beam.band} if 'band' in changes else changes
    assert feed(transmission, [dataclasses.replace(configured(beam), **other)]) == [[]]
    assert transmission.counters == {reason: 1}


def test_the_statistics_are_the_quartiles_of_the_newest_reports(make, truth, estimate):
    rng, sent = np.random.default_rng(5), []
    role = make(choose=plain_choice,
                evaluate=lambda *given: CapacityReport(*np.sort(rng.uniform(1e6, 2e6, 2))))
    for n in range(1, 1008):
        ((beam,),) = feed(role, [dataclasses.replace(estimate, cycle_id=n)])
        *_, (report, statistics) = feed(
            role, [dataclasses.replace(truth, cycle_id=n), configured(beam), Timeout()])
        sent.append(report)
        assert (statistics.cycle_id, statistics.n_reports) == (n, min(n, 1000))
    # A repeated report does not count.
    _, (again,) = feed(role, [configured(beam), Timeout()])
    assert isinstance(again, m.Capacity)
    for name in ('expected_bps', 'actual_bps', 'perfect_bps', 'loss_bps', 'loss_percent'):
        np.testing.assert_allclose(getattr(statistics, name), np.percentile(
            [getattr(one, name) for one in sent[-1000:]], [25, 50, 75]), rtol=1e-12)
    assert statistics.loss_percent[1] > 0


def test_beam_and_perfect_beam_are_chosen_from_the_bands_at_the_begin_of_the_cycle(
        make, scenario, truth, estimate):
    for band, bands in ((-1, (0, 1)), (0, (0,)), (1, (1,))):
        role = make(TransmissionSettings(band))
        ((beam,),) = feed(role, [estimate])
        assert role.handle(SettingsOffered(TransmissionSettings(5)), 0.0) == [
            LogMessage("settings applied: band '5'")]
        assert role.status()['parameter.band'] == '5'
        moved = dataclasses.replace(estimate, position=estimate.position + 0.1)
        (other,), *_, (report, _) = feed(role, [moved, truth, configured(beam), Timeout()])
        assert {beam.band, other.band} <= {*bands}
        assert report.perfect_bps == pytest.approx(max(
            capacity(scenario, steer(scenario, PLACE, b), PLACE[None])[0] for b in bands))
    role.handle(SettingsOffered(TransmissionSettings(0)), 0.0)
    ((new,),) = feed(role, [dataclasses.replace(estimate, cycle_id=4)])
    assert (new.cycle_id, new.band) == (4, 0)


# The time of a report


def test_a_report_waits_for_a_true_position_that_is_late(transmission, truth, beam):
    transmission.handle(configured(beam), 1.0)
    # Without it, the report is due after a quarter of a second.
    assert transmission.next_deadline() == pytest.approx(1.25)
    transmission.handle(truth, 1.1)
    assert 1.1 < transmission.next_deadline() < 1.2
    report, _ = (action.message for action in transmission.handle(Timeout(), 1.2))
    assert math.isfinite(report.loss_percent)
    assert transmission.next_deadline() is None


def test_a_report_without_a_true_position_does_not_delay_the_next(
        transmission, truth, beam, estimate):
    ((later,),) = feed(transmission, [dataclasses.replace(estimate, cycle_id=4)])
    truth = dataclasses.replace(truth, cycle_id=4)
    for n, event in enumerate((configured(beam), configured(later), truth)):
        transmission.handle(event, 2 + 0.001 * n)
    assert transmission.next_deadline() < 2.1
    reports = [transmission.handle(Timeout(), now_s)[0].message for now_s in (2.1, 2.3)]
    assert [report.cycle_id for report in reports] == [4, 3]
    assert [math.isfinite(report.actual_bps) for report in reports] == [True, False]


def test_a_report_waits_until_no_message_of_a_cycle_arrives_but_not_for_ever(
        transmission, beam, truth):
    """The beam of the next cycle is not delayed by the report of the last one."""
    transmission.handle(truth, 0.1)
    assert transmission.next_deadline() is None
    for _ in range(2):
        assert transmission.handle(configured(beam), 0.2) == []
    assert transmission.next_deadline() == pytest.approx(0.205)
    for n in range(1, 100):
        transmission.handle(truth, 0.2 + n * 4e-3)
        assert transmission.next_deadline() == pytest.approx(0.2 + min(n * 4e-3 + 5e-3, 0.25))
    assert len(transmission.handle(Timeout(), 0.605)) == 2
    # The next report waits for messages that arrived during this one.
    assert transmission.next_deadline() == pytest.approx(0.45)
    assert len(transmission.handle(Timeout(), 0.61)) == 1


def test_every_report_is_sent(transmission, beam):
    """When too many wait, the oldest one is computed at once."""
    sent = [transmission.handle(configured(beam), 0.0) for _ in range(20)]
    while transmission.next_deadline() is not None:
        sent.append(transmission.handle(Timeout(), 1.0))
    assert sum(len(actions) for actions in sent) == 20
