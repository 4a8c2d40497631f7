"""The modes of the posterior."""

import dataclasses

import numpy as np
import pytest
from scipy.special import i0e

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.codebook import Codebook, random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.arrays import log_sum
from rhs_isac_ros.model.geometry import element_positions, jacobian, to_polar, to_positions
from rhs_isac_ros.positioning.dispersed import DispersedLikelihood
from rhs_isac_ros.positioning.grid import Starts, TemplateTable
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.offsets import Alignment
from rhs_isac_ros.positioning.search import ascend, expanded_at, find_modes, marginal_at, one_step
from rhs_isac_ros.positioning.segments import select
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.system import System

SCENARIO = Scenario(
    center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), elements_per_side=6, angular_spread_deg=2.0,
    roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))


@pytest.fixture(scope='module')
def setting(shipped):
    """Likelihood, grid, signals, positions and modes of some phases of Table I."""
    scenario = Scenario()
    likelihood = Likelihood(System(scenario, shipped))
    grid = TemplateTable(scenario, tabulate(likelihood.model))
    positions, received = System(scenario, shipped).pairs(30, 3)
    signals = likelihood.signals(received)
    return likelihood, grid, signals, positions, find_modes(
        likelihood, grid, signals, np.zeros((30, 0)))


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(1))


def of_each(modes):
    return [modes.of_shot(phase) for phase in np.unique(modes.shots)]


def square_residual(likelihood, points, whitened):
    means = likelihood.model.whiten(likelihood.model.mean(to_positions(points)))
    return np.sum(np.abs(whitened - means)**2, axis=(1, 2))


def test_likelihoods_match_the_exact_model_in_the_region(setting):
    likelihood, _, signals, _, modes = setting
    low, high = likelihood.scenario.roi_bounds_m
    positions = to_positions(modes.points)
    assert ((positions > low - 0.05) & (positions < high + 0.05)).all()
    exact = -square_residual(likelihood, modes.points, signals.whitened[modes.shots])
    errors = np.abs(modes.log_likelihood - exact)
    assert np.median(errors) < 0.05
    assert np.quantile(errors, 0.9) < 1.0


def test_the_true_position_is_not_more_likely_than_the_best_mode(setting):
    """The best mode is a maximum; a failure means that the search missed a mode."""
    likelihood, _, signals, positions, modes = setting
    truths = -square_residual(likelihood, to_polar(positions), signals.whitened)
    best = np.array([one.log_likelihood[0] for one in of_each(modes)])
    assert (best > truths - 0.3).all()
    # Half of a chi-square variable with three degrees of freedom.
    assert 0.5 < np.mean(best - truths) < 4


def test_the_gradient_contains_the_change_of_the_volume_of_phases(codebook):
    """Averaged over uniform phases of the bands, the likelihood contains Bessel functions."""
    scenario = dataclasses.replace(SCENARIO, band_phase_std_rad=2 * np.pi)
    likelihood, point = Likelihood(System(scenario, codebook)), np.array([[4.0, 0.1, -0.05]])
    signals = likelihood.signals(likelihood.model.mean(to_positions(point)))
    nearby = point + np.outer([-1e-3, 1e-3], [1.0, 0.0, 0.0])
    means = likelihood.model.whiten(likelihood.model.mean(to_positions(nearby)))
    amplitudes = 2 * np.abs(np.sum(means.conj() * signals.whitened, axis=2))
    exact = np.sum(np.log(i0e(amplitudes)) + amplitudes - np.sum(np.abs(means)**2, axis=2), axis=1)
    _, gradient, _ = expanded_at(
        likelihood, likelihood, point, np.zeros((1, len(likelihood.nuisance))), signals)
    assert gradient[0, 0] == pytest.approx(np.diff(exact)[0] / 2e-3, rel=0.05)


@pytest.mark.parametrize(('changes', 'tolerance'), [
    ({}, 0.05), ({'timing_std_s': 1e-8}, 0.15), ({'user_gain_std_db': 2.0}, 0.15),
    ({'user_gain_std_db': 2.0, 'noise_psd_dbm_hz': -80.0}, 0.15)], ids=str)
def test_the_value_at_any_point_is_the_average_over_the_parameters(codebook, changes, tolerance):
    """Also far from the mode, where the direct path is stronger or weaker than received."""
    scenario = dataclasses.replace(SCENARIO, band_phase_std_rad=2 * np.pi, **changes)
    likelihood, point = Likelihood(System(scenario, codebook)), np.array([4.0, 0.1, -0.05])
    prior, n_bands = likelihood.nuisance, scenario.n_bands
    # Newton steps begin at the median gain, which is therefore the true one.
    signals = likelihood.signals(MeasurementModel(
        dataclasses.replace(scenario, user_gain_std_db=0.0), codebook).sample(
            to_positions(point[None]), np.random.default_rng(2)))
    points = point * np.array([[0.85], [1.0], [1.2]]) ** [1, 0, 0]
    values = np.zeros((len(points), len(prior)))
    found = marginal_at(likelihood, likelihood, points, values, signals)
    # Parameters other than phases, on a grid.
    lines = [np.linspace(-4, 4, 161)] * (len(prior) - n_bands)
    grid = np.stack(np.meshgrid(*lines, np.zeros(1)), axis=-1).reshape(-1, len(lines) + 1)
    exact = []
    for one in points:
        at = np.hstack([grid[:, :-1], np.zeros((len(grid), n_bands))])
        white = likelihood.at(np.repeat(one[None], len(at), axis=0), at)
        amplitudes = 2 * np.abs(white.outputs(at, signals))
        averages = np.log(i0e(amplitudes)) + amplitudes
        # In place of the outputs at a phase of 0.
        exact.append(log_sum(white.local(at, signals).value + np.sum(
            averages - 2 * white.outputs(at, signals).real, axis=1)))
    exact += len(lines) * np.log(8 / 160 / np.sqrt(2 * np.pi))
    np.testing.assert_allclose(found[0], exact, atol=tolerance)


def test_no_average_over_an_offset_exceeds_the_likelihood(random_beams):
    """A few measurements of the multipath may say far less about the timing than expected."""
    scenario = dataclasses.replace(
        SCENARIO, center_frequencies_hz=(2.5e9,), n_subbands=2, n_frames=1, multipath_to_los_db=10,
        band_phase_std_rad=2 * np.pi, timing_std_s=1e-6)
    system = System(scenario, random_beams(scenario, np.random.default_rng(1)))
    likelihood, n = Likelihood(system), 60
    positions, received = system.pairs(n, 1)
    points, signals = to_polar(positions), likelihood.signals(received)
    # The timing in standard deviations, in order.
    values = np.pad(np.linspace(-5, 5, 201)[:, None], [(0, 0), (0, 1)])
    surplus = []
    for shot in range(n):
        one, point = select(signals, [shot]), points[[shot]]
        white = likelihood.at(np.repeat(point, len(values), axis=0), values)
        outputs = white.outputs(values, one)[:, 0]
        given = white.local(values, one).value - 2 * outputs.real + np.log(
            i0e(2 * np.abs(outputs))) + 2 * np.abs(outputs)
        exact = log_sum(given) + np.log(10 / 200 / np.sqrt(2 * np.pi))
        surplus.append(marginal_at(
            likelihood, likelihood, point, values[[np.argmax(given)]], one)[0][0] - exact)
    assert max(surplus) < 0.5
    assert abs(np.median(surplus)) < 0.3


def test_no_ascent_ends_below_its_start(random_beams):
    """With few measurements, the likelihood is far from quadratic."""
    scenario = dataclasses.replace(
        SCENARIO, center_frequencies_hz=(2.5e9,), n_subbands=1, n_frames=2)
    rng = np.random.default_rng(4)
    likelihood = Likelihood(System(scenario, random_beams(scenario, rng)))
    signals = likelihood.signals(
        likelihood.model.sample(scenario.sample_positions(1, rng), rng))
    starts = scenario.sample_positions(200, rng)
    points, values = to_polar(starts), np.zeros((1, 0))
    before = likelihood.local(
        points, np.zeros((len(points), 0)), select(signals, np.zeros(len(points), int))).value
    for start, value in zip(points, before, strict=True):
        mode = ascend(likelihood, likelihood, Starts(np.zeros(1, int), start[None], values),
                      signals, 8, np.inf)
        assert mode.log_likelihood[0] > value - 0.1


def test_modes_that_mirror_each_other_have_the_same_order_on_all_machines():
    """If both halves of the surface are the same, u and -u are, up to rounding, equally likely."""
    places = element_positions(SCENARIO)
    mirrored = [np.argmin(np.linalg.norm(places - one, axis=1)) for one in places * [1, -1, 1]]
    codebook = random_codebook(SCENARIO, np.random.default_rng(2))
    likelihood = Likelihood(System(SCENARIO, Codebook(
        (codebook.analog + codebook.analog[:, :, mirrored]) / 2, codebook.digital)))
    positions = SCENARIO.sample_positions(20, np.random.default_rng(0))
    signals = likelihood.signals(
        likelihood.model.sample(positions, np.random.default_rng(1)))
    modes = find_modes(likelihood, TemplateTable(SCENARIO, tabulate(likelihood.model)), signals,
                       np.zeros((20, 0)))
    pairs = [one for one in of_each(modes)
             if len(one.points) > 1 and abs(np.ptp(one.log_likelihood[:2])) < 1e-9]
    assert len(pairs) > 10
    for one in pairs:
        np.testing.assert_allclose(one.points[1], one.points[0] * [1, -1, 1], atol=1e-6)
        assert one.points[0, 1] > 0


def test_the_curvature_is_the_information_in_polar_coordinates(setting):
    likelihood, grid, signals, _, _ = setting
    modes = find_modes(likelihood, grid, select(signals, [0]), np.zeros((1, 0)))
    by_point = jacobian(modes.points)
    information = fisher_information(likelihood.model, to_positions(modes.points))
    expected = np.swapaxes(by_point, 1, 2) @ information @ by_point
    expected += np.diag(likelihood.nuisance.floor)
    inside = (np.abs(modes.gradient) * np.sqrt(np.diagonal(
        np.linalg.inv(modes.curvature), axis1=1, axis2=2)) < 1e-9).all(axis=1)
    assert inside.any()
    for found, exact in zip(modes.curvature[inside], expected[inside], strict=True):
        scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
        assert (np.abs(found - exact) / scale).max() < 0.1


def test_steps_continue_until_they_gain_nothing(codebook):
    likelihood = Likelihood(System(SCENARIO, codebook))
    points = to_polar(SCENARIO.sample_positions(50, np.random.default_rng(2)))
    signals = likelihood.signals(likelihood.model.mean(to_positions(points)))
    # A tenth of a wavelength.
    starts = Starts(np.arange(50), points + [0.012, 0.0, 0.0], np.zeros((50, 0)))
    modes = ascend(likelihood, likelihood, starts, signals, 8)
    assert np.abs(modes.points - points[modes.shots]).max() < 5e-5


@pytest.mark.parametrize('changes', [{'user_gain_std_db': 1.0}, {'phase_std_rad': 0.5}], ids=str)
def test_the_likelihood_of_a_mode_is_the_average_over_the_parameter(codebook, changes):
    """The reference integrates numerically at the position of the mode."""
    scenario, rng = dataclasses.replace(SCENARIO, **changes), np.random.default_rng(5)
    likelihood = Likelihood(System(scenario, codebook))
    signals = likelihood.signals(
        MeasurementModel(scenario, codebook).sample(np.array([[4.2, 0.3, -0.1]]), rng))
    modes = find_modes(likelihood, TemplateTable(scenario, tabulate(likelihood.model)), signals,
                       np.zeros((1, 1)))
    step = 1 / 500
    values = modes.values[0] + step * np.arange(-1500, 1501)[:, None]
    points = np.repeat(modes.points[:1], len(values), axis=0)
    log_likelihood = likelihood.local(
        points, values, select(signals, np.zeros(len(values), int))).value
    highest = log_likelihood.max()
    average = highest + np.log(np.sum(np.exp(log_likelihood - highest)) * step)
    # The factors 2 pi of the integral and of the prior cancel.
    expected = average - np.log(2 * np.pi) / 2
    assert modes.log_likelihood[0] == pytest.approx(expected, abs=0.1)
    # The same holds anywhere else, from other parameters.
    found, best, _ = marginal_at(
        likelihood, likelihood, points[:1], modes.values[:1] + 0.1, signals)
    assert found[0] == pytest.approx(expected, abs=0.1)
    assert best[0] == pytest.approx(values[log_likelihood.argmax()], abs=2 * step)


def test_the_weights_of_modes_are_likelihoods_and_no_predictions(codebook):
    """Far from a mode, the prediction of a step may be arbitrarily wrong."""
    scenario = dataclasses.replace(SCENARIO, carrier_offset_std_hz=3e3, user_gain_std_db=2.0)
    rng = np.random.default_rng(8)
    likelihood = Likelihood(System(scenario, codebook))
    grid = TemplateTable(scenario, tabulate(likelihood.model))
    alignment = Alignment(likelihood, grid.spread)
    received = MeasurementModel(scenario, codebook).sample(scenario.sample_positions(8, rng), rng)
    signals = likelihood.signals(received)
    modes = find_modes(
        likelihood, grid, signals, alignment.values_of_each(received))
    local = likelihood.local(modes.points, modes.values, select(signals, modes.shots))
    np.testing.assert_allclose(modes.residual, local.residual, rtol=1e-9)
    among = np.linalg.slogdet(local.information[:, 3:, 3:])[1]
    np.testing.assert_allclose(modes.log_likelihood, local.value - among / 2, rtol=1e-9)


def test_a_step_predicts_the_likelihood_after_it(codebook):
    scenario = dataclasses.replace(SCENARIO, element_error_rms=0.02, failed_element_share=0.02)
    likelihood, user = Likelihood(System(scenario, codebook)), np.array([[4.2, 0.3, -0.1]])
    signals = likelihood.signals(
        MeasurementModel(scenario, codebook).sample(user, np.random.default_rng(7)))
    errors = DispersedLikelihood(likelihood)
    start = to_polar(user + [[0.001, 0.002, 0]]) + [0.002, 0.005, 0.005]
    found = []
    for _ in range(4):
        found.append(ascend(
            errors, likelihood, Starts(np.zeros(1, int), start, np.zeros((1, 0))), signals, 1))
        start = found[-1].points
    first, *_, last = (float(modes.log_likelihood[0]) for modes in found)
    assert first == pytest.approx(last, abs=0.5)
    np.testing.assert_allclose(found[3].points, found[2].points, atol=1e-4)


@pytest.mark.parametrize('size_m', [(0, 2, 1), (2, 0, 1), (0, 2, 0), (2, 2, 1)])
def test_no_step_lowers_the_predicted_likelihood(codebook, size_m):
    """On a plane, range and direction change together: limits of each would turn a step."""
    scenario = dataclasses.replace(SCENARIO, roi_size_m=size_m, multipath_to_los_db=-20.0)
    likelihood, rng = Likelihood(System(scenario, codebook)), np.random.default_rng(1)
    signals = likelihood.signals(likelihood.model.sample(
        scenario.sample_positions(200, rng), rng))
    starts = Starts(np.arange(200), to_polar(scenario.sample_positions(200, rng)),
                    np.zeros((200, 0)))
    _, gain = one_step(likelihood, likelihood, starts, signals)
    assert gain.min() >= 0 and np.median(gain) > 100


@pytest.mark.parametrize('size_m', [(0, 0, 3), (0, 4, 0)], ids=['upright', 'across'])
@pytest.mark.parametrize('changes', [
    {'band_phase_std_rad': np.inf}, {'timing_std_s': np.inf, 'phase_std_rad': np.inf}], ids=str)
def test_users_on_a_line_have_the_modes_near_them(codebook, changes, size_m):
    """The search begins off the line, where unknown phases fit another range."""
    scenario = dataclasses.replace(
        SCENARIO, roi_center_m=(6, 0.7, 0.4), roi_size_m=size_m, multipath_to_los_db=-20.0,
        **changes)
    rng, likelihood = np.random.default_rng(2), Likelihood(System(scenario, codebook))
    grid = TemplateTable(scenario, tabulate(likelihood.model))
    positions = scenario.sample_positions(40, rng)
    signals = likelihood.signals(MeasurementModel(scenario, codebook).sample(positions, rng))
    aligned = Alignment(likelihood, grid.spread).values_of_each(signals.received)
    points, values = to_polar(positions), aligned
    for _ in range(3):
        _, values, _ = marginal_at(likelihood, likelihood, points, values, signals)
    near = ascend(likelihood, likelihood, Starts(np.arange(40), points, values), signals, 8)
    best = [one.log_likelihood[0] for one in of_each(find_modes(
        likelihood, grid, signals, aligned))]
    assert np.min(best - near.log_likelihood) > -0.5
