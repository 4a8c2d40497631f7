"""Settings of a sweep: parsing of values, products, and fields that vary together."""

from pathlib import Path

import pytest

from rhs_isac_ros.experiments.sweep_picture import shown
from rhs_isac_ros.experiments.sweep_settings import Axis, parse_axis, plain, settings_of
from rhs_isac_ros.model import Scenario, ScenarioError

CONFIG = Path(__file__).parents[2] / 'config'


def settings(*texts):
    return settings_of(Scenario(), [parse_axis(text) for text in texts], 'optimize', 'bayes')


def test_values_have_the_syntax_and_the_types_of_scenario_files():
    assert parse_axis('n_frames=1,2').values == ((1,), (2,))
    assert parse_axis('max_power_w=1e-3, 2').values == ((0.001,), (2.0,))
    assert parse_axis('center_frequencies_hz=[2.5e9, 3e9],[1e9]').values == (
        ((2.5e9, 3e9),), ((1e9,),))
    assert parse_axis('feed_positions_m=null').values == ((None,),)
    assert parse_axis('estimator=bayes,ml').values == (('bayes',), ('ml',))


def test_boards_have_a_short_text_also_those_of_plug_ins(install):
    install('own_boards', '''
from rhs_isac_ros.model.board import Board

class Mirror(Board):
    kind, id = 'mirror', 'mirror'
    def transfer(self, ports, tunings): ...
    def pullback(self, ports, tunings, by_transfer): ...
''', {})
    axis = parse_axis('board=own_boards:Mirror,resonant,{kind: phase, phase_range_rad: 3}')
    assert [plain(board) for board, in axis.values] == [
        'own_boards:Mirror', 'resonant', '{"kind": "phase", "phase_range_rad": 3.0}']
    assert [shown('board', board) for board, in axis.values] == [
        plain(board) for board, in axis.values]


def test_values_from_files_are_shown_by_the_name_of_their_file():
    (_,), (paths,) = parse_axis(f'channel=null,{CONFIG}/hall_paths.npz').values
    assert shown('channel', paths) == 'hall_paths.npz'
    assert plain(paths) == f'{CONFIG}/hall_paths.npz@{paths.digest}'


@pytest.mark.parametrize('text', [
    'pose={position_m: [1, 2, 0]}', 'carrier_offset_std_hz=.inf', 'impairments={},{}'])
def test_the_text_of_a_value_is_that_of_a_scenario_file(text):
    axis = parse_axis(text)
    for value, in axis.values:
        assert parse_axis(f'{axis.fields[0]}={plain(value)}').values == ((value,),)


@pytest.mark.parametrize(('text', 'expected'), [
    ('n_frame=1', 'n_frame: unknown field, expected one of n_frames'),
    ('n_frames', "'n_frames', expected FIELD=VALUE"),
    ('n_frames=', "'n_frames=', expected FIELD=VALUE"),
    ('n_frames=[1', 'expected FIELD=VALUE'),
    ('n_frames=0', 'n_frames: 0, expected 1 to 4096'),
    ('n_frames=1.5', 'n_frames: 1.5, expected an integer'),
    ('n_frames=true', 'n_frames: True, expected an integer'),
    ('multipath_to_los_db=0,300', 'multipath_to_los_db: 300.0, expected -200 to 100 dB'),
    ('roi_center_m=[1,2]', 'roi_center_m: 2 values, expected a list of 3 numbers'),
    ('roi_center_m=1,2,3', 'roi_center_m: 1, expected a list of 3 numbers'),
])
def test_an_error_names_field_value_and_what_is_expected(text, expected):
    with pytest.raises(ValueError) as caught:
        parse_axis(text)
    assert expected in str(caught.value)


def test_settings_are_all_combinations_in_ascending_order():
    found = settings('n_frames=4,1', 'multipath_to_los_db=0,-10,-20')
    assert [(setting.scenario.n_frames, setting.scenario.multipath_to_los_db)
            for setting in found] == [(1, -20), (1, -10), (1, 0), (4, -20), (4, -10), (4, 0)]
    assert found[0].varied == {'n_frames': 1, 'multipath_to_los_db': -20.0}
    assert (found[0].codebook, found[0].estimator) == ('optimize', 'bayes')


def test_lists_and_names_keep_their_order():
    found = settings('center_frequencies_hz=[3e9],[2e9,3e9],[1e9]', 'estimator=ml,bayes')
    assert [(setting.scenario.n_bands, setting.estimator) for setting in found] == [
        (1, 'ml'), (1, 'bayes'), (2, 'ml'), (2, 'bayes'), (1, 'ml'), (1, 'bayes')]


def test_fields_that_vary_together_are_one_axis():
    axis = parse_axis('n_frames=4,2').along(parse_axis('n_feeds=1,3'))
    found = settings_of(Scenario(), [axis], 'optimize', 'bayes')
    assert [(s.scenario.n_frames, s.scenario.n_feeds) for s in found] == [(2, 3), (4, 1)]
    with pytest.raises(ValueError, match='n_feeds: 3 values, expected 2 as for n_frames'):
        parse_axis('n_frames=4,2').along(parse_axis('n_feeds=1,2,3'))


@pytest.mark.parametrize('text', ['n_frames=2,1,2', 'center_frequencies_hz=[1e9],[1000000000]'])
def test_only_a_field_that_follows_another_may_repeat_a_value(text):
    axis = parse_axis(text)
    with pytest.raises(ValueError, match='more than once, expected different values'):
        axis.distinct()
    first = Axis(('n_feeds',), tuple((value,) for value in range(len(axis.values))))
    assert first.along(axis).distinct().values[0] == (0, *axis.values[0])


def test_combinations_are_checked():
    with pytest.raises(ScenarioError, match='feed_positions_m: 1 positions, expected n_feeds = 2'):
        settings('feed_positions_m=[[0,0,0]]', 'n_feeds=1,2')
    with pytest.raises(ValueError, match='n_frames: varied more than once'):
        settings('n_frames=1,2', 'n_frames=3,4')


def test_an_unknown_field_of_an_axis_is_an_error():
    with pytest.raises(ValueError, match='n_frame: unknown field, expected one of n_frames'):
        settings_of(Scenario(), [Axis(('n_frame',), ((1,), (2,)))], 'random', 'bayes')
