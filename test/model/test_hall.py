"""Data of a hall: propagation paths from a file, and a measured covariance of the multipath."""

import dataclasses
import re
import types
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import yaml

from rhs_isac_ros.model import MeasurementModel, Scenario, ScenarioError, simulate_received
from rhs_isac_ros.model import multipath as mp
from rhs_isac_ros.model.hall import CONDITIONS, MultipathEstimate, PathChannel
from rhs_isac_ros.model.los import direct_gain, los_gain
from rhs_isac_ros.model.pose import Pose
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


@pytest.mark.parametrize('shift', [(0.3, -0.2, 0.1), (0.0, 0.0, 0.0)])
def test_paths_of_a_single_wall_move_with_the_user(mirror, users, shift):
    """The reflection of a user who goes towards the wall comes closer, too."""
    shift = np.array(shift)
    expected = np.stack([users[3] + shift, mirror.src[3, 1] + shift * [1, -1, 1]])
    np.testing.assert_allclose(mirror.moved(3, shift), expected, atol=1e-12)
    moved = direct_gain(
        Scenario(channel=mirror), users[2:4], 1, shifts=np.array([[0, 0, 0], shift]))
    np.testing.assert_allclose(
        moved[0], direct_gain(Scenario(channel=mirror), users[2:3], 1)[0], rtol=1e-12)
    paths = los_gain(Scenario(), expected, 1)
    np.testing.assert_allclose(
        moved[1], np.tensordot(mirror.coefficients[3], paths, 1), rtol=1e-9)


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
    ('src', lambda x: x[:, :, :2], r'shape \(20, 2, 2\), expected \[20, 2, 3\]'),
    ('n', lambda x: x[:10], r'shape \(10, 2\), expected \[20, 2\]'),
    ('f0', lambda x: 0.0, 'expected a positive frequency'),
    ('f0', lambda x: 28e9, 'at most 1.5 times'),
    ('users', lambda x: np.abs(x) * [-1, 1, 1], 'x = -.* in front of the surface'),
    ('src', lambda x: x + [0.5, 0, 0], 'from the user for a direct path'),
    ('src', lambda x: np.where([[False], [True]], x * [-1, 1, 1], x), 'x = -.* in front of the'),
    ('a', lambda x: 100 * x, 'times that of free space'),
    ('gains', lambda x: np.ones((20, 2, 64), complex), '64 elements, expected 100'),
    ('a', lambda x: x[:, :0], r'shape \(20, 0\), expected \[N, P\] for N users with P paths'),
    ('src', None, 'missing'),
    ('n', lambda x: np.where(x, np.nan, x), 'not finite'),
    ('n', lambda x: x + 0.5, '0.5, expected integers'),
    ('n', lambda x: x + 200, '199 to 201, expected -1 to 127'),
    ('f0', lambda x: [x, x], r'shape \(2,\), expected a number'),
    ('f0', lambda x: x + 1j, 'complex numbers, expected real numbers'),
    ('users', lambda x: x + 1j, 'complex numbers, expected real numbers'),
    ('users', lambda x: x.astype(str), 'of type <U.*, expected numbers'),
    ('a', lambda x: x.astype(str), 'of type <U.*, expected numbers'),
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


def test_half_of_the_users_must_be_in_the_region(mirror):
    def moved(n):
        offset = np.where(np.arange(20)[:, None] < n, [40, 0, 0], 0)
        return dataclasses.replace(mirror, users=mirror.users + offset,
                                   src=mirror.src + offset[:, None], a=0.1 * mirror.a)

    Scenario(channel=moved(10))
    with pytest.raises(ScenarioError, match=re.escape('channel: users: 45 % in the region')):
        Scenario(channel=moved(11))
    # The boundary belongs to the region, which may be flat.
    for vertex in Scenario().roi_bounds_m:
        Scenario(channel=dataclasses.replace(
            mirror, users=np.tile(vertex, (20, 1)), src=np.tile(vertex, (20, 2, 1)),
            a=0.1 * mirror.a))


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


@pytest.mark.parametrize(('name', 'change', 'message'), [
    ('theta_r', np.rad2deg, '.*, expected angles of .* rad$'),
    ('phi_r', np.rad2deg, '.*, expected angles of .* rad$'),
    ('a', lambda parts: [np.repeat(part, 2, axis=1) for part in parts], r'shape \(1, 2, 2, 1, ')])
def test_other_paths_of_sionna_are_refused(traced, name, change, message):
    """Angles in degrees, and paths to several antennas."""
    changed = types.SimpleNamespace(**vars(traced) | {name: change(getattr(traced, name))})
    with pytest.raises(ArchiveError, match=f'^{name}: {message}'):
        PathChannel.from_sionna(changed, F0)


def with_antennas(paths):
    """Return paths as `synthetic_array=False` gives them: antennas have axes of their own."""
    each = {name: np.array(getattr(paths, name))[:, None, :, None]
            for name in ('tau', 'theta_r', 'phi_r', 'valid')}
    return types.SimpleNamespace(**vars(paths) | each | {
        'interactions': np.array(paths.interactions)[:, :, None, :, None]})


def test_one_antenna_of_sionna_is_one_antenna(traced):
    assert PathChannel.from_sionna(with_antennas(traced), F0) == PathChannel.from_sionna(
        traced, F0)


def test_users_without_paths_have_missing_paths(traced):
    names = ('tau', 'theta_r', 'phi_r', 'valid', 'interactions')
    none = types.SimpleNamespace(**vars(traced) | {
        name: np.array(getattr(traced, name))[..., :0] for name in names} | {
        'a': [np.array(part)[..., :0] for part in traced.a]})
    paths = PathChannel.from_sionna(none, F0)
    assert paths.a.shape == (2, 1) and not paths.a.any()
    assert (paths.n == -1).all()


def test_diffuse_paths_of_sionna_are_refused_by_name(traced):
    kinds = np.array(traced.interactions)
    diffuse = types.SimpleNamespace(**vars(traced) | {'interactions': np.where(kinds, 2, 0)})
    with pytest.raises(ArchiveError, match='^interactions: diffuse paths, '):
        PathChannel.from_sionna(diffuse, F0)


def dataset_of(paths, pose):
    """Return paths as DeepMIMO describes them, with a base station of a pose."""
    towards = pose.vectors_to_site(paths.sources)
    distance = np.linalg.norm(towards, axis=2)
    missing = np.where(paths.n < 0, np.nan, 1.0)
    with np.errstate(divide='ignore'):
        power = 20 * np.log10(np.abs(paths.a)) * missing
    return types.SimpleNamespace(
        power=power, delay=distance / SPEED * missing,
        phase=np.rad2deg(np.angle(paths.a) - 2 * np.pi * F0 * distance / SPEED),
        aod_az=np.rad2deg(np.arctan2(towards[..., 1], towards[..., 0])),
        aod_el=np.rad2deg(np.arccos(towards[..., 2] / distance)),
        inter=np.where(paths.n < 0, np.nan, np.array([0, 1, 11, 111])[paths.n]),
        rx_pos=pose.to_site(paths.users))


@pytest.mark.parametrize('pose', [
    Pose(), Pose((5.0, -3.0, 2.0), (0.0, 0.0, 0.6, 0.8)),
    Pose((0.0, 1.0, 0.0), (0.1, 0.2, 0.3, 1.0))])
def test_paths_of_deepmimo_are_those_of_its_angles(traced, pose):
    paths = PathChannel.from_sionna(traced, F0)
    dataset = dataset_of(paths, pose)
    # A user without a path is a row of NaN.
    for name, array in vars(dataset).items():
        setattr(dataset, name, np.concatenate([array, np.full_like(array[:1], np.nan)]))
    dataset.rx_pos[-1] = pose.to_site(np.array([9.0, 0.0, 0.0]))
    found = PathChannel.from_deepmimo(dataset, F0, pose)
    np.testing.assert_allclose(found.users, paths.users, atol=1e-9)
    np.testing.assert_allclose(found.sources, paths.sources, atol=1e-6)
    np.testing.assert_allclose(found.a, paths.a, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(found.n, paths.n)
    dataset.phase = np.rad2deg(np.angle(np.concatenate([paths.a, paths.a[:1]])))
    found = PathChannel.from_deepmimo(dataset, F0, pose, has_delay_phase=False)
    np.testing.assert_allclose(found.a, paths.a, rtol=1e-6, atol=1e-12)


def test_scattered_paths_of_deepmimo_are_refused_by_name(traced):
    dataset = dataset_of(PathChannel.from_sionna(traced, F0), Pose())
    dataset.inter[0, 0] = 13
    with pytest.raises(ArchiveError, match='^inter: scattered paths'):
        PathChannel.from_deepmimo(dataset, F0)


def write_matlab7(path, arrays):
    """Write arrays as MATLAB 7.3: with reversed axes, and pairs for complex numbers."""
    h5py = pytest.importorskip('h5py')
    with h5py.File(path, 'w', userblock_size=512) as file:
        for name, array in arrays.items():
            array = np.atleast_2d(array).T
            if np.iscomplexobj(array):
                pairs = np.empty(array.shape, [('real', float), ('imag', float)])
                pairs['real'], pairs['imag'] = array.real, array.imag
                array = pairs
            file[name] = array
    with open(path, 'r+b') as file:
        file.write(b'MATLAB 7.3 MAT-file, Platform: GLNXA64')


@pytest.mark.parametrize('write', [scipy.io.savemat, write_matlab7])
def test_files_of_matlab_are_channels(mirror, tmp_path, write):
    arrays = {name: getattr(mirror, name) for name in ('users', 'a', 'src')}
    write(tmp_path / 'hall.mat', {**arrays, 'n': mirror.n.astype(float), 'f0': F0})
    assert PathChannel.load(tmp_path / 'hall.mat') == mirror
    (tmp_path / 'hall.mat').rename(tmp_path / 'HALL.MAT')
    assert Scenario(channel=tmp_path / 'HALL.MAT').channel == mirror
    write(tmp_path / 'few.mat', arrays)
    with pytest.raises(ArchiveError, match='few.mat: n: missing'):
        PathChannel.load(tmp_path / 'few.mat')


# Octave 8 writes text, unless an option selects a format of MATLAB.
@pytest.mark.parametrize('content', [
    b'', b'MATLAB 5.0 MAT-file' + bytes(200), b'x' * 300,
    b'# Created by Octave 8.4.0\n# name: n\n# type: scalar\n0\n'])
def test_a_damaged_file_of_matlab_is_an_error(tmp_path, content):
    (tmp_path / 'hall.mat').write_bytes(content)
    with pytest.raises(ArchiveError, match='hall.mat: .*, or Octave with save -v7, has written'):
        PathChannel.load(tmp_path / 'hall.mat')


def test_a_structure_of_matlab_is_no_channel(mirror, tmp_path):
    scipy.io.savemat(tmp_path / 'hall.mat', {'a': {'re': 1, 'im': 2}})
    with pytest.raises(ArchiveError, match=r'a: \[.*, expected numbers'):
        PathChannel.load(tmp_path / 'hall.mat')
    h5py = pytest.importorskip('h5py')
    write_matlab7(tmp_path / 'hall.mat', {'n': mirror.n})
    with h5py.File(tmp_path / 'hall.mat', 'a') as file:
        file.create_group('a')
    with pytest.raises(ArchiveError, match='a: a structure or a sparse matrix, expected numbers'):
        PathChannel.load(tmp_path / 'hall.mat')


@pytest.mark.parametrize('shape', [(), (1,), (1, 1)])
def test_a_scalar_has_any_number_of_dimensions(mirror, tmp_path, shape):
    """MATLAB stores scalars as arrays of shape (1, 1), and integers as real numbers."""
    arrays = {name: getattr(mirror, name) for name in ('users', 'a', 'src')}
    np.savez(tmp_path / 'hall.npz', **arrays, n=mirror.n.astype(float), f0=np.full(shape, F0))
    assert PathChannel.load(tmp_path / 'hall.npz') == mirror
    assert PathChannel(**arrays, n=mirror.n, f0=np.full(shape, F0)) == mirror


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


N = 40_000


@pytest.fixture(scope='module')
def declared():
    """A scenario of little noise whose frames and sub-bands are far from fully correlated."""
    return Scenario(
        center_frequencies_hz=(1.2e9, 3.1e9), n_subbands=3, n_frames=2, n_feeds=2,
        elements_per_side=3, subband_width_hz=4e5, frame_duration_s=3e-3)


@pytest.fixture(scope='module')
def beams(declared, random_beams):
    return random_beams(declared, np.random.default_rng(0))


@pytest.fixture(scope='module')
def target(declared, beams):
    """A covariance of the survey's signals that differs much from the declared one."""
    rng = np.random.default_rng(1)
    root = MeasurementModel(declared, beams).root
    mixing = np.eye(6) + 0.5 * rng.normal(size=(2, 6, 6, 2)) @ [1, 1j]
    factor = root @ mixing
    return factor @ np.conj(np.swapaxes(factor, 1, 2))


@pytest.fixture(scope='module')
def estimate(declared, beams, target):
    model = MeasurementModel(declared, beams)
    inverse = np.linalg.inv(model.covariance())
    return MultipathEstimate(
        declared.multipath_to_los_db, declared.delay_spread_s, declared.angular_spread_deg,
        np.array(model.radiation), inverse @ (target - model.covariance()) @ inverse,
        {name: declared.fields()[name] for name in CONDITIONS})


@pytest.fixture(scope='module')
def measured(declared, estimate):
    return dataclasses.replace(declared, multipath=estimate)


def relative(actual, expected):
    return np.linalg.norm(actual - expected) / np.linalg.norm(expected)


def test_signals_of_the_survey_have_the_measured_covariance(measured, beams, target):
    covariance = MeasurementModel(measured, beams).covariance()
    assert relative(covariance, target) < 1e-4
    np.testing.assert_allclose(covariance, np.conj(np.swapaxes(covariance, 1, 2)))


def test_its_fields_take_the_place_of_those_of_the_scenario(measured):
    other = dataclasses.replace(
        measured, multipath_to_los_db=-9.0, delay_spread_s=1e-9, angular_spread_deg=50.0)
    np.testing.assert_array_equal(mp.multipath_covariance(other),
                                  mp.multipath_covariance(measured))
    np.testing.assert_array_equal(mp.measurement_correlation(other),
                                  mp.measurement_correlation(measured))


@pytest.mark.slow
def test_gains_of_elements_have_the_covariance_of_other_beams(measured, random_beams):
    """The covariance is one of the gains: it holds for beams that no survey has used."""
    other = random_beams(measured, np.random.default_rng(5))
    radiation = MeasurementModel(measured, other).radiation
    expected = mp.scattered_covariance(measured, radiation)
    for band in range(2):
        gains = mp.draw_multipath(measured, band, N, np.random.default_rng(band))
        signals = np.einsum('nrm,rm->nr', gains, radiation[band])
        sample = signals.T @ signals.conj() / N
        assert relative(sample, expected[band]) < 0.03
        spatial = np.einsum('nrm,nrk->mk', gains, gains.conj()) / gains[..., 0].size
        assert relative(spatial, mp.spatial_covariance(measured).matrix[band]) < 0.03
        assert relative(mp.multipath_covariance(measured)[band], spatial) > 0.1


def test_many_elements_have_the_same_spatial_covariance(measured, request):
    few = mp.spatial_covariance(measured)
    request.getfixturevalue('by_convolution')
    many = mp.spatial_covariance(measured)
    assert many.matrix is None
    np.testing.assert_allclose(many.power, few.power)
    np.testing.assert_allclose(few.power, np.diagonal(few.matrix, axis1=1, axis2=2).real)
    weights = np.random.default_rng(0).normal(size=(2, 4, 9, 2)) @ [1, 1j]
    for found, expected, rows in ((many, few, weights), (many[1], few[1], weights[1]),
                                  (many[[1, 0]], few[[1, 0]], weights)):
        product = expected.scatter(rows)
        np.testing.assert_allclose(product, rows @ expected.matrix)
        np.testing.assert_allclose(
            found.scatter(rows), product, atol=1e-12 * np.abs(product).max())


@pytest.mark.slow
def test_both_simulations_have_the_measured_covariance(measured, beams, target):
    positions = np.tile(measured.roi_center_m, (N, 1))
    model = MeasurementModel(measured, beams)
    for received in (model.sample(positions, np.random.default_rng(1)),
                     simulate_received(measured, beams, positions, np.random.default_rng(2))):
        errors = received - model.mean(positions[:1])
        sample = np.einsum('nir,nis->irs', errors, errors.conj()) / N
        assert relative(sample, target) < 0.03


def test_a_file_holds_the_estimate_and_scenarios_name_it(declared, estimate, measured, tmp_path):
    estimate.save(tmp_path / 'hall.npz')
    assert MultipathEstimate.load(tmp_path / 'hall.npz') == estimate
    (tmp_path / 'hall.yaml').write_text(
        yaml.safe_dump(declared.changes() | {'multipath': 'hall.npz'}), encoding='utf-8')
    loaded = Scenario.from_yaml(tmp_path / 'hall.yaml')
    assert loaded == measured
    assert hash(loaded) == hash(measured)
    # The path does not matter to the identifier, but the content does.
    assert loaded.id == measured.id != declared.id
    assert Scenario(**loaded.changes()) == measured


def test_a_changed_file_is_refused(declared, estimate, tmp_path):
    dataclasses.replace(estimate, excess=2 * estimate.excess).save(tmp_path / 'hall.npz')
    with pytest.raises(ScenarioError, match=r'^multipath: .*hall.npz: digest .*, expected '):
        dataclasses.replace(declared, multipath=f'{tmp_path / "hall.npz"}@{estimate.digest}')


def test_an_estimate_of_another_scenario_is_refused(measured):
    with pytest.raises(ScenarioError, match=r'^multipath: a survey with n_subbands 3, expected 4'):
        dataclasses.replace(measured, n_subbands=4)


@pytest.mark.parametrize(('name', 'change', 'message'), [
    ('excess', lambda x: np.nan * x, 'not finite'), ('radiation', lambda x: np.nan * x, 'not f'),
    ('delay_spread_s', lambda x: np.nan, 'not finite'),
    ('excess', lambda x: x[:, 1:], r'shape \(2, 5, 6\)')])
def test_invalid_estimates_are_refused(estimate, name, change, message):
    with pytest.raises(ArchiveError, match=f'^{name}: {message}'):
        dataclasses.replace(estimate, **{name: change(getattr(estimate, name))})


@pytest.mark.parametrize(('name', 'value'), [
    ('inflation', 0.0), ('inflation', np.nan), ('inflation', 'a'), ('level_std_db', -1.0)])
def test_a_record_with_impossible_numbers_is_refused(estimate, name, value):
    with pytest.raises(ArchiveError, match=f'^{name}: .*, expected'):
        dataclasses.replace(estimate, about={name: value})
