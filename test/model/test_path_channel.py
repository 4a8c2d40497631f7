"""Propagation paths from a file."""

import dataclasses
import re
import types
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.model import MeasurementModel, Scenario, ScenarioError, simulate_received
from rhs_isac_ros.model.los import direct_gain, los_gain
from rhs_isac_ros.model.path_channel import PathChannel
from rhs_isac_ros.support.files import ArchiveError

F0 = 2.75e9
SPEED = 299_792_458.0
WALL_Y = 7.0


def free_space(distances):
    return SPEED / (4 * np.pi * F0 * distances)


@pytest.fixture(scope='module')
def users():
    return Scenario().sample_positions(20, np.random.default_rng(0))


@pytest.fixture(scope='module')
def empty(users):
    distances = np.linalg.norm(users, axis=1)
    return PathChannel(users, free_space(distances)[:, None].astype(complex), users[:, None],
                       np.zeros((20, 1), int), F0)


@pytest.fixture(scope='module')
def mirror(users):
    """Direct path and one reflection at the wall y = 7 m; the last user has only the former."""
    images = users * [1, -1, 1] + [0, 2 * WALL_Y, 0]
    sources = np.stack([users, images], axis=1)
    a = free_space(np.linalg.norm(sources, axis=2)) * np.array([1, 0.4 * np.exp(0.3j)])
    a[-1, 1] = 0
    n = np.tile([0, 1], (20, 1))
    n[-1, 1] = -1
    return PathChannel(users, a, sources, n, F0)


@pytest.mark.parametrize('changes', [{}, {'element_gain': lambda angles: np.cos(angles / 2)},
                                     {'user_gain': 0.5}], ids=['plain', 'pattern', 'gain'])
def test_a_direct_path_is_the_line_of_sight(empty, users, changes):
    scenario = Scenario(channel=empty, **changes)
    for band in range(2):
        expected = los_gain(scenario, users, band)
        np.testing.assert_allclose(direct_gain(scenario, users, band), expected, rtol=1e-10)


def test_a_path_is_a_spherical_wave_from_its_source(mirror, users, plain):
    scenario = Scenario(channel=mirror)
    p = plain(scenario)
    gains = direct_gain(scenario, users[3:4], 1)[0]
    for subband, element in ((0, 0), (7, 42)):
        frequency = 3e9 + (subband - 3.5) * 125e3
        expected = 0
        for a, source in zip(mirror.a[3], mirror.src[3], strict=True):
            distance = np.linalg.norm(source - p.element(element))
            expected += (a * F0 / frequency * np.linalg.norm(source) / distance
                         * np.exp(-2j * np.pi * frequency * distance / SPEED))
        assert gains[subband, element] == pytest.approx(expected, rel=1e-9)


def test_missing_paths_contribute_nothing(mirror, empty, users):
    np.testing.assert_allclose(direct_gain(Scenario(channel=mirror), users[-1:], 0),
                               direct_gain(Scenario(channel=empty), users[-1:], 0))


def test_factors_of_elements_multiply_a_path(mirror, users):
    gains = np.ones((20, 2, 100), complex)
    gains[:, 1, :50] = 0
    scenario = Scenario(channel=dataclasses.replace(mirror, gains=gains))
    partial = direct_gain(scenario, users, 0)
    np.testing.assert_allclose(partial[..., :50], los_gain(scenario, users, 0)[..., :50])
    np.testing.assert_allclose(
        partial[..., 50:], direct_gain(Scenario(channel=mirror), users, 0)[..., 50:])


def test_both_simulations_follow_the_paths(mirror, users, shipped):
    scenario = Scenario(channel=mirror)
    signals = [simulate_received(scenario, shipped, users, np.random.default_rng(1)),
               MeasurementModel(scenario, shipped).sample(users, np.random.default_rng(2))]
    difference = signals[1] - signals[0]
    # They differ by two draws of the noise.
    assert np.mean(np.abs(difference)**2) == pytest.approx(2 * scenario.noise_power_w, rel=0.15)
    assert np.mean(np.abs(signals[0])**2) > 1e3 * scenario.noise_power_w


def test_signals_at_other_positions_are_those_of_the_nearest_user(mirror, users):
    scenario = Scenario(channel=mirror)
    np.testing.assert_array_equal(direct_gain(scenario, users + 0.01, 0),
                                  direct_gain(scenario, users, 0))


def test_random_positions_are_those_of_users(mirror, users):
    positions = Scenario(channel=mirror).sample_positions(50, np.random.default_rng(3))
    assert (positions[:, None] == users).all(axis=2).any(axis=1).all()


def test_a_file_holds_the_paths(mirror, tmp_path):
    mirror.save(tmp_path / 'hall.npz')
    loaded = PathChannel.load(tmp_path / 'hall.npz')
    np.testing.assert_array_equal(loaded.users, mirror.users)
    np.testing.assert_allclose(loaded.coefficients, mirror.coefficients, rtol=1e-6)
    np.testing.assert_allclose(loaded.sources, mirror.sources, rtol=1e-6)
    scenario = Scenario(channel=tmp_path / 'hall.npz')
    assert scenario.id == Scenario(channel=loaded).id != Scenario().id
    assert Scenario(**scenario.changes()) == scenario


# Array, its value as a function of the valid one, and the expected message.
BAD = [
    ('users', lambda x: x * np.nan, 'not finite'),
    ('a', lambda x: x * np.nan, 'not finite'),
    ('src', lambda x: x[:, :, :2], r'shape \(20, 2, 2\), expected \(20, 2, 3\)'),
    ('n', lambda x: x[:10], r'shape \(10, 2\), expected \(20, 2\)'),
    ('f0', lambda x: 0.0, 'expected a positive frequency'),
    ('f0', lambda x: 28e9, 'at most 1.5 times'),
    ('users', lambda x: x * [-1, 1, 1], 'in front of the surface'),
    ('src', lambda x: x + [0.5, 0, 0], 'from the user for a direct path'),
    ('a', lambda x: 100 * x, 'times that of free space'),
    ('gains', lambda x: np.ones((20, 2, 64), complex), '64 elements, expected 100'),
    ('src', None, 'missing'),
]


@pytest.mark.parametrize(('name', 'change', 'message'), BAD)
def test_invalid_files_are_refused_by_the_array(mirror, tmp_path, name, change, message):
    arrays = {key: getattr(mirror, key) for key in ('users', 'a', 'src', 'n', 'f0')}
    if change is None:
        del arrays[name]
    else:
        arrays[name] = change(arrays.get(name))
        # An amplitude at another frequency is that of free space, too.
        if name == 'f0' and arrays['f0']:
            arrays['a'] = arrays['a'] * F0 / arrays['f0']
    np.savez(tmp_path / 'bad.npz', **arrays)
    with pytest.raises(ScenarioError, match=f'^channel: .*{name}: .*{message}'):
        Scenario(channel=str(tmp_path / 'bad.npz'))


def test_users_in_another_frame_are_refused(mirror):
    moved = dataclasses.replace(mirror, users=mirror.users + [40, 0, 0],
                                src=mirror.src + [40, 0, 0], a=0.1 * mirror.a)
    with pytest.raises(ScenarioError, match=re.escape('channel: users: 0 % in the region')):
        Scenario(channel=moved)


@pytest.fixture(scope='module')
def traced():
    """Paths of two users in a concrete hall of 20 x 14 x 5 m, as Sionna RT 2.2 returned them."""
    with np.load(Path(__file__).parents[1] / 'data' / 'sionna.npz') as archive:
        arrays = dict(archive)
    a = arrays.pop('a_real'), arrays.pop('a_imag')
    return types.SimpleNamespace(a=a, **arrays)


def test_paths_of_sionna_are_mirror_images(traced):
    paths = PathChannel.from_sionna(traced, F0)
    np.testing.assert_allclose(paths.users, [[8, 1, -0.5], [12, -3, 0.5]])
    for user, image in ((0, [8, 13, -0.5]), (0, [8, -15, -0.5]), (0, [8, 1, -3.5]),
                        (1, [27.9, -3, 0.5])):
        distance = np.linalg.norm(paths.src[user] - image, axis=1)
        (found,) = np.flatnonzero(distance < 1e-4)
        assert paths.n[user, found] == 1
        assert 0.01 < abs(paths.coefficients[user, found]) < 0.8
    direct = (paths.n == 0) & (paths.a != 0)
    assert direct.sum() == 2
    np.testing.assert_allclose(paths.coefficients[direct], 1, rtol=1e-4)
    assert (paths.src[paths.a != 0][:, 0] > 0).all()
    assert (paths.n[paths.a == 0] == -1).all()
    Scenario(channel=paths)


def test_channels_are_joined_with_missing_paths(empty, mirror, users):
    joined = Scenario(channel=PathChannel.joined([
        empty, dataclasses.replace(mirror, users=users, src=mirror.src)]))
    for rows, part in ((slice(20), empty), (slice(20, 40), mirror)):
        np.testing.assert_array_equal(joined.channel.users[rows], part.users)
        np.testing.assert_array_equal(
            joined.channel.coefficients[rows, :part.a.shape[1]], part.coefficients)
    assert (joined.channel.n[:20, 1] == -1).all()
    with pytest.raises(ArchiveError, match='^f0: '):
        PathChannel.joined([empty, dataclasses.replace(empty, f0=2.7e9)])


def test_paths_of_sionna_to_several_antennas_are_refused(traced):
    twice = types.SimpleNamespace(**vars(traced) | {
        'a': [np.repeat(part, 2, axis=1) for part in traced.a]})
    with pytest.raises(ArchiveError, match=r'^a: shape \(1, 2, 2, 1, '):
        PathChannel.from_sionna(twice, F0)
