"""Steering: constraints and quality of the beam, the choice of the band, and the loss."""

import dataclasses
import math

import numpy as np
import pytest

from rhs_isac_ros.calibration import known_states
from rhs_isac_ros.link import (
    Beamformer,
    CapacityReport,
    applied_beam,
    band_link,
    candidates,
    capacity,
    capacity_report,
    choose_beam,
    expected_capacities,
    prepare_steering,
    steer,
    steering,
)
from rhs_isac_ros.link.steering import steer_bands
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.surface import on_levels

POSITION = np.array([9.0, 1.5, -0.4])


@pytest.fixture(scope='module')
def positions(table1):
    """Random positions and two corners of Table I's region."""
    scenario = table1.scenario
    return [*scenario.sample_positions(4, np.random.default_rng(0)), *scenario.roi_bounds_m]


def rate(scenario, beam, position):
    return capacity(scenario, beam, np.asarray(position)[None])[0]


def assert_valid(scenario, beam, band=0):
    assert beam.band == band
    assert beam.analog.shape == (scenario.n_elements,)
    assert beam.digital.shape == (scenario.n_subbands, scenario.n_feeds)
    assert beam.analog.min() >= 0
    assert beam.analog.max() <= 1
    assert np.sum(np.abs(beam.digital)**2) == pytest.approx(scenario.max_power_w, rel=1e-9)


@pytest.mark.parametrize('band', [0, 1])
def test_beams_satisfy_the_constraints(table1, positions, band):
    for position in positions:
        assert_valid(table1.scenario, steer(table1.scenario, position, band), band)


@pytest.mark.parametrize('levels', [0, 2, 3])
def test_amplitudes_are_among_any_number_of_levels(small, levels):
    scenario = dataclasses.replace(small.scenario, amplitude_levels=levels)
    for position in scenario.sample_positions(5, np.random.default_rng(6)):
        analog = steer(scenario, position).analog
        assert set(analog) <= {0.0, 1.0}
        np.testing.assert_array_equal(on_levels(scenario, analog), analog)


def test_the_beams_of_all_bands_are_those_of_each_one(table1, positions):
    for position in positions:
        for band, beam in enumerate(steer_bands(table1.scenario, position, range(2))):
            alone = steer(table1.scenario, position, band)
            np.testing.assert_array_equal(beam.analog, alone.analog)
            np.testing.assert_array_equal(beam.digital, alone.digital)


def test_no_beam_waits_for_tables_after_the_preparation(small):
    scenario = dataclasses.replace(small.scenario, max_power_w=0.0123)
    prepare_steering(scenario)
    caches = candidates.tables, band_link.arrays, band_link.representative_subbands
    before = [cache.cache_info().misses for cache in caches]
    choose_beam(scenario, scenario.sample_positions(1, np.random.default_rng(0))[0], np.eye(3))
    assert [cache.cache_info().misses for cache in caches] == before


def test_a_beam_of_a_small_surface_is_close_to_the_optimum(small, reference_link):
    """The optimum is a corner of the box; water-filling divides the power evenly here."""
    scenario, link = small.scenario, reference_link(small)
    corners = (np.arange(1, 2**16)[:, None] >> np.arange(16) & 1).astype(float)
    for position in scenario.sample_positions(1, np.random.default_rng(4)):
        rates = 0
        for onboard, los in zip(link.onboard, link.los(position), strict=True):
            configured = onboard * corners[:, None]
            direct = configured @ los
            channels = direct[:, :, None] * direct[:, None].conj()
            channels += configured @ link.spatial @ np.swapaxes(configured.conj(), 1, 2)
            shares = scenario.max_power_w / scenario.n_subbands / link.noise
            rates = rates + np.log2(1 + np.linalg.eigvalsh(channels)[:, -1] * shares)
        best = rate(scenario, link.best_beam(corners[rates.argmax()], position), position)
        found = rate(scenario, steer(scenario, position), position)
        assert 0.999 * best < found <= best * (1 + 1e-9)


@pytest.mark.parametrize('band', [-1, 1, 7, 0.0])
def test_steering_in_a_band_out_of_range_is_an_error(small, band):
    with pytest.raises(ValueError, match=f'band: {band}, expected (an integer, )?0 to 0'):
        steer(small.scenario, (9.0, 0.0, 0.0), band)


def test_the_choice_is_the_best_band_steered_to_the_mean(table1):
    scenario, covariance = table1.scenario, np.diag([0.8, 0.1, 0.02])
    choice = choose_beam(scenario, POSITION, covariance)
    expected = []
    for band in range(scenario.n_bands):
        beam = steer(scenario, POSITION, band)
        expected += expected_capacities(scenario, [beam], POSITION, covariance).tolist()
    assert choice.expected_bps == max(expected)
    assert choice.beam.band == np.argmax(expected)
    best = steer(scenario, POSITION, choice.beam.band)
    np.testing.assert_array_equal(choice.beam.analog, best.analog)
    np.testing.assert_array_equal(choice.beam.digital, best.digital)


def test_an_uncertain_position_may_change_the_band():
    """Two bands are nearly equal: the beam that is best at the mean loses more around it."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.6e9), n_subbands=1, n_feeds=2, elements_per_side=6)
    mean, covariance = np.array([6.9, 3.6, 0.1]), np.diag([0.25, 4.0, 0.25])
    at_mean = [capacity(scenario, steer(scenario, mean, band), mean[None])[0] for band in (0, 1)]
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, 20000)
    draws[:, 0] = np.maximum(draws[:, 0], scenario.roi_bounds_m[0][0])
    averaged = [capacity(scenario, steer(scenario, mean, band), draws).mean() for band in (0, 1)]
    assert np.argmax(at_mean) != np.argmax(averaged)
    assert choose_beam(scenario, mean).beam.band == np.argmax(at_mean)
    assert choose_beam(scenario, mean, covariance).beam.band == np.argmax(averaged)


def test_the_first_of_equal_bands_is_chosen(table1):
    silent = SurfaceEstimate(
        np.zeros(100), np.zeros(100), np.ones(2), np.zeros((202, 0)), np.zeros(100))
    for bands in ([0, 1], [1, 0]):
        choice = choose_beam(table1.scenario, POSITION, np.eye(3), bands, silent)
        assert (choice.beam.band, choice.expected_bps) == (bands[0], 0)


def test_choosing_from_no_band_is_an_error(table1):
    with pytest.raises(ValueError, match='bands: none, expected at least one'):
        choose_beam(table1.scenario, POSITION, np.eye(3), [])


@pytest.mark.parametrize('band', [0, 1])
def test_capacities_of_the_outcome_match_the_reference(table1, reference_link, band):
    scenario, link = table1.scenario, reference_link(table1, band)
    used = steer(scenario, POSITION + [0.5, 0.6, 0.0], band)
    found = capacity_report(scenario, used, POSITION, [band])
    assert found.actual_bps == pytest.approx(link.capacity(used, POSITION), rel=1e-6)
    assert found.perfect_bps == pytest.approx(
        link.capacity(steer(scenario, POSITION, band), POSITION), rel=1e-6)
    assert found.loss_bps == found.perfect_bps - found.actual_bps > 0
    best = choose_beam(scenario, POSITION).beam
    assert capacity_report(scenario, used, POSITION).perfect_bps == pytest.approx(
        capacity(scenario, best, POSITION[None])[0])
    assert found.loss_percent == pytest.approx(100 * (1 - found.actual_bps / found.perfect_bps))


def test_the_relative_loss_of_no_capacity_is_nan():
    assert math.isnan(CapacityReport(0.0, 0.0).loss_percent)
    assert math.isnan(CapacityReport(math.nan, math.nan).loss_percent)


@pytest.fixture(scope='module')
def damaged(table1):
    """A surface with errors, offsets and three failed elements, as an exact estimate."""
    scenario, rng = table1.scenario, np.random.default_rng(0)
    failed = np.zeros(scenario.n_elements, bool)
    failed[[3, 44, 90]] = True
    gains = 1 + 0.2 * rng.normal(size=(scenario.n_elements, 2)) @ [1, 1j]
    return SurfaceEstimate(
        np.where(failed, 0, gains), np.where(failed, 0.8 * gains, 0.3 - 0.2j),
        np.array([0.9, 1.1j]), np.zeros((2 * scenario.n_elements + 2, 0), complex),
        failed.astype(float))


def test_a_beam_for_a_calibrated_surface_has_the_capacity_of_the_search(table1, damaged):
    """No other configuration of one element increases it, and an uncalibrated beam has less."""
    scenario = table1.scenario
    beam = steer(scenario, POSITION, 0, damaged)
    best = capacity(scenario, applied_beam(beam, damaged), POSITION[None])[0]
    plain = steer(scenario, POSITION)
    assert capacity(scenario, applied_beam(plain, damaged), POSITION[None])[0] < best
    for element in range(scenario.n_elements):
        changed = beam.analog.copy()
        changed[element] = 1 - changed[element]
        other = applied_beam(Beamformer(changed, beam.digital), damaged)
        change = capacity(scenario, other, POSITION[None])[0] - best
        # A failed element does not follow.
        assert change == 0 if damaged.failed[element] else change < 0


@pytest.mark.parametrize('states', [(1, -1), (0.9, 1), (0.2, 0.9j)])
def test_two_states_of_a_board_have_the_beams_of_the_same_states_of_a_calibration(table1, states):
    board = {'kind': 'states', 'states': [[complex(s).real, complex(s).imag] for s in states]}
    same = dataclasses.replace(table1.scenario, board=board, amplitude_levels=2)
    expected = steer(table1.scenario, POSITION, 1, known_states(table1.scenario, *states).surface)
    found = steer(same, POSITION, 1)
    np.testing.assert_array_equal(found.analog, expected.analog)
    np.testing.assert_allclose(found.digital, expected.digital, rtol=1e-9)


def test_a_report_is_about_the_calibrated_surface(table1, damaged):
    scenario = table1.scenario
    choice = choose_beam(scenario, POSITION, surface=damaged)
    report = capacity_report(scenario, choice.beam, POSITION, surface=damaged)
    assert report.actual_bps == report.perfect_bps == choice.expected_bps
    assert capacity_report(scenario, choice.beam, POSITION).actual_bps != report.actual_bps


def test_the_best_beam_of_a_user_at_rest_is_found_once(monkeypatch):
    """The report of each cycle compares with the same beam."""
    calls = []
    monkeypatch.setattr(steering, 'choose_beam', lambda *args, **options: (
        calls.append(args[1].tolist()), choose_beam(*args, **options))[1])
    scenario = Scenario(element_gain=2.0)
    beam = steer(scenario, POSITION)
    first, again, moved = (capacity_report(scenario, beam, place, [0]) for place in (
        POSITION, POSITION, POSITION + 0.1))
    assert calls == [POSITION.tolist(), (POSITION + 0.1).tolist()]
    assert first == again != moved
