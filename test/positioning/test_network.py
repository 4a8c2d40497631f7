"""The network and its file."""

import dataclasses
import json

import numpy as np
import pytest

from rhs_isac_ros.positioning import ModelError, Network


@pytest.fixture
def network():
    rng = np.random.default_rng(0)
    return Network(
        rng.normal(size=8), rng.uniform(1, 2, 8), rng.normal(size=(8, 5)), rng.normal(size=5),
        rng.normal(size=(5, 3)), rng.normal(size=3), np.array([10.0, 0, 0]), np.eye(3), 500.0,
        {'codebook': 'cb0', 'scenario': {'n_feeds': 2}, 'seed': 3, 'test_mse_m2': 1.25})


def test_positions_match_the_formula(network):
    rng = np.random.default_rng(1)
    received = rng.normal(size=(6, 2, 2, 2)) @ [1, 1j]
    expected = []
    for y in received:
        x = [*y.ravel().real, *y.ravel().imag]
        x = [(a - m) / s for a, m, s in zip(x, network.input_mean, network.input_scale,
                                            strict=True)]
        hidden = [max(0.0, sum(x[d] * network.w_in[d, h] for d in range(8)) + network.b_in[h])
                  for h in range(5)]
        expected.append([sum(hidden[h] * network.w_out[h, u] for h in range(5))
                         + network.b_out[u] + network.center[u] for u in range(3)])
    np.testing.assert_allclose(network.positions(received), expected, rtol=1e-12)


def test_positions_from_magnitudes_do_not_depend_on_phases(network):
    rng = np.random.default_rng(1)
    received = rng.normal(size=(6, 2, 4, 2)) @ [1, 1j]
    by_magnitude = dataclasses.replace(network, inputs='magnitudes')
    rotated = received * np.exp(1j * rng.uniform(0, 6, received.shape))
    np.testing.assert_allclose(
        by_magnitude.positions(rotated), by_magnitude.positions(received), rtol=1e-12)
    as_parts = np.abs(received.reshape(6, 2, 4))
    np.testing.assert_allclose(
        by_magnitude.positions(received),
        network.positions(as_parts[:, 0] + 1j * as_parts[:, 1]), rtol=1e-12)


@pytest.mark.parametrize('inputs', ['parts', 'magnitudes'])
def test_a_saved_model_can_be_loaded(network, tmp_path, inputs):
    network, path = dataclasses.replace(network, inputs=inputs), tmp_path / 'model.npz'
    network.save(path)
    loaded = Network.load(path)
    for field in dataclasses.fields(Network):
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(network, field.name))
    assert [p.name for p in tmp_path.iterdir()] == ['model.npz']


def test_a_file_without_inputs_takes_real_and_imaginary_parts(network, tmp_path):
    network.save(tmp_path / 'new.npz')
    with np.load(tmp_path / 'new.npz') as file:
        arrays = dict(file)
    about = json.loads(str(arrays['about']))
    del about['inputs']
    np.savez(tmp_path / 'old.npz', **arrays | {'about': json.dumps(about)})
    assert Network.load(tmp_path / 'old.npz').inputs == 'parts'


def test_the_keys_of_the_file_do_not_change(network, tmp_path):
    """Files of format 1 remain readable when a field has another name."""
    path = tmp_path / 'model.npz'
    network.save(path)
    with np.load(path) as file:
        assert file.files == ['input_mean', 'input_scale', 'w_in', 'b_in', 'w_out', 'b_out',
                              'center', 'covariance', 'loudest', 'about']
        assert file['loudest'] == network.max_energy


@pytest.mark.parametrize('damage', [
    lambda path: path.unlink(), lambda path: path.write_bytes(b'no model'),
    lambda path: np.savez(path, a=np.zeros(3))], ids=['missing', 'text', 'other arrays'])
def test_the_error_for_an_invalid_file_names_it(network, tmp_path, damage):
    path = tmp_path / 'model.npz'
    network.save(path)
    damage(path)
    with pytest.raises(ModelError, match='model.npz: '):
        Network.load(path)


@pytest.mark.parametrize(('field', 'value', 'message'), [
    ('b_in', np.zeros(4), r'b_in: shape \(4,\), expected \[5\]'),
    ('w_in', np.zeros(8), 'expected'),
    ('w_out', np.zeros((5, 2)), r'w_out: shape \(5, 2\), expected \[5, 3\]'),
    ('center', np.array([0, np.nan, 0]), 'center: not finite'),
    ('inputs', 'phases', "inputs: 'phases', expected one of")])
def test_inconsistent_arrays_are_errors(network, field, value, message):
    with pytest.raises(ModelError, match=message):
        dataclasses.replace(network, **{field: value})
