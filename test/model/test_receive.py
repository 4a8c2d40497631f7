"""Received signals of a positioning phase."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import MeasurementModel, receive, simulate_received

N_PHASES = 1500


def test_received_signal_is_the_sum_over_the_elements():
    rng = np.random.default_rng(1)
    n_subbands, n_frames, n_elements, symbol = 3, 2, 4, 0.6 - 1.1j
    los = rng.normal(size=(2, n_subbands, n_elements, 2)) @ [1, 1j]
    multipath = rng.normal(size=(2, n_subbands * n_frames, n_elements, 2)) @ [1, 1j]
    radiation = rng.normal(size=(n_subbands * n_frames, n_elements, 2)) @ [1, 1j]
    noise = rng.normal(size=(2, n_subbands * n_frames, 2)) @ [1, 1j]
    received = receive.received_signal(los, multipath, radiation, noise, symbol)
    direct = receive.received_signal(los, 0.0, radiation, 0.0)
    for n in range(2):
        for j in range(n_subbands):
            for q in range(n_frames):
                row = j * n_frames + q
                alone = sum(los[n, j, m] * radiation[row, m] for m in range(n_elements))
                scattered = sum(
                    multipath[n, row, m] * radiation[row, m] for m in range(n_elements))
                np.testing.assert_allclose(direct[n, row], alone, rtol=1e-12)
                np.testing.assert_allclose(
                    received[n, row], (alone + scattered) * symbol + noise[n, row], rtol=1e-12)


def test_simulated_signals_have_the_vectors_mean_and_covariance(case):
    """Deviations whitened by the vectors' covariance are white to the accuracy of the sample."""
    position = case.vectors['positions'][2]
    received = simulate_received(
        case.scenario, case.codebook, np.tile(position, (N_PHASES, 1)), np.random.default_rng(2))
    n_bands, n_rows = case.vectors['cov'].shape[:2]
    assert received.shape == (N_PHASES, n_bands, n_rows)
    whitened = []
    for band, covariance in enumerate(case.vectors['cov']):
        deviation = received[:, band] - case.vectors['mean'][band, 2]
        whitened.append(np.linalg.solve(np.linalg.cholesky(covariance), deviation.T))
    # Stacking the bands also checks that they are independent.
    white = np.concatenate(whitened)
    limit = 5.0 / np.sqrt(N_PHASES)
    assert np.abs(white @ white.conj().T / N_PHASES - np.eye(len(white))).max() < limit
    assert np.abs(white @ white.T / N_PHASES).max() < limit * np.sqrt(2)
    assert np.abs(white.mean(axis=1)).max() < limit


def test_simulated_noise_alone_has_its_power(small):
    """With a negligible antenna gain, only the thermal noise remains."""
    attenuated = dataclasses.replace(small.scenario, user_gain=1e-6)
    received = simulate_received(
        attenuated, small.codebook, np.tile([10.0, 0, 0], (N_PHASES, 1)), np.random.default_rng(3))
    sample = received[:, 0].T @ received[:, 0].conj() / N_PHASES
    expected = float(small.vectors['noise_power']) * np.eye(6)
    assert np.abs(sample - expected).max() < 5 / np.sqrt(N_PHASES) * expected[0, 0]


def test_simulation_is_reproducible_and_follows_its_positions(small):
    positions = small.scenario.sample_positions(300, np.random.default_rng(4))
    one, same, other = (
        simulate_received(small.scenario, small.codebook, positions, np.random.default_rng(seed))
        for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, same)
    assert not np.isclose(one, other).any()
    # 300 positions make two blocks; each signal belongs to its own position.
    mean = MeasurementModel(small.scenario, small.codebook).mean(positions)
    whitener = np.linalg.inv(np.linalg.cholesky(small.vectors['cov'][0]))
    energy = np.sum(np.abs((one - mean)[:, 0] @ whitener.T)**2, axis=1)
    assert energy.mean() == pytest.approx(6, abs=5 * np.sqrt(6 / 300))


def test_receive_feeds_combines_every_measurement(small):
    """Feed signals are [N_B, F, N_SB, K], and received signals [N_B, N_SB, F]."""
    rng = np.random.default_rng(7)
    digital = small.codebook.digital
    feeds = rng.normal(size=(1, 2, 3, 2, 2)) @ [1, 1j]
    received = receive.receive_feeds(small.scenario, small.codebook, feeds, None)
    assert received.shape == (1, 3, 2)
    for j in range(3):
        for q in range(2):
            expected = sum(digital[0, j, q, k] * feeds[0, q, j, k] for k in range(2))
            np.testing.assert_allclose(received[0, j, q], expected, rtol=1e-12)


def test_receive_feeds_adds_thermal_noise(small):
    rng, zeros = np.random.default_rng(8), np.zeros((1, 2, 3, 2))
    noise = np.array([receive.receive_feeds(small.scenario, small.codebook, zeros, rng).ravel()
                      for _ in range(N_PHASES)])
    sample = noise.T @ noise.conj() / N_PHASES
    expected = float(small.vectors['noise_power']) * np.eye(6)
    assert np.abs(sample - expected).max() < 5 / np.sqrt(N_PHASES) * expected[0, 0]


@pytest.mark.parametrize('positions', [[10.0, 0.0, 0.0], [[10.0, 0.0]], [[10.0, 0.0, np.nan]]])
def test_malformed_positions_are_errors(small, positions):
    with pytest.raises(ValueError, match='^positions: .*, expected '):
        simulate_received(
            small.scenario, small.codebook, np.array(positions), np.random.default_rng(0))
