"""The modes with their probabilities, compared with the estimate."""

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario, simulate_received
from rhs_isac_ros.positioning.weighted_modes import weighted_modes

N_PHASES = 12


@pytest.fixture(scope='module')
def phases(shipped):
    rng = np.random.default_rng(5)
    positions = Scenario().sample_positions(N_PHASES, rng)
    return simulate_received(Scenario(), shipped, positions, rng)


def test_the_mixture_has_the_moments_of_the_estimate(table1_estimator, phases):
    for received in phases:
        modes = weighted_modes(table1_estimator, received)
        estimate = table1_estimator.estimate(received)
        assert modes.probabilities.sum() == pytest.approx(1)
        assert (np.diff(modes.probabilities) <= 0).all()
        mean = modes.probabilities @ modes.positions
        assert mean == pytest.approx(estimate.mean, abs=1e-9)
        offsets = modes.positions - mean
        covariance = np.einsum(
            'm,mab->ab', modes.probabilities,
            modes.covariances + offsets[:, :, None] * offsets[:, None, :])
        # The estimate adds the uncertainty of the mean of the samples.
        added = estimate.covariance - covariance
        assert np.linalg.eigvalsh(added).min() > -1e-9
        assert np.trace(added) < 0.1 * np.trace(covariance)


def test_the_modes_are_the_range_ambiguities_of_the_bands(table1_estimator, phases):
    """Two bands 0.5 GHz apart repeat every 0.6 m; single bands every 0.1 m."""
    gaps = []
    for received in phases:
        modes = weighted_modes(table1_estimator, received)
        ranges = np.sort(np.linalg.norm(modes.positions[modes.probabilities > 0.05], axis=1))
        gaps += np.diff(ranges).tolist()
    assert np.median([gap for gap in gaps if gap > 0.3]) == pytest.approx(0.6, abs=0.06)


def test_signals_without_a_position_have_no_modes(table1_estimator, phases):
    assert weighted_modes(table1_estimator, np.zeros_like(phases[0])) is None
