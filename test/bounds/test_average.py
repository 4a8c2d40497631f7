"""Averages of losses of quadratic forms, and the average bound."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb, average_crlb, crlb
from rhs_isac_ros.bounds.average import Average, Gradient
from rhs_isac_ros.bounds.rows import RowSource
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.impairments import BUILT_IN
from rhs_isac_ros.model.multipath import multipath_covariance

N_ITEMS = 7


def complex_array(rng, *shape):
    return rng.normal(size=(*shape, 2)) @ [1, 1j]


@pytest.fixture(scope='module')
def faded(random_beams):
    """Two bands whose sub-bands and frames are far from fully correlated."""
    scenario = Scenario(
        center_frequencies_hz=(1.2e9, 3.1e9), n_subbands=3, n_frames=2, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-3, noise_psd_dbm_hz=-70,
        roi_center_m=(3, 0, 0), roi_size_m=(2, 4, 2))
    return scenario, random_beams(scenario, np.random.default_rng(0))


@pytest.fixture(scope='module', params=[1, 2, 3], ids='{} rows'.format)
def items(request):
    """Random rows, complex [N_ITEMS, G, N_B, N_SB, N_E]."""
    return 1e-4 * complex_array(np.random.default_rng(request.param), N_ITEMS, request.param,
                                2, 3, 9)


def make(scenario, items, loss, tolerance=0.0, **options):
    return Average(RowSource(
        scenario, lambda block, band: items[block, :, band], N_ITEMS, items.shape[1], **options),
        loss, tolerance)


def plain_forms(p, items, spatial):
    """The forms [N_ITEMS, G, G] by their definition."""
    n_items, n_rows, n_bands = items.shape[:3]
    forms = np.zeros((n_items, n_rows, n_rows))
    for i in range(n_bands):
        pattern, inverse = p.pattern(i), np.linalg.inv(p.covariance(i, spatial[i]))
        means = np.stack([items[:, :, i, j] @ pattern[r] for r, (j, _) in enumerate(p.rows)], -1)
        for n, u, v in np.ndindex(forms.shape):
            forms[n, u, v] += 2 * (means[n, u].conj() @ inverse @ means[n, v]).real
    return forms


@pytest.fixture(scope='module')
def loss(items):
    """Product of the form and a matrix of the item, plus log(1 + trace)."""
    roots = np.random.default_rng(4).normal(size=(N_ITEMS, *[items.shape[1]] * 2))
    matrices = roots + np.swapaxes(roots, 1, 2)

    def of(block, forms):
        traces = np.trace(forms, axis1=1, axis2=2)
        values = np.sum(matrices[block] * forms, axis=(1, 2)) + np.log(1 + traces)
        slopes = matrices[block] + np.eye(forms.shape[1]) / (1 + traces)[:, None, None]
        return values, -slopes
    return of


@pytest.fixture(scope='module')
def plain_average(faded, items, loss, plain):
    scenario, _ = faded
    spatial = multipath_covariance(scenario)

    def of(analog, digital):
        forms = plain_forms(plain(scenario, analog, digital), items, spatial)
        return loss(slice(None), forms)[0].mean()
    return of


def assert_is(outcome, expected, tolerance):
    for actual, wanted in zip(outcome, expected, strict=True):
        np.testing.assert_allclose(
            actual, wanted, rtol=0, atol=tolerance * np.abs(wanted).max())


@pytest.mark.parametrize('tolerance', [0, 1e-7], ids=['exact', 'compressed'])
def test_gradients_are_the_limit_of_differences_of_the_plain_average(
        faded, items, loss, plain_average, tolerance, assert_gradients):
    scenario, codebook = faded
    outcome = make(scenario, items, loss, tolerance)(codebook)
    assert isinstance(outcome, Gradient)
    assert type(outcome.value) is float
    assert outcome.value == pytest.approx(
        plain_average(codebook.analog, codebook.digital), rel=1e-6)
    assert_gradients(outcome[1:], plain_average, codebook, np.random.default_rng(5))


@pytest.mark.parametrize('tolerance', [0, 1e-5], ids=['exact', 'compressed'])
def test_value_alone_equals_the_value_with_gradients(faded, items, loss, tolerance):
    scenario, codebook = faded
    average = make(scenario, items, loss, tolerance)
    value = average.value(codebook)
    assert type(value) is float
    assert value == pytest.approx(average(codebook).value, rel=1e-13)
    assert value == pytest.approx(average.value(codebook), rel=1e-13)


@pytest.mark.parametrize('tolerance', [0, 1e-7], ids=['exact', 'compressed'])
@pytest.mark.parametrize('size', [1, 3, 7])
def test_results_do_not_depend_on_the_blocks(
        faded, items, loss, tolerance, size):
    """The last block is shorter, of equal size, or the only one; the loss depends on the item."""
    scenario, codebook = faded
    expected = make(scenario, items, loss)(codebook)
    average = make(scenario, items, loss, tolerance, block=size)
    assert len(average.rows.blocks()) == -(-N_ITEMS // (size * max(3 // items.shape[1], 1)))
    assert_is(average(codebook), expected, max(1e-12, 10 * tolerance))
    assert average.value(codebook) == pytest.approx(expected.value, rel=max(1e-12, 10 * tolerance))


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
        uncertain, uncertain_codebook, absent, tolerance, region_prior):
    codebook = uncertain_codebook
    scenario = dataclasses.replace(uncertain, **dict.fromkeys(absent, 0.0))
    positions = scenario.sample_positions(3, np.random.default_rng(2))
    average = AverageCrlb(scenario, positions, tolerance, region_prior=region_prior)
    value, by_analog, by_digital = average(codebook)
    assert average.value(codebook) == pytest.approx(value, rel=1e-12)

    def bound(analog, digital):
        return crlb(scenario, Codebook(analog, digital), positions,
                    region_prior=region_prior).mean()

    assert value == pytest.approx(bound(codebook.analog, codebook.digital), rel=1e-5)
    rng, step = np.random.default_rng(3), 1e-5
    for _ in range(3):
        analog = rng.normal(size=by_analog.shape)
        digital = rng.normal(size=(*by_digital.shape, 2)) @ [1, 1j] * np.abs(codebook.digital)
        ahead, behind = (bound(np.clip(codebook.analog + sign * step * analog, 0, 1),
                               codebook.digital + sign * step * digital) for sign in (1, -1))
        expected = np.sum(by_analog * analog) + np.sum(np.conj(by_digital) * digital).real
        assert (ahead - behind) / (2 * step) == pytest.approx(expected, rel=2e-4)
