"""Distribution and simulation of the received signals."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import (
    GainPattern,
    MeasurementModel,
    Scenario,
    simulate_received,
)
from rhs_isac_ros.model.geometry import frame_times_s
from rhs_isac_ros.model.los import los_and_derivative
from rhs_isac_ros.model.measurement import direct_signal, receive_feeds, received_signal
from rhs_isac_ros.model.multipath import multipath_covariance

POSITION_METHODS = ('mean', 'mean_and_jacobian')
N_PHASES = 1500


@pytest.fixture(scope='module')
def model(case) -> MeasurementModel:
    return MeasurementModel(case.scenario, case.codebook)


@pytest.fixture(scope='module')
def faded(random_beams):
    """Three bands whose sub-bands and frames are far from fully correlated."""
    scenario = Scenario(
        center_frequencies_hz=(1.2e9, 2e9, 3.1e9), n_subbands=2, n_frames=3, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-3, noise_psd_dbm_hz=-150,
        roi_center_m=(3, 0, 0), roi_size_m=(2, 4, 2))
    return scenario, random_beams(scenario, np.random.default_rng(0))


def test_covariance_matches_the_vectors(case, model):
    scale = np.abs(case.vectors['cov']).max()
    np.testing.assert_allclose(
        model.covariance(), case.vectors['cov'], rtol=1e-8, atol=1e-8 * scale)


def test_covariance_matches_the_definition_for_low_correlation(faded, plain):
    scenario, codebook = faded
    p = plain(scenario, codebook.analog, codebook.digital)
    spatial = multipath_covariance(scenario)
    covariance = MeasurementModel(scenario, codebook).covariance()
    for band in range(3):
        expected = p.covariance(band, spatial[band])
        np.testing.assert_allclose(
            covariance[band], expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_whitener_whitens_the_covariance_of_the_vectors(case, model):
    for whitener, covariance in zip(model.whitener, case.vectors['cov'], strict=True):
        white = whitener @ covariance @ whitener.conj().T
        np.testing.assert_allclose(white, np.eye(len(white)), atol=1e-8)
        assert np.abs(np.triu(whitener, 1)).max() < 1e-12 * np.abs(whitener).max()


@pytest.mark.parametrize('leading', [(), (5,), (2, 3)], ids=str)
def test_whiten_applies_the_whitener_of_each_band(model, leading):
    signals = np.random.default_rng(0).normal(size=(*leading, *model.shape, 2)) @ [1, 1j]
    whitened = model.whiten(signals)
    assert whitened.shape == signals.shape
    for band, whitener in enumerate(model.whitener):
        expected = signals[..., band, :] @ whitener.T
        np.testing.assert_allclose(
            whitened[..., band, :], expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_mean_matches_the_vectors(case, model):
    mean = model.mean(case.vectors['positions'])
    np.testing.assert_allclose(mean, np.moveaxis(case.vectors['mean'], 0, 1), rtol=1e-8)


@pytest.mark.parametrize('method', POSITION_METHODS)
def test_result_does_not_depend_on_the_blocks(case, model, method):
    """A block has at most 1024 positions."""
    positions = case.vectors['positions']
    repeats = 2100 // len(positions) + 1
    # The mean is a single array.
    expected, actual = (found if isinstance(found, tuple) else [found] for found in (
        getattr(model, method)(positions),
        getattr(model, method)(np.tile(positions, (repeats, 1)))))
    for one, other in zip(actual, expected, strict=True):
        np.testing.assert_allclose(
            one, np.tile(other, (repeats, *[1] * (other.ndim - 1))), rtol=0,
            atol=1e-12 * np.abs(other).max())


def test_mean_and_jacobian_match_the_mean_and_its_differences(faded, plain):
    scenario, codebook = faded
    p = plain(scenario, codebook.analog, codebook.digital)
    model, step = MeasurementModel(scenario, codebook), 1e-5
    positions = scenario.sample_positions(2, np.random.default_rng(2))
    mean, jacobian = model.mean_and_jacobian(positions)
    np.testing.assert_allclose(
        mean, model.mean(positions), rtol=0, atol=1e-9 * np.abs(mean).max())
    assert jacobian.shape == (2, 3, 3, 6)
    for band in range(3):
        for u in range(3):
            shift = step * np.eye(3)[u]
            difference = (p.mean(positions + shift, band)
                          - p.mean(positions - shift, band)) / (2 * step)
            np.testing.assert_allclose(
                jacobian[:, u, band], difference, rtol=0,
                atol=1e-7 * np.abs(jacobian[:, :, band]).max())


PATTERNS = {
    'constant gains': {},
    'element pattern': {'element_gain': GainPattern(lambda angles: np.exp(-angles**2))},
    'user pattern': {'user_gain': GainPattern(lambda angles: 1 + np.cos(angles))},
    'both patterns': {'element_gain': GainPattern(lambda angles: np.exp(-angles**2)),
                      'user_gain': GainPattern(lambda angles: 1 + np.cos(angles))}}


def by_elements(model, positions):
    """Mean and derivative as sums over the gains of all elements."""
    shape = model.scenario.n_subbands, model.scenario.n_frames, -1
    sums = [[np.einsum('...jm,jqm->...jq', gains, radiation.reshape(shape)).reshape(
        *gains.shape[:-2], -1) for gains in los_and_derivative(model.scenario, positions, band)]
        for band, radiation in enumerate(model.radiation)]
    return [np.stack(parts, axis=-2) for parts in zip(*sums, strict=True)]


@pytest.mark.parametrize('gains', PATTERNS.values(), ids=PATTERNS.keys())
@pytest.mark.parametrize(('n', 'n_frames'), [(1, 3), (300, 3), (2, 1)])
def test_mean_and_jacobian_are_sums_over_the_elements(faded, random_beams, gains, n, n_frames):
    scenario = dataclasses.replace(faded[0], n_frames=n_frames, **gains)
    model = MeasurementModel(scenario, random_beams(scenario, np.random.default_rng(0)))
    positions = scenario.sample_positions(n, np.random.default_rng(3))
    np.testing.assert_array_equal(
        model.mean(positions), model.mean_and_jacobian(positions)[0])
    for actual, expected in zip(model.mean_and_jacobian(positions),
                                by_elements(model, positions), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def assert_distributed_as_vectors(signals, case):
    """Deviations whitened by the vectors' covariance are white to the accuracy of the sample."""
    whitened = []
    for band, covariance in enumerate(case.vectors['cov']):
        deviation = signals[:, band] - case.vectors['mean'][band, 2]
        whitened.append(np.linalg.solve(np.linalg.cholesky(covariance), deviation.T))
    # Stacking the bands also checks that they are independent.
    white = np.concatenate(whitened)
    n = len(signals)
    limit = 5.0 / np.sqrt(n)
    assert np.abs(white @ white.conj().T / n - np.eye(len(white))).max() < limit
    assert np.abs(white @ white.T / n).max() < limit * np.sqrt(2)
    assert np.abs(white.mean(axis=1)).max() < limit


def simulated(case, positions, seed):
    return simulate_received(
        case.scenario, case.codebook, positions, np.random.default_rng(seed))


def sampled(case, positions, seed):
    model = MeasurementModel(case.scenario, case.codebook)
    return model.sample(positions, np.random.default_rng(seed))


@pytest.mark.parametrize(('draw', 'n'), [(simulated, N_PHASES), (sampled, 20_000)])
def test_both_simulations_have_the_mean_and_covariance_of_the_vectors(case, draw, n):
    position = case.vectors['positions'][2]
    signals = draw(case, np.tile(position, (n, 1)), 4)
    assert signals.shape == (n, *case.vectors['cov'].shape[:2])
    assert_distributed_as_vectors(signals, case)


@pytest.mark.parametrize('draw', [simulated, sampled])
def test_each_drawn_signal_belongs_to_its_position(case, model, draw):
    """300 positions make two blocks."""
    positions = case.scenario.sample_positions(300, np.random.default_rng(5))
    signals, same, other = (draw(case, positions, seed) for seed in (6, 6, 7))
    np.testing.assert_array_equal(signals, same)
    assert not np.isclose(signals, other).any()
    energy = np.sum(np.abs(model.whiten(signals - model.mean(positions)))**2, axis=(1, 2))
    n = np.prod(model.shape)
    assert energy.mean() == pytest.approx(n, abs=5 * np.sqrt(n / 300))


def test_prepare_leaves_nothing_to_compute(case):
    model = MeasurementModel(case.scenario, case.codebook)
    assert model.prepare() is model
    before = dict(vars(model))
    model.sample(case.vectors['positions'], np.random.default_rng(7))
    assert vars(model) == before
    assert {'combined_root', 'combined_whitener', '_weights'} <= before.keys()


@pytest.mark.parametrize('pattern', [
    1.0, GainPattern(lambda angles: np.maximum(np.cos(angles), 0.1))], ids=['constant', 'pattern'])
def test_each_frame_of_a_moving_user_is_that_of_a_user_who_stands_there(faded, pattern):
    scenario, codebook = faded
    scenario = dataclasses.replace(scenario, element_gain=pattern, retune_s=0.02)
    model, rng = MeasurementModel(scenario, codebook), np.random.default_rng(1)
    states = np.hstack([scenario.sample_positions(4, rng), 20 * rng.standard_normal((4, 3))])
    mean, slopes = model.mean_and_jacobian(states)
    simulated = simulate_received(
        dataclasses.replace(scenario, multipath_to_los_db=-200, noise_psd_dbm_hz=-390),
        codebook, states, rng)
    shape = 4, 3, 2, 3
    for (band, frame), time_s in np.ndenumerate(frame_times_s(scenario)):
        places = states[:, :3] + time_s * states[:, 3:]
        still, by_place = model.mean_and_jacobian(places)
        expected = still.reshape(shape)[:, band, :, frame]
        for signals, tolerance in ((mean, 1e-12), (simulated, 1e-6)):
            np.testing.assert_allclose(
                signals.reshape(shape)[:, band, :, frame], expected, rtol=tolerance)
        by_place = by_place.reshape(4, 3, *shape[1:])[:, :, band, :, frame]
        np.testing.assert_allclose(
            slopes.reshape(4, 6, *shape[1:])[:, :, band, :, frame],
            np.concatenate([by_place, time_s * by_place], axis=1),
            rtol=1e-9, atol=1e-9 * np.abs(by_place).max())
    white, white_slopes = model.mean_and_jacobian(states, np.ones((4, 6, 1)), whitened=True)
    np.testing.assert_allclose(white, model.whiten(mean), atol=1e-9 * np.abs(white).max())
    np.testing.assert_allclose(white_slopes[:, 0], model.whiten(slopes.sum(axis=1)),
                               atol=1e-9 * np.abs(white_slopes).max())


def test_declared_velocities_are_drawn(faded):
    """Only along axes with an extent of the region."""
    scenario, codebook = faded
    scenario = dataclasses.replace(
        scenario, user_speed_std_mps=20.0, roi_size_m=(2, 4, 0), multipath_to_los_db=-200,
        noise_psd_dbm_hz=-390)
    positions = scenario.sample_positions(3, np.random.default_rng(0))
    velocities = np.random.default_rng(1).standard_normal((3, 3)) * [20, 20, 0]
    model = MeasurementModel(scenario, codebook)
    expected = model.mean(np.hstack([positions, velocities]))
    for signals in (model.sample(positions, np.random.default_rng(1)), simulate_received(
            scenario, codebook, positions, np.random.default_rng(1))):
        np.testing.assert_allclose(signals, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_no_positions_have_no_signals(model):
    empty = np.zeros((0, 3))
    assert model.mean(empty).shape == (0, *model.shape)
    assert [part.shape for part in model.mean_and_jacobian(empty)] == [
        (0, *model.shape), (0, 3, *model.shape)]


def test_beamforming_of_another_size_is_an_error(small):
    scenario = dataclasses.replace(small.scenario, elements_per_side=3)
    with pytest.raises(ValueError, match='^analog: shape '):
        MeasurementModel(scenario, small.codebook)
    with pytest.raises(ValueError, match='^digital: shape '):
        MeasurementModel(dataclasses.replace(small.scenario, n_feeds=1), small.codebook)


def test_received_signal_is_the_sum_over_the_elements():
    rng = np.random.default_rng(1)
    n_subbands, n_frames, n_elements, symbol = 3, 2, 4, 0.6 - 1.1j
    los = rng.normal(size=(2, n_subbands, n_elements, 2)) @ [1, 1j]
    multipath = rng.normal(size=(2, n_subbands * n_frames, n_elements, 2)) @ [1, 1j]
    radiation = rng.normal(size=(n_subbands * n_frames, n_elements, 2)) @ [1, 1j]
    noise = rng.normal(size=(2, n_subbands * n_frames, 2)) @ [1, 1j]
    received = received_signal(direct_signal(los, radiation), multipath, radiation, noise, symbol)
    direct = direct_signal(los, radiation)
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


def test_receive_feeds_combines_every_measurement(small):
    """Feed signals are [N_B, F, N_SB, K], and received signals [N_B, N_SB, F]."""
    rng = np.random.default_rng(7)
    digital = small.codebook.digital
    feeds = rng.normal(size=(1, 2, 3, 2, 2)) @ [1, 1j]
    received = receive_feeds(small.scenario, small.codebook, feeds, None)
    assert received.shape == (1, 3, 2)
    for j in range(3):
        for q in range(2):
            expected = sum(digital[0, j, q, k] * feeds[0, q, j, k] for k in range(2))
            np.testing.assert_allclose(received[0, j, q], expected, rtol=1e-12)


def test_receive_feeds_adds_thermal_noise(small):
    rng, zeros = np.random.default_rng(8), np.zeros((1, 2, 3, 2))
    noise = np.array([receive_feeds(small.scenario, small.codebook, zeros, rng).ravel()
                      for _ in range(N_PHASES)])
    sample = noise.T @ noise.conj() / N_PHASES
    expected = float(small.vectors['noise_power']) * np.eye(6)
    assert np.abs(sample - expected).max() < 5 / np.sqrt(N_PHASES) * expected[0, 0]
