"""The maximum-likelihood position."""

import numpy as np
import pytest
from scipy.optimize import minimize

from rhs_isac_ros.bounds.fisher import fisher_information
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.positioning import make_estimator, simulate_pairs


@pytest.fixture(scope='module')
def setting(random_beams):
    """Positions and signals with a single mode."""
    scenario = Scenario(
        center_frequencies_hz=(2.5e9, 2.7e9, 3.3e9), n_subbands=2, elements_per_side=6,
        angular_spread_deg=2.0, roi_center_m=(4, 0, 0), roi_size_m=(2, 2, 1))
    codebook = random_beams(scenario, np.random.default_rng(1))
    positions, received = simulate_pairs(scenario, codebook, 8, 0)
    return scenario, codebook, positions, received


def test_no_position_nearby_is_more_likely(setting, plain):
    """A search with the plain likelihood, from the true position, ends at the estimate."""
    scenario, codebook, positions, received = setting
    estimate = make_estimator('ml', scenario, codebook).estimate(received)
    p, spatial = plain(scenario, codebook.analog, codebook.digital), multipath_covariance(scenario)
    covariances = [p.covariance(band, spatial[band]) for band in range(3)]

    def square_residual(position, signals):
        residuals = [signals[band] - p.mean(position, band) for band in range(3)]
        return sum((r.conj() @ np.linalg.solve(c, r)).real
                   for r, c in zip(residuals, covariances, strict=True))

    low, high = scenario.roi_bounds_m
    for n in range(4):
        found = minimize(square_residual, positions[n], args=(received[n],),
                         method='Nelder-Mead', bounds=list(zip(low, high, strict=True)),
                         options={'xatol': 1e-5, 'fatol': 1e-6})
        deviation = np.sqrt(np.trace(estimate.covariance[n]))
        assert np.linalg.norm(estimate.mean[n] - found.x) < 0.1 * deviation
        assert square_residual(estimate.mean[n], received[n]) < found.fun + 0.02


def test_the_covariance_is_the_inverse_information_at_the_estimate(setting):
    scenario, codebook, _, received = setting
    estimate = make_estimator('ml', scenario, codebook).estimate(received)
    expected = np.linalg.inv(fisher_information(scenario, codebook, estimate.mean))
    for found, bound in zip(estimate.covariance, expected, strict=True):
        np.testing.assert_allclose(found, bound, atol=0.15 * np.trace(bound))


def test_a_single_mode_is_not_enough_for_table_1(table1_estimator, shipped):
    """The errors exceed those of the posterior mean, and the covariances are too small."""
    positions, received = simulate_pairs(Scenario(), shipped, 60, 2)
    ml = make_estimator('ml', Scenario(), shipped).estimate(received)
    mean = table1_estimator.estimate(received)
    errors = [np.sum((e.mean - positions)**2, axis=1) for e in (ml, mean)]
    assert errors[0].mean() > 1.2 * errors[1].mean()
    assert errors[0].mean() > 5 * np.trace(ml.covariance, axis1=1, axis2=2).mean()
    low, high = Scenario().roi_bounds_m
    assert ((ml.mean >= low) & (ml.mean <= high)).all()
