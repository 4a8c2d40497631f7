"""Choice of the bands: the raster, the screening, and its comparison with an exhaustive search."""

import dataclasses
import itertools

import numpy as np
import pytest

from rhs_isac_ros.bounds.range_ambiguity import range_confusion_error
from rhs_isac_ros.codebook import band_plan, optimize
from rhs_isac_ros.model import Scenario

SPECTRUM = [(2.5e9, 2.7e9)]
SHORT = band_plan.EFFORT._replace(short_positions=4, short_steps=3, short_shots=8, shots=8)


@pytest.fixture
def small():
    """Two bands with four frames each."""
    return Scenario(n_subbands=2, n_feeds=2, elements_per_side=3, max_power_w=0.02,
                    roi_center_m=(4, 0, 0), roi_size_m=(4, 4, 2))


def test_the_raster_begins_at_the_low_end_of_each_interval():
    np.testing.assert_allclose(
        band_plan.raster([(2.5e9, 2.6e9), (1.0e9, 1.0e9), (2.59e9, 2.66e9)], 50e6),
        [1.0e9, 2.5e9, 2.55e9, 2.59e9, 2.6e9, 2.64e9])
    # 0.3 / 0.1 is less than 3 in floating-point numbers.
    assert len(band_plan.raster([(0.1, 0.4)], 0.1)) == 4


@pytest.mark.parametrize(('spectrum', 'spacing', 'message'), [
    ([], 1e6, '^spectrum: no interval'), ([(2e9, 1e9)], 1e6, '^spectrum: 2e.09:1e.09, '),
    ([(0.0, 1e9)], 1e6, '^spectrum: '), ([(1e9, np.inf)], 1e6, '^spectrum: '),
    (SPECTRUM, 0.0, '^raster: 0 Hz'), (SPECTRUM, np.nan, '^raster: nan Hz')])
def test_invalid_intervals_and_rasters_are_errors(spectrum, spacing, message):
    with pytest.raises(ValueError, match=message):
        band_plan.raster(spectrum, spacing)


def errors(plans):
    return range_confusion_error(plans, np.array([50.0, 200.0]), 12.0)


@pytest.mark.slow
@pytest.mark.parametrize('n_bands', [2, 3, 4])
@pytest.mark.parametrize('seed', range(2))
def test_the_coordinate_search_finds_the_best_plan_of_a_small_raster(n_bands, seed, monkeypatch):
    frequencies, gap = band_plan.raster([(2.5e9, 2.8e9)], 20e6), 20e6
    every, values = band_plan.screen(frequencies, n_bands, gap, errors, np.random.default_rng(0))
    assert len(every) == len(list(itertools.combinations(frequencies, n_bands)))
    monkeypatch.setattr('rhs_isac_ros.codebook.band_plan.MAX_EXHAUSTIVE', 0)
    found, found_values = band_plan.screen(
        frequencies, n_bands, gap, errors, np.random.default_rng(seed))
    assert len(found) < len(every)
    assert found_values.min() <= 1.05 * values.min()
    np.testing.assert_allclose(errors(found), found_values, rtol=0.01)


@pytest.mark.parametrize('max_exhaustive', [0, 10**6])
def test_all_plans_keep_the_gap_and_the_raster(max_exhaustive, monkeypatch):
    monkeypatch.setattr('rhs_isac_ros.codebook.band_plan.MAX_EXHAUSTIVE', max_exhaustive)
    frequencies, gap = band_plan.raster([(2.5e9, 2.6e9), (2.8e9, 2.9e9)], 10e6), 40e6
    plans, _ = band_plan.screen(frequencies, 3, gap, errors, np.random.default_rng(0))
    assert len(plans)
    assert (np.diff(plans, axis=1) >= gap - 1).all()
    assert np.isin(plans, frequencies).all()


def test_the_number_of_pilots_stays_the_same(small):
    four = band_plan.with_bands(small, (1e9, 2e9, 3e9, 4e9))
    assert (four.n_bands, four.n_frames) == (4, 2)
    assert dataclasses.replace(
        four, center_frequencies_hz=small.center_frequencies_hz, n_frames=4) == small


@pytest.mark.slow
def test_the_candidates_are_sorted_and_reported(small):
    reported = []
    candidates = band_plan.choose_bands(
        small, SPECTRUM, 4, raster_hz=10e6, seed=1, report=reported.append,
        effort=SHORT._replace(candidates=3))
    assert sorted(reported, key=lambda candidate: candidate.error_m2) == list(candidates)
    assert len({candidate.frequencies_hz for candidate in candidates}) == 3
    for one, other in itertools.combinations(candidates, 2):
        assert np.abs(np.subtract(one.frequencies_hz, other.frequencies_hz)).max() >= 40e6 - 1
    for candidate in candidates:
        assert np.isin(candidate.frequencies_hz, band_plan.raster(SPECTRUM, 10e6)).all()
        assert (np.diff(candidate.frequencies_hz) >= 2 * 125e3).all()
        assert candidate.error_m2 > 0


@pytest.mark.slow
def test_a_raster_with_few_plans_has_few_candidates(small):
    (only,) = band_plan.choose_bands(small, [(2.5e9, 2.5e9), (3e9, 3e9)], 2, raster_hz=10e6,
                           effort=SHORT)
    assert only.frequencies_hz == (2.5e9, 3e9)


@pytest.mark.slow
def test_the_result_has_the_lowest_expected_error_up_to_chance(small):
    search = {'objective': 'error', 'max_steps': 2}
    candidates = band_plan.choose_bands(small, SPECTRUM, 2, raster_hz=25e6, seed=1, effort=SHORT)
    plan = band_plan.best_of(small, candidates, search, 1, effort=SHORT)
    plan.result.codebook.check(plan.scenario)
    assert 'objective=error' in plan.result.codebook.provenance
    assert plan.error_m2 == band_plan.expected_error(plan.scenario, plan.result.codebook, 1, 8)
    tried = []
    again = band_plan.best_of(small, plan.candidates, search, 1, tried.append, SHORT)
    least = plan.candidates[0].error_m2
    assert [candidate.frequencies_hz for candidate in tried] == [
        candidate.frequencies_hz for candidate in plan.candidates[:3]
        if candidate.error_m2 <= 1.25 * least]
    # A difference of a few percent may be chance.
    assert 0.95 * plan.error_m2 <= min(candidate.error_m2 for candidate in tried)
    # Equal seeds give equal results.
    assert again.scenario == plan.scenario
    assert again.result.codebook.id == plan.result.codebook.id
    with pytest.raises(ValueError, match='^candidates: none'):
        band_plan.best_of(small, [], {})


@pytest.fixture
def long_region():
    """Equally spaced bands repeat every 1.5 m."""
    return Scenario(n_subbands=2, n_feeds=2, elements_per_side=4, max_power_w=1e-5, n_frames=2,
                    center_frequencies_hz=(2.5e9, 2.7e9, 2.9e9, 3.1e9), roi_center_m=(6, 0, 0),
                    roi_size_m=(6, 2, 1))


@pytest.mark.slow
@pytest.mark.parametrize(('phase_std_rad', 'least', 'most'), [(0.0, 1.5, 100), (6.3, 0.85, 1.15)])
def test_unequal_spacing_pays_only_if_phases_are_known(
        long_region, phase_std_rad, least, most):
    errors = []
    for bands in ((2.5e9, 2.7e9, 2.9e9, 3.1e9), (2.5e9, 2.56e9, 2.72e9, 3.1e9)):
        plan = dataclasses.replace(
            long_region, center_frequencies_hz=bands, band_phase_std_rad=phase_std_rad)
        codebook = optimize(plan, objective='error', n_positions=8, max_steps=15).codebook
        errors.append(band_plan.expected_error(plan, codebook, n_shots=32))
    assert least < errors[0] / errors[1] < most


@pytest.mark.parametrize(('n_bands', 'options', 'message'), [
    (3, {}, '^bands: 3, expected a divisor of 8, '),
    (0, {}, '^bands: 0, '),
    (8, {'raster_hz': 100e6}, '^bands: 8 with gaps of 250000 Hz, .* 3 frequencies'),
    (4, {'min_gap_hz': 80e6}, '^bands: 4 with gaps of 8e.07 Hz')])
def test_what_does_not_fit_is_an_error(small, n_bands, options, message):
    with pytest.raises(ValueError, match=message):
        band_plan.choose_bands(small, SPECTRUM, n_bands, **options)
