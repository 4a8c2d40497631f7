"""The scenario: defaults, checks, files and derived values."""

import dataclasses
import re

import numpy as np
import pytest

from rhs_isac_ros.model import SPEED_OF_LIGHT_MPS, Pose, Scenario, ScenarioError
from rhs_isac_ros.model.hall import PathChannel
from rhs_isac_ros.support import plugins


@pytest.fixture
def plugin(install) -> str:
    """The name of an installed impairment, which these tests never call."""
    install('rusts', 'def rust(strength): raise NotImplementedError',
            {plugins.IMPAIRMENTS: {'rust': 'rust', 'moss': 'rust'}})
    return 'rust'


def test_defaults_are_table_1_of_the_paper():
    expected = {
        'center_frequencies_hz': (2.5e9, 3.0e9), 'n_subbands': 8, 'subband_width_hz': 125e3,
        'n_frames': 4, 'frame_duration_s': 4e-6, 'elements_per_side': 10,
        'element_interval_wavelengths': 0.3, 'n_feeds': 3, 'feed_positions_m': None,
        'refractive_index': 2.1, 'element_gain': 1.0, 'user_gain': 1.0, 'delay_spread_s': 0.5e-6,
        'max_user_speed_mps': pytest.approx(20e3 / 3600), 'angular_spread_deg': 10.0,
        'noise_psd_dbm_hz': -174.0, 'max_power_w': 1e-3, 'roi_center_m': (10.0, 0.0, 0.0),
        'roi_size_m': (10.0, 10.0, 2.0),
        **dict.fromkeys(
            ('subband_spacing_hz', 'multipath_to_los_db', 'user_gain_std_db',
             'phase_std_rad', 'band_phase_std_rad',
             'timing_std_s', 'carrier_offset_std_hz', 'retune_s', 'user_speed_std_mps',
             'element_error_rms',
             'failed_element_share', 'amplitude_levels'), 0),
        'multipath_direction_deg': (0.0, 0.0), 'impairments': (),
        'blocked_probability': 0.0, 'outside_probability': 0.5, 'multipath': None, 'channel': None,
        'board': {'kind': 'paper', 'loss_db_per_m': 0.0, 'feed_gains': None, 'masked': ()},
        'element_positions_m': None, 'element_normals': None,
        'pose': dataclasses.asdict(Pose())}
    assert dataclasses.asdict(Scenario()) == expected


def test_defaults_match_the_vectors(table1):
    assert table1.scenario == Scenario()


def test_derived_numbers(case):
    s, vectors = case.scenario, case.vectors
    n_bands, n_subbands, n_frames, n_feeds = vectors['digital'].shape
    n_elements = vectors['analog'].shape[2]
    assert s.sizes == {'N_B': n_bands, 'N_SB': n_subbands, 'F': n_frames, 'N_E': n_elements,
                       'K': n_feeds}
    assert (s.n_bands, s.n_elements) == (n_bands, n_elements)
    assert s.noise_power_w == pytest.approx(float(vectors['noise_power']), rel=1e-12)
    assert SPEED_OF_LIGHT_MPS == 299_792_458


def test_values_are_converted_to_the_declared_type():
    s = Scenario(
        center_frequencies_hz=np.array([1e9]), n_feeds=np.int64(2), max_power_w=1,
        feed_positions_m=[[0, 1, 2], (0, '1e-1', 0)], roi_size_m=[1, 2, 3])
    assert s.center_frequencies_hz == (1e9,)
    assert type(s.n_feeds) is int
    assert type(s.max_power_w) is float
    assert s.feed_positions_m == ((0.0, 1.0, 2.0), (0.0, 0.1, 0.0))
    assert s.roi_size_m == (1.0, 2.0, 3.0)


def test_equal_scenarios_have_equal_hashes():
    one = Scenario(center_frequencies_hz=[28e9, 29e9], feed_positions_m=np.zeros((3, 3)))
    same = Scenario(center_frequencies_hz=('28e9', 29e9), feed_positions_m=[[0, 0, 0]] * 3)
    assert one == same
    assert hash(one) == hash(same)
    assert len({one, same, Scenario()}) == 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.n_feeds = 4


def test_a_surface_has_one_or_two_numbers_of_elements():
    """Along y and along z; a square in either notation is the same scenario."""
    square, pair = Scenario(elements_per_side=6), Scenario(elements_per_side=[6, 6])
    assert square == pair
    assert square.id == pair.id
    assert (square.n_columns, square.n_rows) == (6, 6)
    wide = Scenario(elements_per_side=np.array([12, 3]))
    assert (wide.n_columns, wide.n_rows, wide.n_elements) == (12, 3, 36)
    assert wide.changes() == {'elements_per_side': [12, 3]}
    assert wide == Scenario(**wide.changes())
    assert len({wide.id, square.id, Scenario(elements_per_side=(3, 12)).id}) == 3
    assert Scenario(element_interval_wavelengths=[0.3, 0.3]) == Scenario()
    uneven = Scenario(element_interval_wavelengths=(0.4, 0.25))
    assert uneven == Scenario(**uneven.changes())
    assert len({uneven.id, Scenario().id, Scenario(element_interval_wavelengths=0.4).id}) == 3


def test_values_of_users_may_be_unknown(tmp_path):
    (tmp_path / 'scenario.yaml').write_text('user_gain_std_db: unknown\nphase_std_rad: .inf\n')
    scenario = Scenario.from_yaml(tmp_path / 'scenario.yaml')
    assert scenario.user_gain_std_db == scenario.phase_std_rad == np.inf
    assert scenario.changes() == {'user_gain_std_db': 'unknown', 'phase_std_rad': 'unknown'}
    assert scenario == Scenario(**scenario.changes())
    assert scenario.id != Scenario(user_gain_std_db='unknown').id
    for name, value in (('element_error_rms', 'unknown'), ('delay_spread_s', np.inf)):
        with pytest.raises(ScenarioError, match=f'^{name}: '):
            Scenario(**{name: value})
    with pytest.raises(ScenarioError, match='^user_gain_std_db: .*expected 0 to 60 dB or unknown'):
        Scenario(user_gain_std_db=61)


def test_bands_may_touch_but_not_overlap():
    Scenario(center_frequencies_hz=(28e9, 28.4e9), n_subbands=64, subband_width_hz=6.25e6)
    with pytest.raises(ScenarioError, match='^center_frequencies_hz: .* expected at least 4e'):
        Scenario(center_frequencies_hz=(28e9, 28.39e9), n_subbands=64, subband_width_hz=6.25e6)


# Field, value, value and expectation in the message.
BAD = [
    ('n_feeds', 2.5, '2.5', 'expected an integer'),
    ('n_feeds', 0, '0', 'expected 1 to 256'),
    ('center_frequencies_hz', 3e9, '3000000000.0', 'expected a list of numbers'),
    ('center_frequencies_hz', [], '[]', 'expected a list of numbers'),
    ('center_frequencies_hz', [3e9, 'x'], "'x'", 'expected a number'),
    ('center_frequencies_hz', [1.0], '1.0', 'expected 1e+06 to 1e+13 Hz'),
    ('roi_center_m', [1, 2], '2 values', 'expected a list of 3 numbers'),
    ('roi_size_m', [1, 2, 3, 4], '4 values', 'expected a list of 3 numbers'),
    ('roi_size_m', '123', "'123'", 'expected a list of 3 numbers'),
    ('elements_per_side', [4, 5, 6], '[4, 5, 6]', 'expected an integer or two'),
    ('elements_per_side', [4, 2.5], '2.5', 'expected an integer'),
    ('element_interval_wavelengths', [0.3], '[0.3]', 'expected a number or two'),
    ('element_interval_wavelengths', [], '[]', 'expected a list of numbers'),
    ('element_interval_wavelengths', [0.3, 0], '0.0', 'expected 0.001 to 10'),
    ('roi_size_m', [1, -1, 1], '-1.0', 'expected 0 to 1e+06 m'),
    ('roi_size_m', [0, 0, 0], '(0.0, 0.0, 0.0)', 'expected at least one length above 0'),
    ('multipath_direction_deg', [91, 0], '91.0', 'expected -90 to 90 deg'),
    ('multipath_direction_deg', [0, 0, 0], '3 values', 'expected a list of 2 numbers'),
    ('center_frequencies_hz', [3e9, 2e9, 2.0005e9], '2e+09 and 2.0005e+09 Hz',
     'expected at least 1e+06 Hz apart'),
    ('feed_positions_m', 1, '1', 'expected a list of [x, y, z]'),
    ('feed_positions_m', [], '[]', 'expected a list of [x, y, z]'),
    ('feed_positions_m', [[0, 0]] * 3, '2 values', 'expected a list of 3 numbers'),
    ('feed_positions_m', [1, 2, 3], '1', 'expected a list of 3 numbers'),
    ('feed_positions_m', [[0, 0, 0]] * 2, '2 positions', 'expected n_feeds = 3'),
    ('element_positions_m', [], '[]', 'expected a list of [x, y, z]'),
    ('element_positions_m', np.zeros((1025, 3)), '1025 positions', 'expected at most 1024'),
    ('element_positions_m', [[5, 0, 0]], 'x up to 5 m', 'expected all elements in front of'),
    ('element_normals', [], '[]', 'expected a list of [x, y, z]'),
    ('element_normals', [[1, 0]], '2 values', 'expected a list of 3 numbers'),
    ('element_normals', [[1, 0, 'x']], "'x'", 'expected a number'),
    ('element_normals', [[1, 0, 0]], '1 vectors', 'one for each of the 0 element_positions_m'),
    ('roi_center_m', [5, 0, 0], '(5.0, 0.0, 0.0)', 'expected x > 0'),
    ('roi_center_m', [-10, 0, 0], '(-10.0, 0.0, 0.0)', 'expected x > 0'),
    ('amplitude_levels', 1, '1', 'expected 0 for continuous amplitudes, or at least 2'),
    ('multipath', 1.0, '1.0', 'expected the path of a file, or null'),
    ('channel', True, 'True', 'expected the path of a file, or null'),
    ('channel', 'none.npz', 'none.npz', 'cannot be read'),
    ('subband_spacing_hz', 1e5, '100000 Hz', 'expected 0 or at least subband_width_hz = 125000'),
    ('subband_spacing_hz', 1e9, '8e+09 Hz', 'expected less than twice the lowest centre'),
    ('subband_width_hz', 1e9, '8e+09 Hz', 'expected less than twice the lowest centre frequency'),
    ('pose', [0, 0, 1], '[0, 0, 1]', "expected a mapping of ['position_m', "),
    ('pose', {'position': [0, 0, 1]}, "{'position': ", "expected a mapping of ['position_m', "),
    ('pose', {'position_m': [0, 1]}, 'position_m: shape (2,)', 'expected [3]'),
    ('pose', {'quaternion': [0, 0, 0, 0]}, 'a length other than 0', 'expected'),
    *(('impairments', value, repr(value), 'expected a mapping of names to strengths')
      for value in (None, 3, 'rust', ['rust'], [0.1], {1: 2, 'rust': 0.1})),
]


@pytest.mark.parametrize(('field', 'value', 'shown', 'expected'), BAD)
def test_message_names_field_value_and_expectation(field, value, shown, expected):
    with pytest.raises(ScenarioError) as caught:
        Scenario(**{field: value})
    message = str(caught.value)
    assert message.startswith(f'{field}: ')
    assert shown in message
    assert expected in message


@pytest.mark.parametrize(
    'field', [field for field in dataclasses.fields(Scenario)
              if field.name not in ('multipath', 'channel', 'board')],
    ids=lambda field: field.name)
def test_values_just_outside_the_bounds_are_errors(field, plugin):
    low, high = field.metadata['declared'].low, field.metadata['declared'].high
    if isinstance(field.default, int):
        outside = (low - 1, high + 1)
    else:
        outside = (np.nextafter(low, -np.inf), np.nextafter(high, np.inf))
    for value in outside:
        if field.name in ('feed_positions_m', 'element_positions_m', 'element_normals'):
            value = [[0, 0, 0], [0, 0, 0], [0, value, 0]]
        elif field.name == 'center_frequencies_hz':
            value = [1e9, value]
        elif field.name == 'impairments':
            value = {plugin: value}
        elif field.name == 'pose':
            value = {'position_m': [10, value, 1]}
        elif isinstance(field.default, tuple):
            value = [10, value, 1][:len(field.default)]
        with pytest.raises(ScenarioError, match=f'^{field.name}: .*, expected .* to .*'):
            Scenario(**{field.name: value})


def test_from_yaml_reads_fields_and_keeps_defaults(tmp_path):
    path = tmp_path / 'scenario.yaml'
    # YAML 1.1 reads 28e9 as a string, and 2.8e+10 as a number.
    path.write_text(
        'center_frequencies_hz: [28e9, 2.9e+10]\nn_feeds: 2\nsubband_width_hz: 1e6\n'
        'feed_positions_m: [[0, -1e-2, 0], [0, 0.01, 0]]\n', encoding='utf-8')
    expected = Scenario(
        center_frequencies_hz=(28e9, 29e9), n_feeds=2, subband_width_hz=1e6,
        feed_positions_m=((0.0, -0.01, 0.0), (0.0, 0.01, 0.0)))
    assert Scenario.from_yaml(path) == expected
    assert Scenario.from_yaml(str(path)) == expected


CHANGES = [
    {}, {'n_feeds': 2}, {'center_frequencies_hz': [28e9]}, {'max_power_w': 1 / 3},
    {'roi_center_m': [4.0, 0.1 + 0.2, -1.0], 'roi_size_m': [2.0, 4.0, 1e-6]},
    {'n_feeds': 2, 'feed_positions_m': [[0.0, -1e-7, 0.0], [0.01, 0.1, 1.0]]},
    {'delay_spread_s': 0.0, 'noise_psd_dbm_hz': -400.0, 'elements_per_side': 1},
]


@pytest.mark.parametrize('changes', CHANGES, ids=str)
def test_changes_are_the_differences_from_table_1(tmp_path, changes):
    scenario = Scenario(**changes)
    assert scenario.changes() == changes
    scenario.to_yaml(path := tmp_path / 'scenario.yaml', 'A comment.')
    assert path.read_text(encoding='utf-8').startswith('# A comment.\n')
    assert Scenario.from_yaml(path) == scenario


def test_paths_are_relative_to_the_folder_of_the_file(tmp_path, monkeypatch):
    users = np.array([[7.0, 0, 0]])
    PathChannel(users, np.full((1, 1), 1e-4 + 0j), users[:, None], np.zeros((1, 1), int),
                2.75e9).save(tmp_path / 'paths.npz')
    monkeypatch.chdir(tmp_path)
    scenario = Scenario(channel='paths.npz')
    (tmp_path / 'all' / 'plans').mkdir(parents=True)
    (tmp_path / 'link').symlink_to(tmp_path / 'all' / 'plans')
    for folder in ('all/plans', 'link'):
        path = tmp_path / folder / 'plan.yaml'
        scenario.to_yaml(path)
        assert Scenario.from_yaml(path).id == scenario.id


def test_a_given_default_is_not_a_change(case):
    whole = dataclasses.asdict(Scenario())
    assert Scenario(**whole).changes() == {}
    assert Scenario(center_frequencies_hz=['2.5e9', 3e9], max_power_w='1e-3').changes() == {}
    assert Scenario(**case.scenario.changes()) == case.scenario


@pytest.mark.parametrize(('text', 'words'), [
    ('n_feed: 3', ['n_feed: unknown field', 'n_feeds', 'n_frames']),
    ('1: 3', ['1: unknown field']),
    ('- n_feeds', ['expected a mapping of field names to values']),
    ('n_feeds', ['expected a mapping of field names to values']),
    ('n_feeds: [', ['cannot be read']),
    ('n_feeds: 3e0', ["n_feeds: '3e0'", 'expected an integer']),
    ('n_feeds: 2\nn_frames: 4\nn_feeds: 3', ['n_feeds: repeated in line 3', 'expected one value']),
    ('max_power_w: -28e9', ['max_power_w: -28000000000.0', 'expected 1e-15 to 1e+06 W']),
    ('roi_center_m: [1, 2]', ['roi_center_m: 2 values', 'expected a list of 3 numbers']),
])
def test_from_yaml_message_names_the_file_and_the_fault(tmp_path, text, words):
    path = tmp_path / 'scenario.yaml'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(ScenarioError) as caught:
        Scenario.from_yaml(path)
    assert str(caught.value).startswith(f'{path}: ')
    for word in words:
        assert word in str(caught.value)


def test_the_id_is_a_hash_of_the_content():
    scenario = Scenario()
    assert re.fullmatch('sc[0-9a-f]{16}', scenario.id)
    assert scenario.id == Scenario(center_frequencies_hz=[2.5e9, 3000000000]).id
    others = [Scenario(center_frequencies_hz=(2.6e9, 3.0e9)), Scenario(n_frames=5),
              Scenario(multipath_direction_deg=(60, 0)),
              Scenario(user_gain=2.0), Scenario(feed_positions_m=[(0, 0, 0)] * 3)]
    assert len({scenario.id, *(other.id for other in others)}) == 6
    assert Scenario(**scenario.fields()) == scenario


@pytest.mark.parametrize(('changes', 'expected'), [
    ({}, 'sc337b8b24c90a1923'),
    ({'multipath_direction_deg': (0, 0), 'retune_s': 0}, 'sc337b8b24c90a1923'),
    ({'n_feeds': 2, 'user_gain_std_db': 2.0}, 'scc86c2bbf127e1ffd'),
    ({'center_frequencies_hz': [28e9]}, 'scd6c6596ccd3b8041')], ids=str)
def test_without_impairments_the_id_is_that_of_existing_files(changes, expected):
    assert Scenario(**changes).id == Scenario(**changes, impairments={}).id == expected


class TestPose:
    """The pose of the surface in the frame of the site."""

    PLACED = {'position_m': [0.0, 10.0, 1.0], 'quaternion': [0.0, 0.0, -0.5, 0.5],
              'uncertainty': [0.01, 0.1]}

    def test_a_file_is_read_and_written(self, tmp_path):
        path = tmp_path / 'scenario.yaml'
        path.write_text('pose: {position_m: [0, 10, 1], quaternion: [0, 0, -0.5, 0.5], '
                        'uncertainty: [0.01, 0.1]}', encoding='utf-8')
        scenario = Scenario.from_yaml(path)
        assert scenario.pose == Pose((0, 10, 1), (0, 0, -0.5, 0.5), (0.01, 0.1))
        assert scenario.changes() == {'pose': self.PLACED}
        scenario.to_yaml(path)
        assert Scenario.from_yaml(path) == Scenario(**scenario.fields()) == scenario
        path.write_text('pose: {position_m: [0, 10, 1], uncertainty: [0.01, 0.1], '
                        'quaternion: {w: 0.5, x: 0, y: 0, z: -0.5}}', encoding='utf-8')
        assert Scenario.from_yaml(path) == scenario

    def test_an_omitted_part_has_its_default(self):
        scenario = Scenario(pose={'position_m': [0, 0, 1.5]})
        assert scenario.pose == Pose((0.0, 0.0, 1.5))

    def test_the_id_depends_on_every_part(self):
        parts = [{name: value} for name, value in self.PLACED.items()]
        assert len({Scenario().id, *(Scenario(pose=part).id for part in parts)}) == 4
        assert Scenario(pose=self.PLACED).unplaced == Scenario()


class TestImpairments:
    """The field of impairments that plug-ins define."""

    @pytest.mark.parametrize('value', [
        {'rust': '1e-1', 'moss': 2}, [('rust', 0.1), ('moss', 2.0)],
        (('moss', 2.0), ('rust', 0.1))], ids=['mapping', 'list', 'field'])
    def test_names_and_strengths_are_sorted(self, plugin, value):
        scenario = Scenario(impairments=value)
        assert scenario.impairments == (('moss', 2.0), ('rust', 0.1))
        assert hash(scenario) == hash(dataclasses.replace(scenario))

    def test_the_id_depends_on_names_and_strengths(self, plugin):
        ids = {Scenario(impairments=value).id
               for value in ({}, {'rust': 0.1}, {'rust': 0.2}, {'moss': 0.1})}
        assert len(ids) == 4

    def test_an_unknown_plugin_is_an_error_that_lists_those_installed(self, plugin):
        with pytest.raises(ScenarioError, match=(
                f"^impairments: 'dust', expected a plug-in of {plugins.IMPAIRMENTS}; "
                'installed: (.*, )?moss, (.*, )?rust')):
            Scenario(impairments={'rust': 0.1, 'dust': 0.1})

    def test_a_plugin_that_cannot_be_imported_is_an_error(self, install):
        install('broken', '1 / 0', {plugins.IMPAIRMENTS: {'dust': 'dust'}})
        with pytest.raises(ScenarioError, match=r'^impairments: .*cannot be loaded: ZeroDivision'):
            Scenario(impairments={'dust': 0.1})


def test_positions_are_uniform_in_the_region():
    s = Scenario(roi_center_m=(4, 1, -2), roi_size_m=(2, 6, 1))
    low, high = np.array([3, -2, -2.5]), np.array([5, 4, -1.5])
    np.testing.assert_array_equal(s.roi_bounds_m, [low, high])
    positions = s.sample_positions(20_000, np.random.default_rng(0))
    assert positions.shape == (20_000, 3)
    assert (positions >= low).all()
    assert (positions <= high).all()
    unit = (positions - low) / (high - low)
    np.testing.assert_allclose(unit.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(np.cov(unit.T), np.eye(3) / 12, atol=0.003)
    np.testing.assert_array_equal(positions, s.sample_positions(20_000, np.random.default_rng(0)))
    for n, expected in ((-1, 'at least 0'), (1e3, 'an integer, at least 0')):
        with pytest.raises(ValueError, match=f'n: {n}, expected {expected}'):
            s.sample_positions(n, np.random.default_rng(0))


@pytest.mark.parametrize(('field', 'value'), [
    ('delay_spread_s', np.complex128(3 + 2j)), ('delay_spread_s', 1e-7 + 0j),
    ('n_feeds', np.complex128(3)), ('element_gain', 2 + 1j), ('user_gain', np.complex64(1)),
    ('center_frequencies_hz', np.array([2.5e9 + 1j, 3e9])), ('roi_center_m', [10, 1j, 0]),
    ('feed_positions_m', np.zeros((3, 3), complex)), ('delay_spread_s', np.ma.masked),
    ('roi_center_m', np.ma.array([10.0, 0, 0], mask=[1, 0, 0])), ('n_feeds', np.ma.array(3)),
    ('elements_per_side', np.ma.array([8, 8], mask=[1, 0])), ('roi_size_m', [np.ma.masked, 1, 1]),
    ('feed_positions_m', np.ma.zeros((3, 3))), ('impairments', {'x': 1j}), ('n_feeds', np.True_),
    ('delay_spread_s', b'1e-7'), ('center_frequencies_hz', np.array(2.5e9))])
def test_only_real_numbers_are_values(field, value):
    with pytest.raises(ScenarioError, match=rf'(?s)^{field}: .*(expected|not installed)'):
        Scenario(**{field: value})
