"""Simulated walks, for the benchmark of tracks."""

import numpy as np
from benchmarks.tracking import SPEED_MPS, simulate_walks

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.multipath import time_correlation

PERIOD_S = 4e-3


def test_signals_have_the_covariance_of_the_model_and_the_correlation_of_equation_4(random_beams):
    scenario = Scenario(n_subbands=2, n_frames=2, elements_per_side=3)
    codebook = random_beams(scenario, np.random.default_rng(0))
    positions, signals = simulate_walks(scenario, codebook, 4000, PERIOD_S * np.arange(3), 1)
    steps = np.linalg.norm(np.diff(positions, axis=1), axis=2)
    # Walks that turn within a step cover a shorter distance.
    np.testing.assert_allclose(np.median(steps), PERIOD_S * SPEED_MPS)
    assert steps.max() < PERIOD_S * SPEED_MPS * (1 + 1e-9)
    model = MeasurementModel(scenario, codebook)
    white = model.whiten(signals - model.mean(positions.reshape(-1, 3)).reshape(signals.shape))
    for band in range(scenario.n_bands):
        rho = time_correlation(scenario, PERIOD_S)[band]
        for lag, expected in ((0, 1.0), (1, rho), (2, rho**2)):
            product = np.mean(white[:, lag, band] * white[:, 0, band].conj(), axis=0)
            np.testing.assert_allclose(product, np.full(4, expected), atol=0.07)
