"""Estimates of signals with deviations that the scenario declares."""

import dataclasses

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import binom, norm

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.nuisance import nuisance_factors
from rhs_isac_ros.positioning import exhaustive_posterior, make_estimator
from rhs_isac_ros.positioning.element_error_model import ElementErrorModel
from rhs_isac_ros.positioning.joint_modes import find_joint_modes, local_model
from rhs_isac_ros.positioning.marginal import MarginalSearch
from rhs_isac_ros.positioning.modes import Modes
from rhs_isac_ros.positioning.polar import to_polar, to_positions
from rhs_isac_ros.positioning.surroundings import Surroundings, tabulate_surroundings
from rhs_isac_ros.positioning.table import TemplateTable
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.positioning.unknowns import Alignment, Unknowns
from rhs_isac_ros.positioning.whitened import WhitenedModel

SCENARIO = Scenario(
    center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
ALL = {'user_gain_std_db': 1.0, 'carrier_offset_std_hz': 500.0, 'phase_std_rad': 0.5,
       'timing_std_s': 1e-8, 'band_phase_std_rad': 0.3}


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


def declaring(**changes) -> Scenario:
    return dataclasses.replace(SCENARIO, **changes)


def share_covered(estimate, positions) -> float:
    """Share of the phases whose 95 % region contains the user; no fix contains none."""
    errors = (estimate.mean - positions)[estimate.fix]
    covariance = estimate.covariance[estimate.fix]
    normalised = np.sum(errors * np.linalg.solve(covariance, errors[..., None])[..., 0], axis=1)
    return np.sum(normalised <= 7.815) / len(positions)


@pytest.mark.parametrize('changes', [
    {'user_gain_std_db': 3.0}, {'carrier_offset_std_hz': 2e3}, {'timing_std_s': 5e-8},
    {'phase_std_rad': 7.0}, {'band_phase_std_rad': 0.2},
    {'user_gain_std_db': 1.0, 'phase_std_rad': 0.5, 'carrier_offset_std_hz': 1e3},
    {'element_error_rms': 0.02},
], ids=lambda changes: ' '.join(changes))
def test_declared_deviations_leave_consistent_estimates(codebook, changes):
    """Undeclared, many of these signals have no fix or a wrong one."""
    scenario, rng = declaring(**changes), np.random.default_rng(2)
    positions = scenario.sample_positions(25, rng)
    received = MeasurementModel(scenario, codebook).sample(positions, rng)
    silent = make_estimator('bayes', SCENARIO, codebook).estimate(received)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)
    assert share_covered(silent, positions) < 0.8
    assert share_covered(estimate, positions) >= 0.88
    assert estimate.fix.all()
    assert 75 < np.median(estimate.residual) < 110


@pytest.mark.parametrize('std', [1e-300, 1e-12])
def test_negligible_deviations_change_no_estimate(codebook, std):
    scenario = declaring(user_gain_std_db=std, timing_std_s=std * 1e-7, band_phase_std_rad=std)
    rng = np.random.default_rng(2)
    positions = SCENARIO.sample_positions(5, rng)
    received = MeasurementModel(SCENARIO, codebook).sample(positions, rng)
    expected = make_estimator('bayes', SCENARIO, codebook).estimate(received)
    found = make_estimator('bayes', scenario, codebook).estimate(received)
    np.testing.assert_allclose(found.mean, expected.mean, atol=0.02)
    np.testing.assert_allclose(found.residual, expected.residual, rtol=0.02)


def test_the_gradient_is_that_of_the_log_likelihood(codebook):
    scenario, rng = declaring(**ALL), np.random.default_rng(3)
    model = WhitenedModel(scenario, codebook)
    unknowns = Unknowns(model)
    position = np.array([[4.2, 0.3, -0.1]])
    received = MeasurementModel(scenario, codebook).sample(position, rng)[0]
    values = 0.3 * unknowns.std * rng.normal(size=(1, len(unknowns.std)))
    points = to_polar(position + 0.003)
    information, gradient, _, _ = local_model(model, unknowns, received, points, values)
    np.testing.assert_allclose(information, np.swapaxes(information, 1, 2), rtol=1e-9)
    assert (np.linalg.eigvalsh(information / np.sqrt(
        np.einsum('mp,mq->mpq', *[np.diagonal(information, axis1=1, axis2=2)] * 2))) > 0).all()

    def value(change):
        return local_model(model, unknowns, received, points + change[:3],
                            values + change[3:])[2][0]

    scale = 1e-4 / np.sqrt(np.diagonal(information[0]))
    for index, step in enumerate(np.diag(scale)):
        difference = (value(step) - value(-step)) / (2 * scale[index])
        assert difference == pytest.approx(gradient[0, index], rel=1e-3, abs=1e-3 / scale[index])


@pytest.mark.parametrize('changes', [{'user_gain_std_db': 1.0}, {'phase_std_rad': 0.5}], ids=str)
def test_the_likelihood_of_a_mode_is_the_average_over_the_parameter(codebook, changes):
    """The reference integrates numerically at the position of the mode."""
    scenario, rng = declaring(**changes), np.random.default_rng(5)
    model = WhitenedModel(scenario, codebook)
    unknowns = Unknowns(model)
    received = MeasurementModel(scenario, codebook).sample(np.array([[4.2, 0.3, -0.1]]), rng)[0]
    found = find_joint_modes(
        model, TemplateTable(scenario, tabulate(model)), unknowns, received, np.zeros(1))
    step = unknowns.std[0] / 500
    values = found.values[0] + step * np.arange(-1500, 1501)[:, None]
    points = np.repeat(found.modes.points[:1], len(values), axis=0)
    _, _, log_likelihood, _ = local_model(model, unknowns, received, points, values)
    highest = log_likelihood.max()
    average = highest + np.log(
        np.sum(np.exp(log_likelihood - highest)) * step / unknowns.std[0])
    # The factors 2 pi of the integral and of the prior cancel.
    expected = average - np.log(2 * np.pi) / 2
    assert found.modes.log_likelihood[0] == pytest.approx(expected, abs=0.1)


def test_the_information_is_the_covariance_of_the_gradient(codebook):
    """Averaged over signals at the true parameters, without the prior."""
    scenario, rng = declaring(**ALL), np.random.default_rng(4)
    model = WhitenedModel(scenario, codebook)
    unknowns = Unknowns(model)
    point = to_polar(np.array([[4.2, 0.3, -0.1]]))
    zero = np.zeros((1, len(unknowns.std)))
    exact = MeasurementModel(SCENARIO, codebook)
    received = exact.sample(np.tile(to_positions(point), (2000, 1)), rng)
    gradients = np.array([
        local_model(model, unknowns, signals, point, zero)[1][0] for signals in received])
    information = local_model(model, unknowns, received[0], point, zero)[0][0]
    information[3:, 3:] -= np.diag(unknowns.precision)
    scale = np.sqrt(np.diag(information))
    found = np.cov(gradients.T) / np.outer(scale, scale)
    np.testing.assert_allclose(found, information / np.outer(scale, scale), atol=0.15)


def test_the_evidence_outside_is_the_average_over_the_gain(codebook):
    scenario = declaring(user_gain_std_db=0.5)
    model = WhitenedModel(scenario, codebook)
    table = Surroundings(scenario, tabulate_surroundings(model))
    search = MarginalSearch(
        model, TemplateTable(scenario, tabulate(model)), table, None)
    received = MeasurementModel(SCENARIO, codebook).sample(
        np.array([[8.0, 1.0, 0.5]]), np.random.default_rng(6))[0]
    gains = np.linspace(-6, 6, 601) * search.unknowns.std[0]
    signals = model.whiten(received * np.exp(-gains)[:, None, None])
    exponent = np.array([table.log_evidence(one)[0] for one in signals])
    exponent += norm(scale=search.unknowns.std[0]).logpdf(gains) - 2 * received.size * gains
    expected = logsumexp(exponent) + np.log(gains[1] - gains[0])
    assert search.find(received).log_evidence_outside == pytest.approx(expected, abs=0.1)
def test_the_weights_of_modes_are_likelihoods_and_no_predictions(codebook):
    """Far from a mode, the prediction of a step may be arbitrarily wrong."""
    scenario, rng = declaring(carrier_offset_std_hz=3e3, user_gain_std_db=2.0), (
        np.random.default_rng(8))
    model = WhitenedModel(scenario, codebook)
    table, unknowns = TemplateTable(scenario, tabulate(model)), Unknowns(model)
    alignment = Alignment(model, unknowns, table.filters)
    received = MeasurementModel(scenario, codebook).sample(scenario.sample_positions(8, rng), rng)
    for signals in received:
        joint = find_joint_modes(model, table, unknowns, signals, alignment.values(signals))
        _, _, _, residual = local_model(
            model, unknowns, signals, joint.modes.points, joint.values)
        np.testing.assert_allclose(joint.residual, residual, rtol=1e-9)


def test_the_signals_alone_reveal_the_offsets_of_carrier_and_timing(codebook):
    scenario = declaring(carrier_offset_std_hz=2e3, timing_std_s=1e-7)
    model = WhitenedModel(scenario, codebook)
    unknowns = Unknowns(model)
    alignment = Alignment(model, unknowns, tabulate(model)['filters'])
    rng = np.random.default_rng(5)
    values = rng.normal(size=(20, 2)) * unknowns.std
    positions = scenario.sample_positions(20, rng)
    received = MeasurementModel(SCENARIO, codebook).sample(positions, rng)
    received = received * nuisance_factors(scenario, values)
    found = np.array([alignment.values(signals) for signals in received])
    assert (np.abs(found - values) / unknowns.std).max() < 0.3


def test_weights_of_modes_follow_the_covariance_at_their_position(codebook):
    scenario = declaring(element_error_rms=0.05)
    model = WhitenedModel(scenario, codebook)
    exact = MeasurementModel(scenario, codebook)
    positions = np.array([[3.2, 0.1, 0.0], [4.8, 0.1, 0.0]])
    received = exact.sample(positions[:1], np.random.default_rng(6))
    modes = Modes(to_polar(positions), np.tile(np.eye(3), (2, 1, 1)), np.zeros(2),
                  np.zeros((2, 3)))
    weighed, residual = ElementErrorModel(model).refine(
        modes, np.repeat(received, 2, axis=0), step=False)
    value = np.empty(2)
    for n, covariance in enumerate(exact.covariance_at(positions)):
        difference = received[0] - exact.mean(positions)[n]
        energy = sum(np.vdot(d, np.linalg.solve(c, d)).real
                     for d, c in zip(difference, covariance, strict=True))
        assert residual[n] == pytest.approx(energy, rel=1e-6)
        searched = np.sum(np.abs(model.whiten(difference[None]))**2)
        value[n] = searched - energy - np.sum(np.linalg.slogdet(covariance)[1])
    assert np.diff(weighed.log_likelihood)[0] == pytest.approx(np.diff(value)[0], rel=1e-6)


def failing_modes(codebook, user):
    """The model of a surface with failures, the modes of a user there and nearby, and signals."""
    scenario = declaring(element_error_rms=0.02, failed_element_share=0.02)
    received = MeasurementModel(scenario, codebook).sample(user, np.random.default_rng(7))
    modes = Modes(to_polar(user + [[0.001, 0.002, 0], [0, 0, 0.003]]),
                  np.tile(np.eye(3), (2, 1, 1)), np.zeros(2), np.zeros((2, 3)))
    return scenario, modes, np.repeat(received, 2, axis=0)


def test_the_likelihood_is_the_average_over_the_number_of_failures(codebook):
    scenario, modes, signals = failing_modes(codebook, np.array([[4.2, 0.3, -0.1]]))
    model = WhitenedModel(scenario, codebook)
    positions = to_positions(modes.points)
    exact = MeasurementModel(scenario, codebook)
    average = exact.covariance_at(positions)
    intact = MeasurementModel(
        dataclasses.replace(scenario, failed_element_share=0.0), codebook).covariance_at(positions)
    residuals = signals - exact.mean(positions)
    # The probability of more than six failures is below 1e-5.
    counts, expected = np.arange(7), np.empty(2)
    for n in range(2):
        values = binom.logpmf(counts, 36, 0.02)
        for count in counts:
            for d, first, second in zip(residuals[n], intact[n], average[n], strict=True):
                covariance = first + count / (36 * 0.02) * (second - first)
                values[count] -= np.vdot(d, np.linalg.solve(covariance, d)).real
                values[count] -= np.linalg.slogdet(covariance)[1]
        expected[n] = logsumexp(values) + np.sum(np.abs(model.whiten(residuals[n:n + 1]))**2)
    weighed, _ = ElementErrorModel(model).refine(modes, signals, step=False)
    assert np.diff(weighed.log_likelihood)[0] == pytest.approx(np.diff(expected)[0], abs=0.01)


def test_a_step_predicts_the_likelihood_after_it(codebook):
    scenario, modes, signals = failing_modes(codebook, np.array([[4.2, 0.3, -0.1]]))
    errors = ElementErrorModel(WhitenedModel(scenario, codebook))
    start = modes.select(np.array([0]))
    start = start._replace(points=start.points + [0.002, 0.005, 0.005])
    found = [errors.refine(start, signals[:1], step=True)[0]]
    for _ in range(3):
        found.append(errors.refine(found[-1], signals[:1], step=True)[0])
    first, *_, last = (float(mode.log_likelihood[0]) for mode in found)
    assert first == pytest.approx(last, abs=0.5)
    np.testing.assert_allclose(found[3].points, found[2].points, atol=1e-4)
def test_random_phases_of_the_bands_leave_the_moments_of_the_posterior(codebook):
    """The modes extend over the range and overlap."""
    scenario = declaring(
        band_phase_std_rad=7.0, roi_center_m=(14.0, 0.0, 0.0), roi_size_m=(8.0, 4.0, 2.0))
    rng = np.random.default_rng(7)
    positions = scenario.sample_positions(25, rng)
    received = MeasurementModel(scenario, codebook).sample(positions, rng)
    estimate = make_estimator('bayes', scenario, codebook).estimate(received)
    assert estimate.fix.all()
    reference = exhaustive_posterior(scenario, codebook, received, 17)
    variance = np.trace(reference.covariance, axis1=1, axis2=2)
    difference = np.sum((estimate.mean - reference.mean)**2, axis=1)
    assert np.mean(difference) < 0.04 * np.mean(variance)
    predicted = np.trace(estimate.covariance, axis1=1, axis2=2)
    assert np.mean(predicted) == pytest.approx(np.mean(variance), rel=0.15)
