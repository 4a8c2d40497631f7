"""Modes of the posterior under sets of failed elements."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.element_error import error_covariance
from rhs_isac_ros.model.imperfections import SurfaceImperfection
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.positioning.failed_elements import can_enumerate
from rhs_isac_ros.positioning.failure_model import FailureModel
from rhs_isac_ros.positioning.polar import jacobian, to_polar
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.positioning.whitened import WhitenedModel

SCENARIO = Scenario(
    center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1), failed_element_share=0.02)
POSITION = np.array([4.2, 0.3, -0.1])


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


def with_failures(elements, levels) -> SurfaceImperfection:
    stuck = np.full(SCENARIO.n_elements, np.nan)
    stuck[list(elements)] = levels
    return SurfaceImperfection(np.ones(SCENARIO.n_elements, complex), stuck)


def test_the_likelihood_has_the_moments_of_surfaces_with_a_given_set(codebook):
    """Value, step and curvature follow from mean and covariance over the amplitudes."""
    failed, point = (3, 17), to_polar(POSITION)
    rng = np.random.default_rng(2)
    received = MeasurementModel(SCENARIO, codebook).sample(POSITION[None], rng)[0]
    intact = dataclasses.replace(SCENARIO, failed_element_share=0.0)
    # Three-point quadrature with the moments of a uniform amplitude.
    nodes = 0.5 + np.array([-1, 0, 1]) / 2
    weights = np.array([1, 4, 1]) / 6
    mean, covariance, slopes = 0.0, 0.0, 0.0
    means, shares = [], []
    for first, one in zip(nodes, weights, strict=True):
        for second, two in zip(nodes, weights, strict=True):
            model = MeasurementModel(
                intact, codebook, with_failures(failed, (first, second)))
            share = one * two
            means.append(model.mean(POSITION[None])[0])
            shares.append(share)
            mean = mean + share * means[-1]
            covariance = covariance + share * model.covariance()
            slopes = slopes + share * model.jacobian(POSITION[None])[0]
    for share, one in zip(shares, means, strict=True):
        deviation = one - mean
        covariance = covariance + share * deviation[..., :, None] * deviation[..., None, :].conj()

    model = FailureModel(WhitenedModel(SCENARIO, codebook))
    surface = model.surface(failed)
    weighed = model.weigh(surface, model.site(point, received))
    inverse = np.linalg.inv(covariance)
    slopes = np.tensordot(jacobian(point[None])[0].T, slopes, 1)
    curvature = 2 * np.einsum('abs,bst,cbt->ac', slopes.conj(), inverse, slopes).real
    np.testing.assert_allclose(
        weighed.curvature[0], curvature, rtol=1e-6, atol=0.2)
    residual = received - mean
    energy = np.einsum('bs,bst,bt->', residual.conj(), inverse, residual).real
    gradient = 2 * np.einsum('abs,bst,bt->a', slopes.conj(), inverse, residual).real
    gain = gradient @ weighed.step[0] - weighed.step[0] @ curvature @ weighed.step[0] / 2
    prior = 2 * np.log(0.02 / 0.98)
    volume = np.linalg.slogdet(covariance)[1].sum()
    assert weighed.residual[0] == pytest.approx(energy - gain, rel=1e-3)
    assert weighed.value[0] == pytest.approx(prior - energy - volume + gain, rel=1e-3)


def test_a_further_failure_is_weighed_as_the_larger_set(codebook):
    rng = np.random.default_rng(3)
    received = MeasurementModel(SCENARIO, codebook).sample(POSITION[None], rng)[0]
    model = FailureModel(WhitenedModel(SCENARIO, codebook))
    site = model.site(to_polar(POSITION), received)
    values = model.weigh_extensions(model.surface((5, 20)), site)
    for element in (0, 12, 35):
        surface = model.surface(tuple(sorted((5, 20, element))))
        assert values[element] == pytest.approx(model.weigh(surface, site).value[0], rel=1e-9)


def test_the_remainder_adds_to_the_covariance(codebook):
    received = MeasurementModel(SCENARIO, codebook).sample(
        POSITION[None], np.random.default_rng(3))[0]
    model = FailureModel(WhitenedModel(SCENARIO, codebook))
    site = model.site(to_polar(POSITION), received)
    values = model.weigh_extensions(model.surface((5,)), site, 0.3)
    remainder = 0.3 * error_covariance(SCENARIO, codebook)
    for element in (0, 35):
        surface = model.surface(tuple(sorted((5, element))))
        larger = surface._replace(covariance=surface.covariance + remainder)
        assert values[element] == pytest.approx(model.weigh(larger, site).value[0], rel=1e-9)


def test_the_second_search_follows_the_covariance_of_a_set(codebook):
    """With the covariance of the search itself, it finds the peaks of the table."""
    model = WhitenedModel(SCENARIO, codebook)
    table = TemplateTable(SCENARIO, tabulate(model))
    received = MeasurementModel(SCENARIO, codebook).sample(
        POSITION[None], np.random.default_rng(4))
    whitened = model.whiten(received)[0]
    identity = np.broadcast_to(np.eye(model.shape[1]), (model.shape[0], *[model.shape[1]] * 2))
    points = table.peaks_under(whitened, identity, 4)
    likelihood = table.log_likelihood(whitened)
    cell, fine = np.unravel_index(np.argmax(likelihood), likelihood.shape)
    best = table.points[cell] + [table.range_offsets_m[fine], 0, 0]
    np.testing.assert_allclose(points[0], best, atol=1e-6)


def test_a_few_failures_cost_little_accuracy(codebook):
    """One Gaussian for all failures has several times the error."""
    rng = np.random.default_rng(5)
    positions = SCENARIO.sample_positions(12, rng)
    intact = dataclasses.replace(SCENARIO, failed_element_share=0.0)
    estimator = make_estimator('bayes', SCENARIO, codebook)
    exact = make_estimator('bayes', intact, codebook)
    errors = []
    for position in positions:
        model = MeasurementModel(intact, codebook, with_failures(
            rng.choice(36, 1, replace=False), rng.uniform(size=1)))
        estimate = estimator.estimate(model.sample(position[None], rng)[0])
        other = exact.estimate(MeasurementModel(intact, codebook).sample(position[None], rng)[0])
        errors.append([np.sum((estimate.mean - position)**2), np.sum((other.mean - position)**2)])
    own, undamaged = np.mean(errors, axis=0)
    assert own < 3 * undamaged


@pytest.mark.parametrize('share, enumerated', [(0.0, False), (0.02, True), (0.5, False)])
def test_sets_are_searched_if_failures_are_rare(share, enumerated):
    scenario = dataclasses.replace(SCENARIO, failed_element_share=share)
    assert can_enumerate(scenario) is enumerated
