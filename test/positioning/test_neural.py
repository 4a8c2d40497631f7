"""The neural estimator and its training."""

import dataclasses
import json
import sys

import numpy as np
import pytest
import yaml

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning import (
    ModelError,
    Network,
    NeuralEstimator,
    make_estimator,
    neural,
    train,
)
from rhs_isac_ros.positioning.__main__ import main
from rhs_isac_ros.support.optional import MissingLibraryError
from rhs_isac_ros.system import System

pytest.importorskip('sklearn')
PAIRS = 6000


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    """A region with nearly one range, and strong signals, which is quick to learn."""
    return Scenario(n_subbands=2, n_frames=4, elements_per_side=4, angular_spread_deg=2.0,
                    roi_center_m=(3, 0, 0), roi_size_m=(0.1, 1, 0.5))


@pytest.fixture(scope='module')
def codebook(scenario, random_beams):
    return random_beams(scenario, np.random.default_rng(0))


@pytest.fixture(scope='module')
def training(scenario, codebook):
    """A trained network, and the epochs that were reported."""
    epochs = []
    network = train(scenario, codebook, PAIRS, 1, 32, 30, lambda *epoch: epochs.append(epoch))
    return network, epochs


def mse(network, scenario, codebook, first, n):
    positions, received = System(scenario, codebook).pairs(n, 1, first)
    estimate = NeuralEstimator(System(scenario, codebook), network).estimate(received)
    return np.mean(np.sum((estimate.mean - positions)[estimate.fix]**2, axis=1))


@pytest.mark.slow
def test_training_reduces_the_error(scenario, codebook, training):
    network, epochs = training
    spread = np.sum(np.array(scenario.roi_size_m)**2) / 12
    error = mse(network, scenario, codebook, PAIRS, 2000)
    assert error < 0.25 * spread
    assert network.about['test_mse_m2'] == pytest.approx(error, rel=0.25)
    assert [number for number, _ in epochs] == list(range(1, len(epochs) + 1))
    assert epochs[-1][1] < 0.5 * epochs[0][1]


@pytest.mark.slow
def test_the_pairs_are_split_7_to_1_5_to_1_5(scenario, codebook, training):
    network, epochs = training
    first, second = int(0.7 * PAIRS), int(0.85 * PAIRS)
    received = System(scenario, codebook).pairs(PAIRS, 1)[1].reshape(PAIRS, -1)
    parts = np.hstack([received.real, received.imag])[:first]
    np.testing.assert_allclose(network.input_mean, parts.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(network.input_scale, parts.std(axis=0))
    about = network.about
    for key, begin, end in (('validation_mse_m2', first, second), ('test_mse_m2', second, PAIRS)):
        assert about[key] == pytest.approx(
            mse(network, scenario, codebook, begin, end - begin), rel=1e-4)
    best, least = min(epochs, key=lambda epoch: epoch[1])
    assert about['epochs'] == best
    assert about['validation_mse_m2'] == least


def test_the_covariance_matches_the_validation_residuals(scenario, codebook, training):
    first, n = int(0.7 * PAIRS), int(0.85 * PAIRS) - int(0.7 * PAIRS)
    positions, received = System(scenario, codebook).pairs(n, 1, first)
    estimate = make_estimator(
        'neural', scenario, codebook, model_file=training[0]).estimate(received)
    residuals = estimate.mean - positions
    np.testing.assert_allclose(estimate.covariance[5], residuals.T @ residuals / n, rtol=1e-3,
                               atol=1e-6)
    assert (estimate.covariance == estimate.covariance[0]).all()


def test_a_network_of_magnitudes_locates_signals_of_any_phase(scenario, codebook):
    network = train(scenario, codebook, 600, 4, 8, 2, inputs='magnitudes')
    assert len(network.w_in) == scenario.n_bands * scenario.n_subbands * scenario.n_frames
    received = System(scenario, codebook).pairs(5, 9)[1]
    estimator = NeuralEstimator(System(scenario, codebook), network)
    np.testing.assert_allclose(
        estimator.estimate(-received).mean, estimator.estimate(received).mean, rtol=1e-12)


def test_networks_are_reproducible_by_their_seed(scenario, codebook):
    # Numbers of NumPy are numbers.
    first, same, other = (train(scenario, codebook, n_pairs, seed, 8, 2) for n_pairs, seed in (
        (600, 4), (np.int16(600), np.int64(4)), (600, 5)))
    np.testing.assert_array_equal(first.w_in, same.w_in)
    np.testing.assert_array_equal(first.w_out, same.w_out)
    assert not np.isclose(first.w_in, other.w_in).all()


@pytest.mark.slow
def test_batches_grow_and_training_stops_when_the_validation_error_does_not_fall(
        scenario, codebook, monkeypatch):
    sizes, epochs, make = [], [], neural._regressor

    def recorded(*arguments):
        regressor = make(*arguments)
        fit = regressor.partial_fit

        def partial_fit(inputs, targets):
            sizes.append(regressor.batch_size)
            return fit(inputs, targets)
        regressor.partial_fit = partial_fit
        return regressor
    monkeypatch.setattr(neural, '_regressor', recorded)
    network = train(scenario, codebook, 300, 0, 64, 2000, lambda *epoch: epochs.append(epoch))
    assert network.about['epochs'] + 4 <= len(epochs) < 2000
    # 210 pairs are for training.
    assert list(dict.fromkeys(sizes)) == [128, 210]


@pytest.mark.parametrize(('factor', 'message'), [
    (0.0, 'expected at least'), (1e-3, 'expected at least'), (100.0, 'expected at most')])
def test_signals_too_weak_or_too_strong_give_no_fix(scenario, codebook, training, factor, message):
    received = factor * System(scenario, codebook).pairs(5, 9)[1]
    estimate = NeuralEstimator(System(scenario, codebook), training[0]).estimate(received)
    assert not estimate.fix.any()
    assert np.isnan(estimate.mean).all()
    assert np.isnan(estimate.covariance).all()
    assert all(message in reason for reason in estimate.reason)


def test_a_model_of_another_purpose_is_rejected(
        scenario, codebook, training, random_beams, tmp_path):
    network = training[0]
    other = random_beams(scenario, np.random.default_rng(1))
    network.save(tmp_path / 'model.npz')
    with np.load(tmp_path / 'model.npz') as arrays:
        assert json.loads(str(arrays['about']))['format'] == 1
    for model, message in ((network, '^model: trained for codebook'),
                           (tmp_path / 'model.npz', 'model.npz: trained for codebook')):
        with pytest.raises(ModelError, match=f'{message} {codebook.id}, expected {other.id}'):
            make_estimator('neural', scenario, other, model_file=model)
    noisier = dataclasses.replace(scenario, noise_psd_dbm_hz=-160.0)
    with pytest.raises(ModelError, match='trained for the scenario .*expected .*-160'):
        make_estimator('neural', noisier, codebook, model_file=network)
    short = Network(network.input_mean[1:], network.input_scale[1:], network.w_in[1:],
                    *(getattr(network, f.name) for f in dataclasses.fields(network)[3:]))
    with pytest.raises(ModelError, match='31 inputs, expected 32'):
        make_estimator('neural', scenario, codebook, model_file=short)
    with pytest.raises(ModelError, match="model_file: '', expected"):
        make_estimator('neural', scenario, codebook)


@pytest.mark.parametrize(('options', 'message'), [
    ({'n_pairs': 19}, 'n_pairs: 19, expected at least 20'),
    ({'n_hidden': 0}, 'n_hidden: 0'), ({'max_epochs': 0}, 'max_epochs: 0'),
    ({'inputs': 'phases'}, "inputs: 'phases', expected one of")])
def test_invalid_options_are_errors(scenario, codebook, options, message):
    with pytest.raises(ValueError, match=message):
        train(scenario, codebook, **options)


def test_training_without_scikit_learn_is_an_error_that_names_it(scenario, codebook, monkeypatch):
    for name in [name for name in sys.modules if name.partition('.')[0] == 'sklearn']:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'sklearn', None)
    with pytest.raises(MissingLibraryError, match=r"needs sklearn, .* 'rhs_isac_ros\[neural\]'"):
        train(scenario, codebook, 100)


@pytest.fixture
def files(tmp_path, scenario, codebook):
    (tmp_path / 'scenario.yaml').write_text(yaml.safe_dump(scenario.changes()))
    codebook.save(tmp_path / 'codebook.yaml')
    return tmp_path


def test_the_command_writes_the_network_that_train_returns(
        files, scenario, codebook, capsys, monkeypatch):
    monkeypatch.setattr('rhs_isac_ros.support.progress._LINE_S', 0.0)
    arguments = ['--codebook', files / 'codebook.yaml', '--scenario', files / 'scenario.yaml',
                 '--pairs', 600, '--hidden', 8, '--epochs', 2, '--seed', 4, '--output',
                 files / 'model.npz']
    assert main(list(map(str, arguments))) == 0
    expected = train(scenario, codebook, 600, 4, 8, 2)
    written = Network.load(files / 'model.npz')
    np.testing.assert_array_equal(written.w_in, expected.w_in)
    assert written.about == expected.about
    out, err = capsys.readouterr()
    assert f'{expected.about["test_mse_m2"]:.3f} m^2 in the test' in out
    assert 'epoch 2 of 2' in err


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--codebook', 'no.yaml'], 'no.yaml'),
    (['--codebook', 'codebook.yaml', '--scenario', 'scenario.yaml', '--pairs', '3'], '--pairs'),
    (['--codebook', 'codebook.yaml'], 'analog: shape'),
    (['--codebook', 'codebook.yaml', '--output', 'no/model.npz'], 'no/model.npz: expected')])
def test_the_command_reports_errors(files, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(files)
    try:
        code = main([*arguments, '--quiet'])
    except SystemExit as exit:
        code = exit.code
    assert code == 2
    err = capsys.readouterr().err
    assert 'error: ' in err
    assert message in err
    assert not (files / 'model.npz').exists()
