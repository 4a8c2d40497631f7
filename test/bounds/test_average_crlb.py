"""The average bound and its gradients."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb, average_crlb, crlb, measurement_rows
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import multipath_covariance


def assert_matches_vectors(outcome, vectors, tolerance=1e-8, value_tolerance=1e-8):
    value, by_analog, by_digital = outcome
    assert value == pytest.approx(float(vectors['average_crlb']), rel=value_tolerance)
    for actual, expected in ((by_analog, vectors['grad_analog']),
                             (by_digital, vectors['grad_digital'])):
        assert actual.shape == expected.shape
        assert actual.dtype == expected.dtype
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            actual, expected, rtol=tolerance, atol=tolerance * scale)


def test_value_and_gradients_match_the_vectors(case):
    outcome = average_crlb(case.scenario, case.codebook, case.vectors['positions'])
    assert type(outcome.value) is float
    assert_matches_vectors(outcome, case.vectors)
    value = AverageCrlb(case.scenario, case.vectors['positions']).value(case.codebook)
    assert type(value) is float
    assert value == pytest.approx(float(case.vectors['average_crlb']), rel=1e-8)


def test_evaluations_are_repeatable(case):
    average = AverageCrlb(case.scenario, case.vectors['positions'])
    for _ in range(2):
        assert_matches_vectors(average(case.codebook), case.vectors)


def test_result_does_not_depend_on_the_blocks(case, monkeypatch):
    monkeypatch.setattr(measurement_rows, '_BLOCK', 4)
    assert_matches_vectors(
        average_crlb(case.scenario, case.codebook, case.vectors['positions']), case.vectors)


@pytest.mark.parametrize('tolerance', [1e-7, 1e-6, 1e-5, 1e-4])
def test_compressed_rows_match_the_vectors_to_a_multiple_of_the_tolerance(case, tolerance):
    """The bound depends most on directions with little information, which amplifies errors."""
    average = AverageCrlb(case.scenario, case.vectors['positions'], tolerance)
    assert_matches_vectors(average(case.codebook), case.vectors, 2000 * tolerance, 50 * tolerance)


# N_B, N_SB, F, K, elements along a side.
SIZES = [(1, 3, 2, 2, 3), (2, 2, 3, 1, 3), (3, 1, 2, 3, 2), (2, 2, 1, 2, 4), (1, 1, 4, 3, 4)]


@pytest.mark.parametrize('tolerance', [0, 1e-7], ids=['exact', 'compressed'])
@pytest.mark.parametrize('sizes', SIZES)
def test_gradients_are_the_limit_of_differences_of_plain_bounds(
        sizes, tolerance, plain, random_beams):
    n_bands, n_subbands, n_frames, n_feeds, side = sizes
    rng = np.random.default_rng(SIZES.index(sizes))
    scenario = Scenario(
        center_frequencies_hz=tuple(rng.uniform(1e9, 4e9, n_bands)), n_subbands=n_subbands,
        n_frames=n_frames, n_feeds=n_feeds, elements_per_side=side, subband_width_hz=3e5,
        frame_duration_s=2e-3, roi_center_m=(3, 0, 0), roi_size_m=(2, 3, 2))
    codebook = random_beams(scenario, rng)
    spatial = multipath_covariance(scenario)
    positions = scenario.sample_positions(2, rng)

    def bound(analog, digital):
        return plain(scenario, analog, digital).crlb(positions, spatial).mean()

    value, by_analog, by_digital = AverageCrlb(scenario, positions, tolerance)(codebook)
    analog, digital = codebook.analog, codebook.digital
    assert value == pytest.approx(bound(analog, digital), rel=1e-7)
    size, scale, step = np.linalg.norm(analog), np.linalg.norm(digital), 1e-5
    # The weights of a single feed have little effect compared with rounding in the bound.
    slack = 1e-6 * value
    for _ in range(2):
        way = rng.normal(size=analog.shape)
        way *= size / np.linalg.norm(way)
        difference = (bound(analog + step * way, digital) - bound(analog - step * way, digital))
        assert np.sum(by_analog * way) == pytest.approx(
            difference / (2 * step), abs=slack + 1e-6 * np.linalg.norm(by_analog) * size)
        way = rng.normal(size=(*digital.shape, 2)) @ [1, 1j]
        way *= scale / np.linalg.norm(way)
        difference = (bound(analog, digital + step * way) - bound(analog, digital - step * way))
        assert np.sum(by_digital.conj() * way).real == pytest.approx(
            difference / (2 * step), abs=slack + 1e-6 * np.linalg.norm(by_digital) * scale)


def test_value_is_the_mean_over_the_positions(small):
    """The vectors contain the bound of every position."""
    average = AverageCrlb(small.scenario, small.vectors['positions'][[4, 1, 1]])
    expected = small.vectors['crlb'][[4, 1, 1]].mean()
    assert average(small.codebook).value == pytest.approx(expected, rel=1e-8)
    assert average.value(small.codebook) == pytest.approx(expected, rel=1e-8)


def test_value_is_the_mean_of_the_bounds_of_many_positions(small):
    positions = small.scenario.sample_positions(300, np.random.default_rng(0))
    expected = crlb(small.scenario, small.codebook, positions).mean()
    for tolerance, allowed in ((0, 1e-9), (1e-7, 5e-6)):
        average = AverageCrlb(small.scenario, positions, tolerance)
        assert average(small.codebook).value == pytest.approx(expected, rel=allowed)


def test_the_value_does_not_depend_on_a_common_phase_of_a_frame(small):
    """Noise and multipath are circular, so the gradient has no component along the phase."""
    value, _, by_digital = average_crlb(
        small.scenario, small.codebook, small.vectors['positions'])
    turned = dataclasses.replace(
        small.codebook, digital=small.codebook.digital * np.exp(0.7j))
    assert average_crlb(small.scenario, turned, small.vectors['positions']).value == pytest.approx(
        value, rel=1e-9)
    along = np.sum(by_digital.conj() * 1j * small.codebook.digital, axis=(1, 3)).real
    assert np.abs(along).max() < 1e-7 * value


@pytest.mark.parametrize('tolerance', [0, 1e-5], ids=['exact', 'compressed'])
def test_singular_information_is_infinite_and_flat_without_a_warning(small, tolerance):
    dark = Codebook(np.zeros((1, 2, 16)), small.codebook.digital)
    average = AverageCrlb(small.scenario, small.vectors['positions'], tolerance)
    value, by_analog, by_digital = average(dark)
    assert value == average.value(dark) == np.inf
    np.testing.assert_array_equal(by_analog, 0)
    np.testing.assert_array_equal(by_digital, 0)


@pytest.mark.parametrize('positions', [
    np.zeros((0, 3)), [10.0, 0.0, 0.0], [[10.0, 0.0]], [[np.nan, 0.0, 0.0]]])
def test_malformed_positions_are_errors(small, positions):
    with pytest.raises(ValueError, match='^positions: .*, expected '):
        average_crlb(small.scenario, small.codebook, np.array(positions))
    with pytest.raises(ValueError, match='^positions: .*, expected '):
        AverageCrlb(small.scenario, np.array(positions), 1e-3)


@pytest.mark.parametrize('tolerance', [1e-8, -1e-3, np.nan])
def test_a_tolerance_out_of_range_is_an_error(small, tolerance):
    with pytest.raises(ValueError, match='^tolerance: .*, expected 1e-07 to 1'):
        AverageCrlb(small.scenario, small.vectors['positions'], tolerance)
