"""The network's arithmetic and its file."""

import dataclasses
import io
import os

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


def test_positions_are_those_of_the_formula(network):
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


def test_a_file_gives_the_model_back(network, tmp_path):
    path = tmp_path / 'model.npz'
    network.save(path)
    again = Network.load(path)
    for field in dataclasses.fields(Network):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(network, field.name))
    assert [p.name for p in tmp_path.iterdir()] == ['model.npz']


def test_a_write_that_fails_keeps_the_old_file(network, tmp_path, monkeypatch):
    path = tmp_path / 'model.npz'
    path.write_text('old')

    def replace(source, target):
        raise OSError('disk full')
    monkeypatch.setattr(os, 'replace', replace)
    with pytest.raises(OSError, match='disk full'):
        network.save(path)
    assert path.read_text() == 'old'
    assert len(list(tmp_path.iterdir())) == 1


def damaged(path, place):
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1
    path.write_bytes(content)


def bytes_of(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@pytest.mark.parametrize('damage', [
    lambda path: path.unlink(),
    lambda path: path.write_bytes(b''),
    lambda path: path.write_bytes(b'no model'),
    lambda path: os.truncate(path, path.stat().st_size // 2),
    lambda path: np.savez(path, a=np.zeros(3)),
    lambda path: path.write_bytes(bytes_of(np.zeros(3))),
    lambda path: np.savez(path, about=np.array([{}], object)),
    lambda path: (path.unlink(), path.mkdir()),
], ids=['missing', 'empty', 'text', 'truncated', 'others', 'array', 'pickle', 'folder'])
def test_what_is_no_model_is_an_error_that_names_the_file(network, tmp_path, damage):
    path = tmp_path / 'model.npz'
    network.save(path)
    damage(path)
    with pytest.raises(ModelError, match='model.npz: '):
        Network.load(path)


@pytest.mark.parametrize('place', np.linspace(0.02, 0.98, 25))
def test_a_changed_byte_is_an_error_or_changes_nothing(network, tmp_path, place):
    path = tmp_path / 'model.npz'
    network.save(path)
    damaged(path, place)
    try:
        again = Network.load(path)
    except ModelError:
        return
    for field in dataclasses.fields(Network):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(network, field.name))


@pytest.mark.parametrize(('field', 'value', 'words'), [
    ('b_in', np.zeros(4), r'b_in: shape \(4,\), expected \(5,\)'),
    ('w_in', np.zeros(8), 'expected'),
    ('w_out', np.zeros((5, 2)), r'w_out: shape \(5, 2\), expected \(5, 3\)'),
    ('center', np.array([0, np.nan, 0]), 'center: not finite')])
def test_arrays_that_contradict_each_other_are_errors(network, field, value, words):
    with pytest.raises(ModelError, match=words):
        dataclasses.replace(network, **{field: value})
