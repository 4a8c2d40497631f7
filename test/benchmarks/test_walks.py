"""Simulated walks, for the benchmark of tracks."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.multipath import time_correlation

FILE = Path(__file__).parents[2] / 'scripts' / 'benchmarks' / 'parts' / 'walks.py'
PERIOD_S = 4e-3


@pytest.fixture(scope='module')
def simulate_walks():
    spec = importlib.util.spec_from_file_location('walks', FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.simulate_walks


def test_signals_have_the_covariance_of_the_model_and_the_correlation_of_equation_4(
        simulate_walks, random_beams):
    scenario = Scenario(n_subbands=2, n_frames=2, elements_per_side=3)
    codebook = random_beams(scenario, np.random.default_rng(0))
    walks = simulate_walks(scenario, codebook, 4000, 3, PERIOD_S, 1.0, 1)
    steps = np.linalg.norm(np.diff(walks.positions, axis=1), axis=2)
    # Walks that turn within a step cover a shorter distance.
    np.testing.assert_allclose(np.median(steps), PERIOD_S)
    assert steps.max() < PERIOD_S * (1 + 1e-9)
    np.testing.assert_allclose(walks.times_s, PERIOD_S * np.arange(3))
    model = MeasurementModel(scenario, codebook)
    mean = model.mean(walks.positions.reshape(-1, 3)).reshape(walks.signals.shape)
    white = model.whiten(walks.signals - mean)
    for band in range(scenario.n_bands):
        rho = time_correlation(scenario, PERIOD_S)[band]
        for lag, expected in ((0, 1.0), (1, rho), (2, rho**2)):
            product = np.mean(white[:, lag, band] * white[:, 0, band].conj(), axis=0)
            np.testing.assert_allclose(product, np.full(4, expected), atol=0.07)
