"""Receivers of the benchmark `baselines`: their bound and their posterior mean."""

import numpy as np
import pytest
from benchmarks.baselines import ArrayReceiver, posterior_means

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.model.surface import radiation_matrix
from rhs_isac_ros.positioning import make_estimator

# A small system and region.
SCENARIO = Scenario(
    n_subbands=2, n_frames=4, elements_per_side=4, angular_spread_deg=2.0, roi_center_m=(3, 0, 0),
    roi_size_m=(1, 1, 0.5))


@pytest.fixture(scope='module')
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(0))


@pytest.fixture(scope='module')
def weights(codebook):
    """The weights of the elements in the signals of the surface."""
    return radiation_matrix(SCENARIO, codebook).reshape(2, 2, 4, 16)


@pytest.fixture(scope='module')
def surface(weights):
    return ArrayReceiver(SCENARIO, weights, np.arange(4))


def test_the_bound_of_the_surface_is_that_of_the_library(surface, codebook):
    positions = SCENARIO.sample_positions(20, np.random.default_rng(1))
    np.testing.assert_allclose(
        surface.crlb(positions), crlb(SCENARIO, codebook, positions), rtol=1e-4)


def test_the_posterior_mean_is_as_accurate_as_bayes(surface, codebook):
    positions = SCENARIO.sample_positions(150, np.random.default_rng(1))
    received = surface.simulate(positions, np.random.default_rng(2))
    own = np.sum((posterior_means(surface, received) - positions)**2, axis=1)
    signals = simulate_received(SCENARIO, codebook, positions, np.random.default_rng(3))
    estimate = make_estimator('bayes', SCENARIO, codebook).estimate(signals)
    other = np.sum((estimate.mean - positions)[estimate.fix]**2, axis=1)
    spread = np.hypot(own.std(), other.std()) / np.sqrt(150)
    assert abs(own.mean() - other.mean()) < 4 * spread
    assert own.mean() < 0.5 * np.sum(np.array(SCENARIO.roi_size_m)**2) / 12


def test_all_elements_have_a_lower_bound_than_any_of_their_combinations(surface, weights):
    everything = ArrayReceiver(
        SCENARIO, np.abs(weights).max() * np.eye(16), np.zeros(16, int), 4)
    positions = SCENARIO.sample_positions(20, np.random.default_rng(1))
    assert (everything.crlb(positions) < surface.crlb(positions)).all()
