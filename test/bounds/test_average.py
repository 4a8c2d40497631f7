"""The average bound and its gradients."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb, average_crlb, crlb
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, MultipathEstimate, Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.hall import CONDITIONS, FIELDS
from rhs_isac_ros.model.impairments import BUILT_IN
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.model.surface import AppliedBeams


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


def test_bound_and_gradients_match_the_vectors(case):
    outcome = average_crlb(case.scenario, case.codebook, case.vectors['positions'])
    assert type(outcome.value) is float
    assert_matches_vectors(outcome, case.vectors)
    value = AverageCrlb(case.scenario, case.vectors['positions']).value(case.codebook)
    assert type(value) is float
    assert value == pytest.approx(float(case.vectors['average_crlb']), rel=1e-8)


@pytest.mark.parametrize('tolerance', [1e-7, 1e-6, 1e-5, 1e-4])
def test_compressed_rows_match_the_vectors_to_a_multiple_of_the_tolerance(case, tolerance):
    """The bound depends most on directions with little information, which amplifies errors."""
    average = AverageCrlb(case.scenario, case.vectors['positions'], tolerance)
    assert_matches_vectors(average(case.codebook), case.vectors, 2000 * tolerance, 50 * tolerance)


# N_B, N_SB, F, K, elements along a side.
SIZES = [(1, 3, 2, 2, 3), (2, 2, 3, 1, 3), (3, 1, 2, 3, 2), (2, 2, 1, 2, 4), (1, 1, 4, 3, 4)]


@pytest.mark.slow
@pytest.mark.parametrize('tolerance', [0, 1e-7], ids=['exact', 'compressed'])
@pytest.mark.parametrize('sizes', SIZES)
def test_gradients_are_the_limit_of_differences_of_plain_bounds(
        sizes, tolerance, plain, random_beams, assert_gradients):
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

    value, *gradients = AverageCrlb(scenario, positions, tolerance)(codebook)
    assert value == pytest.approx(bound(codebook.analog, codebook.digital), rel=1e-7)
    # The weights of a single feed have little effect compared with rounding in the bound.
    assert_gradients(gradients, bound, codebook, rng, slack=1e-6 * value)


def test_the_bound_is_the_mean_of_the_bounds_of_many_positions(small):
    """They make several blocks."""
    positions = small.scenario.sample_positions(300, np.random.default_rng(0))
    expected = crlb(small.scenario, small.codebook, positions).mean()
    for tolerance, allowed in ((0, 1e-9), (1e-7, 5e-6)):
        average = AverageCrlb(small.scenario, positions, tolerance)
        assert average(small.codebook).value == pytest.approx(expected, rel=allowed)


@pytest.mark.parametrize('tolerance', [0, 1e-5], ids=['exact', 'compressed'])
def test_singular_information_is_infinite_and_flat_without_a_warning(small, tolerance):
    dark = Codebook(np.zeros((1, 2, 16)), small.codebook.digital)
    average = AverageCrlb(small.scenario, small.vectors['positions'], tolerance)
    value, by_analog, by_digital = average(dark)
    assert value == average.value(dark) == np.inf
    np.testing.assert_array_equal(by_analog, 0)
    np.testing.assert_array_equal(by_digital, 0)


def test_an_average_over_no_positions_is_an_error(small):
    for call in (lambda empty: average_crlb(small.scenario, small.codebook, empty),
                 lambda empty: AverageCrlb(small.scenario, empty, 1e-3)):
        with pytest.raises(ValueError, match='^positions: .*, expected '):
            call(np.zeros((0, 3)))


FACTORS = tuple(one.field for one in BUILT_IN)
ERRORS = 'element_error_rms', 'failed_element_share'


@pytest.mark.parametrize('region_prior', [False, True])
@pytest.mark.parametrize('tolerance', [0, 1e-7], ids=['exact', 'compressed'])
@pytest.mark.parametrize('absent', [(*FACTORS, *ERRORS), ERRORS, FACTORS, ()],
                         ids=['none', 'nuisance', 'errors', 'all'])
def test_with_impairments_average_and_gradients_are_those_of_the_bound(
        uncertain, uncertain_codebook, absent, tolerance, region_prior, assert_gradients):
    codebook = uncertain_codebook
    scenario = dataclasses.replace(uncertain, **dict.fromkeys(absent, 0.0))
    positions = scenario.sample_positions(3, np.random.default_rng(2))
    average = AverageCrlb(scenario, positions, tolerance, region_prior=region_prior)
    value, *gradients = average(codebook)
    assert average.value(codebook) == pytest.approx(value, rel=1e-12)
    expected = crlb(scenario, codebook, positions, region_prior=region_prior).mean()
    assert value == pytest.approx(expected, rel=1e-5)
    assert_gradients(gradients, lambda **parts: average.value(AppliedBeams(**parts)), codebook,
                     np.random.default_rng(3))


@pytest.fixture(scope='module')
def odd(random_beams):
    scenario = Scenario(
        center_frequencies_hz=(1.9e9, 3.3e9), n_subbands=3, n_frames=2, n_feeds=4,
        elements_per_side=3, subband_width_hz=2e7)
    return scenario, random_beams(scenario, np.random.default_rng(0))


SCENARIO = Scenario(elements_per_side=4, n_feeds=2, element_error_rms=0.1)
N_ELEMENTS = SCENARIO.n_elements


@pytest.fixture
def average():
    """The average bound for a surface with complex coefficients, failures and band gains."""
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(2, N_ELEMENTS, 2)) @ [1, 1j]
    failed = np.arange(N_ELEMENTS) % 7 == 0
    average = AverageCrlb(SCENARIO, SCENARIO.sample_positions(10, rng))
    average.surface = SurfaceEstimate(
        np.where(failed, 0, 1 + 0.3 * numbers[0]), np.where(failed, 0.5 + 0.1 * numbers[1], 0),
        np.array([1.2 + 0.3j, 0.8 - 0.1j]),
        0.1 * np.ones((2 * N_ELEMENTS + 2, 1), complex), failed.astype(float))
    return average


def test_gradients_for_an_estimated_surface_are_slopes(average, random_beams, assert_gradients):
    beams = random_beams(SCENARIO, np.random.default_rng(1))
    value, *gradients = average(beams)
    assert value == pytest.approx(average.value(beams), rel=1e-12)
    assert_gradients(gradients, lambda **parts: average.value(AppliedBeams(**parts)), beams,
                     np.random.default_rng(2))


def test_gradients_under_a_measured_covariance_are_slopes(odd, random_beams, assert_gradients):
    scenario, codebook = odd
    places = scenario.sample_positions(4, np.random.default_rng(4))
    hall = dataclasses.replace(scenario, angular_spread_deg=40.0, delay_spread_s=2e-8)
    other = random_beams(scenario, np.random.default_rng(5))
    declared, fields = MeasurementModel(scenario, other), scenario.fields()
    inverse = np.linalg.inv(declared.covariance())
    difference = MeasurementModel(hall, other).covariance() - declared.covariance()
    measured = dataclasses.replace(scenario, multipath=MultipathEstimate(
        *(fields[name] for name in FIELDS), np.array(declared.radiation),
        inverse @ difference @ inverse, {name: fields[name] for name in CONDITIONS}))
    cost = AverageCrlb(measured, places)
    value, *gradients = cost(codebook)
    assert value == pytest.approx(np.mean(crlb(measured, codebook, places)))
    assert abs(value / AverageCrlb(scenario, places).value(codebook) - 1) > 0.01
    assert_gradients(gradients, lambda **parts: cost.value(AppliedBeams(**parts)), codebook,
                     np.random.default_rng(6))
