"""The node of the front end: a surface of hardware, its release and its faults."""

import numpy as np
import pytest
from faulty_board import ANSWER_S, NO_ANSWER_S, FaultyBoard
from rclpy.node import Node
from ros_messages import to_ros

from rhs_isac_ros.frontend import OpenSourceRis, SurfaceFault
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.channel import ChannelNode
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.support.fields import ParameterError

SCENARIO = Scenario(n_subbands=1, n_frames=3, n_feeds=1, elements_per_side=16)
FILE = 'n_subbands: 1\nn_frames: 3\nn_feeds: 1\nelements_per_side: 16\n'


@pytest.fixture
def board():
    with FaultyBoard() as board:
        yield board


@pytest.fixture
def make_node(bench, tmp_path):
    """Return a function that adds a node with a surface and its options."""
    (tmp_path / 'scenario.yaml').write_text(FILE, encoding='utf-8')

    def make(surface, options, **others):
        return bench.add(ChannelNode, values={
            'scenario_file': tmp_path / 'scenario.yaml', 'surface': surface,
            'surface_options': options, **others})
    return make


@pytest.fixture
def node(make_node, board):
    return make_node('opensourceris', f'port={board.port} timeout_s={ANSWER_S}')


class Cycle:
    """The messages that the node needs to answer the pilots of a band."""

    def __init__(self, bench):
        self._bench, probe = bench, bench.add(Node, 'probe')
        self._publishers = {kind: bench.publisher(probe, kind)
                            for kind in (m.GroundTruth, m.RhsConfiguration, m.Pilot)}
        self.answers = bench.collect(probe, m.FeedSignals)
        self._stamp = probe.get_clock().now().to_msg()

    def ask(self, cycle_id, analog):
        place = np.array(SCENARIO.roi_center_m)
        for message in (
                m.GroundTruth(cycle_id=cycle_id, user=1, position=place, velocity=np.zeros(3)),
                m.RhsConfiguration(cycle_id=cycle_id, mode=m.Mode.POSITIONING, band=0,
                                   codebook_id='x', analog=analog),
                m.Pilot(cycle_id=cycle_id, user=1, band=0, symbols=np.ones(3, complex))):
            self._publishers[type(message)].publish(to_ros(message, self._stamp))

    def answer(self, cycle_id):
        (found,) = self._bench.until(
            lambda: [one for one in self.answers if one.cycle_id == cycle_id])
        return found


def random_analog(seed):
    return np.random.default_rng(seed).integers(0, 2, (3, 256)).astype(float)


def test_the_board_shows_each_frame_before_the_signals_are_sent(bench, node, board):
    cycle = Cycle(bench)
    for cycle_id in (1, 2):
        cycle.ask(cycle_id, random_analog(cycle_id))
        assert np.any(cycle.answer(cycle_id).signals != 0)
        assert board.n_patterns == 3 * cycle_id
        np.testing.assert_array_equal(board.configuration, random_analog(cycle_id)[-1])


# All faults of the driver are in test_opensourceris.py.
@pytest.mark.parametrize(('fault', 'kind', 'pattern'), [
    ('flipped bit', 'mismatch', 1), ('late', 'silence', 0), ('closed', 'closed', 0)])
def test_a_fault_sends_no_signals_and_ends(
        bench, node, board, monkeypatch, fault, kind, pattern):
    cycle = Cycle(bench)
    cycle.ask(1, random_analog(1))
    cycle.answer(1)
    board.faults = {board.n_patterns + pattern: fault}
    with monkeypatch.context() as patch:
        if kind == 'silence':
            patch.setattr(node._front_end._surface, '_timeout_s', NO_ANSWER_S)
        cycle.ask(2, random_analog(2))
        bench.until(lambda: node.role.counters, 'a fault')
    assert node.role.counters == {f'surface_{kind}': 1}
    if fault == 'closed':
        board.plug()
    cycle.ask(3, random_analog(3))
    assert cycle.answer(3).cycle_id == 3
    np.testing.assert_array_equal(board.configuration, random_analog(3)[-1])
    assert [one.cycle_id for one in cycle.answers] == [1, 3]


def test_malformed_lines_are_one_line_in_the_log_for_each_kind(bench, node, board, capfd):
    cycle = Cycle(bench)
    for cycle_id in range(1, 21, 2):
        cycle.ask(cycle_id, random_analog(cycle_id))
        cycle.answer(cycle_id)
        board.send(b'#0X0\n#OK\n' * 50)
        cycle.ask(cycle_id + 1, random_analog(cycle_id))
        bench.until(lambda n=cycle_id // 2 + 1: node.role.counters.total() == n, 'a fault')
    log = capfd.readouterr().err
    assert log.count('surface: ') == len(node.role.counters)
    assert log.count('surface and radio work again') == 1


def test_a_configuration_that_the_board_cannot_show_is_a_fault(bench, node):
    cycle = Cycle(bench)
    cycle.ask(1, random_analog(1) / 2)
    bench.until(lambda: node.role.counters, 'a fault')
    assert node.role.counters == {'surface_ValueError': 1}
    assert 'expected 0 or 1' in node.role.status()['warning.front_end']


def test_a_node_that_stands_by_releases_the_board_until_it_serves_again(
        bench, node, board, make_node):
    cycle, other = Cycle(bench), OpenSourceRis(port=board.port, timeout_s=ANSWER_S)
    cycle.ask(1, random_analog(1))
    cycle.answer(1)
    with pytest.raises(SurfaceFault, match='another process uses the port'):
        other.apply(np.zeros(256))
    newer = make_node('emulated', '')
    bench.until(lambda: node.stands_by, 'the newer node')

    def is_released():
        try:
            other.apply(np.zeros(256))
        except SurfaceFault as fault:
            return fault.kind != 'occupied'
        return True
    bench.until(is_released, 'the release')
    other.close()
    bench.remove(newer)
    bench.until(lambda: not node.stands_by, 'the return to service')
    cycle.ask(2, random_analog(2))
    cycle.answer(2)
    np.testing.assert_array_equal(board.configuration, random_analog(2)[-1])


def test_a_front_end_that_cannot_be_released_is_logged(make_node, monkeypatch, capfd):
    node = make_node('emulated', '')

    def close():
        raise OSError('the cable is broken')
    with monkeypatch.context() as patch:
        patch.setattr(node._front_end, 'close', close)
        node.stand_by()
    assert 'surface or radio not released: OSError: the cable is broken' in capfd.readouterr().err


@pytest.mark.parametrize(('surface', 'options', 'others', 'expected'), [
    ('nothing', '', {}, "surface: 'nothing', expected one of emulated, opensourceris or a plug-"),
    ('opensourceris', 'x', {}, "surface_options: 'x', expected NAME=VALUE"),
    ('opensourceris', 'port=x timeout_s=-1', {}, 'surface: timeout_s: -1'),
    ('emulated', '', {'radio': 'nothing'},
     "radio: 'nothing', expected one of emulated, waveform, sigmf or "),
    ('emulated', '', {'radio_options': 'gain_db=3'}, "radio: emulated: .* 'gain_db'"),
    ('emulated', '', {'radio': 'waveform'},
     'radio: frame_duration_s: 4e-06 s, expected at least 3.6e-05 s with a wave'),
    ('emulated', '', {'samples_folder': '.'}, 'samples_folder: .*: modem EmulatedRadio, ')])
def test_an_invalid_front_end_ends_the_start(make_node, surface, options, others, expected):
    with pytest.raises(ParameterError, match=expected):
        make_node(surface, options, **others)


LAB = """
n_frames: 3
n_feeds: 1
elements_per_side: 16
frame_duration_s: 0.015
timing_std_s: 1.0e-7
band_phase_std_rad: 6.2832
"""


def test_recorded_samples_are_played_back_as_the_same_signals(bench, make_node, tmp_path):
    pytest.importorskip('sigmf', reason='sigmf is not installed')
    (tmp_path / 'scenario.yaml').write_text(LAB, encoding='utf-8')
    signals = {}
    for first, options in ((1, {'radio': 'waveform', 'samples_folder': str(tmp_path / 'samples')}),
                           (11, {'radio': 'sigmf', 'radio_options': f'path={tmp_path}/samples'})):
        node = make_node('emulated', '', **options)
        cycle = Cycle(bench)
        for cycle_id in (first, first + 1):
            cycle.ask(cycle_id, random_analog(cycle_id))
            signals[cycle_id] = cycle.answer(cycle_id).signals
        bench.remove(node)
    assert np.any(signals[1] != signals[2])
    np.testing.assert_array_equal(signals[11], signals[1])
    np.testing.assert_array_equal(signals[12], signals[2])
