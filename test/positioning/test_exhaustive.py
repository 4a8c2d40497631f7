"""The posterior as a weighted sum over the whole region."""

import numpy as np
from scipy.stats import qmc

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.multipath import multipath_covariance
from rhs_isac_ros.positioning import exhaustive_posterior, simulate_pairs


def test_moments_match_the_plain_likelihood(plain, random_beams):
    scenario = Scenario(n_subbands=2, elements_per_side=4, roi_center_m=(4, 0, 0),
                        roi_size_m=(1, 1, 0.5))
    codebook = random_beams(scenario, np.random.default_rng(1))
    received = simulate_pairs(scenario, codebook, 5, 0)[1]
    shares = []
    estimate = exhaustive_posterior(scenario, codebook, received, 13, shares.append)
    assert shares == [0.5, 1.0]

    p, spatial = plain(scenario, codebook.analog, codebook.digital), multipath_covariance(scenario)
    points = qmc.Sobol(3, seed=0).random(2**13) * [1, 1, 0.5] + [3.5, -0.5, -0.25]
    log_likelihood = np.zeros((5, 2**13))
    for band in range(2):
        residual = received[:, None, band] - p.mean(points, band)
        solved = np.linalg.solve(p.covariance(band, spatial[band]), residual[..., None])[..., 0]
        log_likelihood -= np.sum(residual.conj() * solved, axis=2).real
    weights = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    for row, weight in enumerate(weights):
        expected = np.average(points, axis=0, weights=weight)
        np.testing.assert_allclose(estimate.mean[row], expected, atol=1e-3)
        np.testing.assert_allclose(
            estimate.covariance[row], np.cov(points.T, aweights=weight, ddof=0), atol=1e-3)
