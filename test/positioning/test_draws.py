"""Posteriors from positions that are drawn all over the grid."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import qmc

from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.model.arrays import log_sum
from rhs_isac_ros.positioning import fuse, make_estimator
from rhs_isac_ros.positioning.draws import SAMPLING, DrawnPosterior
from rhs_isac_ros.positioning.grid import TemplateTable
from rhs_isac_ros.positioning.likelihood import Likelihood
from rhs_isac_ros.positioning.templates import tabulate
from rhs_isac_ros.system import System

# The noise hides most users; many positions explain the signals.
WEAK = Scenario(elements_per_side=6, multipath_to_los_db=-30.0, noise_psd_dbm_hz=-95.0,
                roi_center_m=(6, 0, 0), roi_size_m=(6, 6, 1))
N = 12


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(WEAK, np.random.default_rng(0))


def found_and_exact(scenario, codebook, n=N, sampling=SAMPLING):
    """Draws for n shots, and mean, covariance and log evidence from 2^15 points."""
    likelihood = Likelihood(System(scenario, codebook))
    table = TemplateTable(scenario, tabulate(likelihood.model))
    drawn = DrawnPosterior(scenario, table, likelihood.model.n_whitened, sampling)
    rng = np.random.default_rng(1)
    received = simulate_received(scenario, codebook, scenario.sample_positions(n, rng), rng)
    whitened = likelihood.signals(received).whitened
    query = table.query(whitened, likelihood.nuisance, 8.0)
    found = [drawn.fit(query, shot) for shot in range(n)]
    low, high = likelihood.resolution.bounds_m
    positions = low + (high - low) * qmc.Sobol(3, seed=0).random(1 << 15)
    means = likelihood.model.whiten(likelihood.model.mean(positions)).reshape(len(positions), -1)
    values = (2 * (whitened.reshape(n, -1).conj() @ means.T).real
              - np.sum(np.abs(means)**2, axis=1))
    exact = []
    for value, energy in zip(values, query.energies, strict=True):
        weights = np.exp(value - log_sum(value))
        mean = weights @ positions
        offset = positions - mean
        exact.append((mean, (weights[:, None] * offset).T @ offset,
                      log_sum(value) - np.log(len(positions)) - energy))
    return found, exact


@pytest.mark.slow
@pytest.mark.parametrize('changes', [{}, {'roi_size_m': (6, 6, 0)}])
def test_draws_have_the_moments_of_the_posterior(changes, codebook):
    """The mean of 150 random draws would have an error of 0.08 standard deviations."""
    found, exact = found_and_exact(dataclasses.replace(WEAK, **changes), codebook)
    errors, spreads = [], []
    n_measurements = WEAK.n_bands * WEAK.n_subbands * WEAK.n_frames
    for draws, (mean, covariance, log_evidence) in zip(found, exact, strict=True):
        errors.append(np.sum((draws.mean - mean)**2) / np.trace(covariance))
        spreads.append(np.trace(draws.covariance) / np.trace(covariance))
        assert draws.log_evidence == pytest.approx(log_evidence, abs=0.2)
        assert draws.expected < n_measurements
    assert np.mean(errors) < 0.08**2
    assert np.mean(spreads) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_later_rounds_follow_earlier_ones_without_bias(codebook):
    """A cell whose first draws miss its peak gets few more of them, and must not lose weight."""
    found, exact = found_and_exact(
        WEAK, codebook, 30, SAMPLING._replace(draws=50, effective=50.0))
    spreads = [np.trace(draws.covariance) / np.trace(covariance)
               for draws, (_, covariance, _) in zip(found, exact, strict=True)]
    totals = [draws.log_evidence - log_evidence
              for draws, (*_, log_evidence) in zip(found, exact, strict=True)]
    assert np.mean(spreads) == pytest.approx(1, abs=0.05)
    assert np.mean(totals) == pytest.approx(0, abs=0.1)


def table_and_query(codebook, sampling=SAMPLING, **changes):
    scenario = dataclasses.replace(WEAK, **changes)
    likelihood = Likelihood(System(scenario, codebook))
    table = TemplateTable(scenario, tabulate(likelihood.model))
    drawn = DrawnPosterior(scenario, table, likelihood.model.n_whitened, sampling)
    return drawn, table, table.query(
        likelihood.model.whiten(likelihood.model.mean(np.array([[6.0, 1.0, 0.2]]))),
        likelihood.nuisance, 8.0)


def test_limited_signals_leave_no_draws(codebook):
    drawn, table, query = table_and_query(
        codebook, noise_psd_dbm_hz=-174.0, multipath_to_los_db=-60.0)
    assert not table.filters.is_exact
    assert drawn.fit(query, 0) is None


def test_narrow_peaks_leave_too_few_effective_draws(codebook):
    drawn, table, query = table_and_query(
        codebook, SAMPLING._replace(draws=10), noise_psd_dbm_hz=-105.0, multipath_to_los_db=-60.0)
    assert table.filters.is_exact
    assert drawn.fit(query, 0) is None


@pytest.mark.slow
def test_estimates_from_draws_agree_with_those_from_modes(codebook):
    """Laplace's method is rough below the noise, but the modes are at the right places."""
    estimator, rng = make_estimator('bayes', WEAK, codebook), np.random.default_rng(2)
    received = simulate_received(WEAK, codebook, WEAK.sample_positions(N, rng), rng)
    drawn = estimator.estimate(received)
    by_modes = [one.estimate for one in estimator._locate_block(
        estimator._region, estimator._likelihood.signals(received), draws=False)]
    errors = [np.sum((one - other.mean)**2) / np.trace(other.covariance)
              for one, other in zip(drawn.mean, by_modes, strict=True)]
    assert 1e-6 < np.mean(errors) < 0.5**2
    single = estimator.estimate(received[3])
    np.testing.assert_allclose(single.mean, drawn.mean[3], atol=0.02)
    np.testing.assert_allclose(single.residual, drawn.residual[3], rtol=1e-3)


def test_the_estimate_of_a_posterior_is_that_of_the_estimator(codebook):
    estimator, rng = make_estimator('bayes', WEAK, codebook), np.random.default_rng(0)
    for signals in simulate_received(WEAK, codebook, WEAK.sample_positions(5, rng), rng):
        expected, posterior = estimator.estimate(signals), estimator.posterior(signals)
        mean, covariance = posterior.mixture.moments()
        for found in (expected.mean, posterior.mean):
            np.testing.assert_allclose(mean, found, atol=1e-6)
        np.testing.assert_allclose(covariance, posterior.covariance, atol=1e-3)
        # The groups of rays are broad, but the likelihood as a whole is in the right place.
        fused = fuse([posterior.sighting], WEAK.roi_bounds_m)
        error = fused.mean - mean
        assert error @ np.linalg.solve(covariance, error) < 0.01
        np.testing.assert_allclose(
            np.diag(fused.covariance), np.diag(covariance), rtol=0.15, atol=0.01)


def test_peaks_above_noise_are_searched_where_other_surfaces_may_favour_them(
        codebook, monkeypatch):
    """Groups of draws represent peaks of small shares poorly."""
    fit, drawn = DrawnPosterior.fit, []
    monkeypatch.setattr(
        DrawnPosterior, 'fit', lambda *arguments: drawn.append(fit(*arguments)) or drawn[-1])
    rng = np.random.default_rng(7)
    received = simulate_received(WEAK, codebook, WEAK.sample_positions(12, rng), rng)
    counts = []
    for options in ({}, {'left_out': 5e-5}):
        drawn.clear()
        make_estimator('bayes', WEAK, codebook, **options).estimate(received)
        counts.append(len(drawn))
    assert 0 < counts[1] < counts[0]
