"""Boards: from tunings to the transfer from elements to feeds, and back."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb
from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.link import steer
from rhs_isac_ros.model import MeasurementModel, Scenario, ScenarioError
from rhs_isac_ros.model.board import Board
from rhs_isac_ros.model.boards import board_of
from rhs_isac_ros.model.elementwise import Paper, PhaseShift, Resonant, States
from rhs_isac_ros.model.surface import AppliedBeams, onboard_matrix, ports_of, radiation_matrix
from rhs_isac_ros.support import plugins

STATES = {'kind': 'states', 'states': [[0.0, 1.0], [1.0, 0.0], [0.2, -0.9]]}
BOARDS = {
    'paper': 'paper',
    'lossy': {'kind': 'paper', 'loss_db_per_m': 9.0, 'feed_gains': [1.0, 0.5]},
    'phase': {'kind': 'phase', 'phase_range_rad': 5.0, 'loss_db_per_m': 3.0},
    'resonant': {'kind': 'resonant', 'resonances_hz': [2.51e9, 2.98e9], 'quality_factor': 30},
    'states': STATES}
PORTS = ports_of(Scenario())


def scenario_with(board, **changes):
    levels = 3 if isinstance(board, dict) and board['kind'] == 'states' else 0
    return Scenario(**{
        'elements_per_side': 4, 'n_feeds': 2, 'n_subbands': 3, 'board': board,
        'amplitude_levels': levels, **changes})


@pytest.fixture(params=BOARDS)
def scenario(request):
    return scenario_with(BOARDS[request.param])


def complex_normal(rng, *shape):
    return rng.normal(size=(*shape, 2)) @ [1, 1j]


def tunings_of(scenario, rng):
    """Tunings away from the states, where interpolated coefficients have no derivative."""
    low = rng.uniform(0.05, 0.45, (scenario.n_bands, scenario.n_frames, scenario.n_elements))
    return low + 0.5 * rng.integers(2, size=low.shape)


def test_pullback_is_the_gradient_of_the_transfer(scenario):
    rng, ports = np.random.default_rng(0), ports_of(scenario)
    tunings = tunings_of(scenario, rng)
    transfer = scenario.board.transfer(ports, tunings)
    assert transfer.shape == (2, 3, scenario.n_frames, 16, 2)
    weights, step = complex_normal(rng, *transfer.shape), 1e-6 * rng.normal(size=tunings.shape)
    forward, backward = (scenario.board.transfer(ports, tunings + sign * step) for sign in (1, -1))
    change = np.sum((np.conj(weights) * (forward - backward)).real) / 2
    by_tunings = scenario.board.pullback(ports, tunings, weights)
    assert by_tunings.shape == tunings.shape
    assert np.sum(by_tunings * step) == pytest.approx(change, rel=1e-6)


def test_faster_methods_of_elementwise_boards_equal_those_that_derive_from_the_transfer(scenario):
    rng, ports, board = np.random.default_rng(1), ports_of(scenario), scenario.board
    tunings, response = tunings_of(scenario, rng), (complex_normal(rng, 16), 0.3j)
    digital = complex_normal(rng, 2, 3, scenario.n_frames, 2)
    signals = complex_normal(rng, 2, 3, scenario.n_frames, 16)
    for name, arguments in (
            ('radiation', (tunings, digital, *response)), ('feeds', (tunings, signals, *response)),
            ('by_tunings', (tunings, digital, signals)),
            ('by_digital', (tunings, signals, *response))):
        np.testing.assert_allclose(
            getattr(board, name)(ports, *arguments),
            getattr(Board, name)(board, ports, *arguments), atol=1e-12, err_msg=name)


def test_gradients_of_the_bound_are_limits_of_differences(scenario):
    """The whole chain, with errors of the elements, for complex coefficients."""
    rng, scenario = np.random.default_rng(2), dataclasses.replace(scenario, element_error_rms=0.05)
    average = AverageCrlb(scenario, scenario.sample_positions(4, rng))
    sizes = [scenario.sizes[name] for name in ('N_B', 'N_SB', 'F', 'K')]
    beams = AppliedBeams(tunings_of(scenario, rng), 0.01 * complex_normal(rng, *sizes))
    _, by_analog, by_digital = average(beams)
    step = 1e-6 * rng.normal(size=beams.analog.shape), 1e-8 * complex_normal(rng, *sizes)
    high, low = (average.value(AppliedBeams(*(
        part + sign * change for part, change in zip(beams, step, strict=True))))
        for sign in (1, -1))
    expected = np.sum(by_analog * step[0]) + np.sum((np.conj(by_digital) * step[1]).real)
    assert (high - low) / 2 == pytest.approx(expected, rel=1e-5)


def test_the_default_is_the_board_of_the_paper_and_does_not_change_identifiers():
    assert Scenario().board == Paper() == board_of('paper') == board_of({'kind': 'paper'})
    assert Scenario(board='paper').changes() == {}
    assert Scenario(board={'kind': 'paper', 'loss_db_per_m': 0}).id == Scenario().id


def test_a_board_is_part_of_the_scenario_and_of_its_identifier(scenario, tmp_path):
    assert Scenario(**scenario.changes()) == scenario
    assert hash(Scenario(**scenario.changes())) == hash(scenario)
    plain = dataclasses.replace(scenario, board='paper')
    assert (plain.id == scenario.id) == (scenario.board == Paper())


def test_loss_and_gains_of_feeds_act_on_the_propagation():
    plain, lossy = (onboard_matrix(scenario_with(BOARDS[name])) for name in ('paper', 'lossy'))
    ports = ports_of(scenario_with('paper'))
    distances = np.linalg.norm(ports.elements_m - ports.feeds_m[:, None], axis=2)
    expected = 10**(-9.0 * distances / 20) * np.array([[1.0], [0.5]])
    np.testing.assert_allclose(lossy / plain, np.broadcast_to(expected, plain.shape))


def test_masked_elements_have_no_effect_and_stay_masked_when_others_are_optimised():
    masked = [0, 3, 12, 15]
    scenario = scenario_with({'kind': 'paper', 'masked': [15, 0, 3, 12, 3]})
    assert scenario.board.masked == tuple(masked)
    assert Scenario(**scenario.changes()) == scenario
    best = optimize(scenario, n_positions=8, max_steps=3).codebook
    radiation = MeasurementModel(scenario, best).radiation
    assert not radiation[..., masked].any()
    others = np.delete(np.arange(16), masked)
    assert radiation[..., others].any(axis=(0, 1)).all()
    beam = steer(scenario, np.array(scenario.roi_center_m))
    assert beam.analog.shape == (16,)


def test_coefficients_follow_their_curves():
    tunings = np.linspace(0, 1, 5).reshape(1, 1, 5).repeat(2, axis=0)
    phase = PhaseShift(phase_range_rad=np.pi).coefficients(PORTS, tunings)
    np.testing.assert_allclose(phase[:, 0], np.exp(1j * np.pi * tunings))
    resonant = Resonant(tuning_range=0.2).coefficients(PORTS, tunings)
    # A Lorentz oscillator stays on a circle, and resonates at the centre of each band.
    np.testing.assert_allclose(np.abs(resonant - 0.5), 0.5)
    np.testing.assert_allclose(resonant[:, :, 0, 2], 1, atol=0.02)
    assert (np.diff(np.angle(resonant), axis=3) != 0).all()
    states = board_of(STATES).coefficients(PORTS, tunings)[0, 0, 0]
    np.testing.assert_allclose(states[::2], [1j, 1, 0.2 - 0.9j])
    np.testing.assert_allclose(states[1], (1 + 1j) / 2)


def test_states_of_bands_and_elements():
    table = np.random.default_rng(0).normal(size=(2, 16, 2, 2))
    scenario = scenario_with({'kind': 'states', 'states': table}, amplitude_levels=2)
    levels = np.random.default_rng(1).integers(2, size=(2, scenario.n_frames, 16))
    coefficients = scenario.board.coefficients(ports_of(scenario), levels.astype(float))
    expected = np.take_along_axis(
        (table @ [1, 1j])[:, None], levels[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(coefficients[:, 0], expected)


@pytest.mark.parametrize('board', [
    *BOARDS.values(), STATES | {'states': [[[0, 0], [1, 0], [0, 1]], [[1, 0], [0, 0], [2, 0]]]}])
def test_a_band_alone_has_its_part_of_the_transfer(board):
    scenario = scenario_with(board)
    tunings = tunings_of(scenario, np.random.default_rng(0))
    np.testing.assert_array_equal(
        scenario.board.transfer(ports_of(scenario, 1), tunings[1:])[0],
        scenario.board.transfer(ports_of(scenario), tunings)[1])


def test_methods_of_a_board_take_their_arguments_by_name():
    sizes = Scenario().sizes
    tunings = np.ones((2, 1, len(PORTS.elements_m)))
    by_transfer = np.ones((2, sizes['N_SB'], *tunings.shape[1:], sizes['K']))
    np.testing.assert_array_equal(
        Paper().pullback(ports=PORTS, tunings=tunings, by_transfer=by_transfer),
        Paper().pullback(PORTS, tunings, by_transfer))


@pytest.mark.parametrize('kind', ['phase', 'resonant', 'states'])
def test_a_focused_beam_is_in_phase_at_its_point(kind):
    scenario = scenario_with(BOARDS[kind])
    los = complex_normal(np.random.default_rng(0), 3, 16)
    tunings = scenario.board.focused(ports_of(scenario, 1), los, scenario.amplitude_levels)

    def interference(tunings):
        channels = scenario.board.channels(ports_of(scenario, 1), tunings[None, None])[0, :, 0]
        return np.sum(channels * los[:, None]).real

    best = interference(tunings)
    for element in range(16):
        for other in (0.0, 0.5, 1.0):
            changed = tunings.copy()
            changed[element] = other
            assert interference(changed) <= best + 1e-9


@pytest.mark.parametrize(('changes', 'expected'), [
    ({'board': 3}, "3, expected the name of a board, or a mapping with kind"),
    ({'board': type('Own', (Paper,), {})}, "Own: kind 'paper', expected another one than that of"),
    ({'board': {'loss_db_per_m': 1}}, 'expected the name of a board, or a mapping with kind'),
    ({'board': 'mirror'}, "'mirror', expected a plug-in of rhs_isac_ros.boards"),
    ({'board': {'kind': 'phase', 'range': 1}}, "range: unknown field of 'phase', expected one of"),
    ({'board': {'kind': 'paper', 'loss_db_per_m': -1}}, 'loss_db_per_m: -1.0, expected 0 to 1e'),
    ({'board': {'kind': 'paper', 'feed_gains': [1]}}, 'feed_gains: 1 numbers, expected n_feeds'),
    ({'board': {'kind': 'paper', 'masked': [100]}}, 'masked: 100 to 100, expected 0 to 99'),
    ({'board': {'kind': 'paper', 'masked': [0.5]}}, 'masked: 0.5, expected integers'),
    ({'board': {'kind': 'paper', 'feed_gains': 1}}, 'feed_gains: 1, expected a list of numbers'),
    ({'board': {'kind': 'resonant', 'resonances_hz': [1e9]}}, 'resonances_hz: 1 numbers'),
    ({'board': 'states'}, '2 states with amplitude_levels = 0, expected as many levels'),
    ({'board': {'kind': 'states', 'states': [[0, 1j]]}}, 'states: complex numbers, expected real'),
    ({'board': {'kind': 'states', 'states': [0, 1]}}, 'states: shape (2,), expected [L, 2]'),
    ({'board': 'phase', 'failed_element_share': 0.01},
     "'phase' with failed_element_share = 0.01, expected 0"),
])
def test_a_board_that_is_invalid_or_does_not_fit_is_refused_by_name(changes, expected):
    with pytest.raises(ScenarioError) as caught:
        Scenario(**changes)
    assert str(caught.value).startswith('board: ')
    assert expected in str(caught.value)


def test_plug_ins_that_differ_in_a_field_are_different_boards():
    class Own(Paper):
        kind = 'own'

    board, masked = Own(), Own(masked=(0, 3))
    assert (board == Own(), board == masked) == (True, False)
    assert Scenario(board=board).id != Scenario(board=masked).id
    assert not masked.paths(ports_of(Scenario()))[..., [0, 3]].any()
    assert board.paths(ports_of(Scenario())).all()


def test_a_board_and_a_plug_in_of_another_group_may_have_one_name(install):
    class Ring(Paper):
        kind = 'ring'

    install('rings', 'def ring(): return 1', {plugins.MOBILITIES: {'ring': 'ring'}})
    before = plugins.load(plugins.MOBILITIES, 'ring')
    scenario = Scenario(board=Ring(masked=(0, 3)))
    assert plugins.load(plugins.MOBILITIES, 'ring') is before
    assert Scenario(**scenario.changes()).board == scenario.board


COUPLED = '''
import numpy as np
from rhs_isac_ros.model.board import Board

class Mixed(Board):
    """Elements that share a part of their tunings."""
    kind = 'mixed'
    def __init__(self, share=0.1):
        self.share, self.id = share, f'mixed{share}'
    def mixing(self, ports):
        n = len(ports.elements_m)
        return np.eye(n) + self.share * np.exp(1j * np.arange(n * n)).reshape(n, n)
    def transfer(self, ports, tunings):
        ones = np.ones((*ports.frequencies_hz.shape, 1, 1, len(ports.feeds_m)))
        return (tunings @ self.mixing(ports))[:, None, ..., None] * ones
    def pullback(self, ports, tunings, by_transfer):
        total = by_transfer.sum(axis=(1, 4))
        return (total @ np.conj(self.mixing(ports)).T).real
'''


def test_a_plug_in_defines_two_methods_and_may_couple_elements(install):
    """Everything else derives from them; what needs elements of their own is refused."""
    install('mixed', COUPLED, {plugins.BOARDS: {'mixed': 'Mixed'}})
    scenario = scenario_with({'kind': 'mixed', 'share': 0.2}, element_error_rms=0.02)
    assert Scenario(**scenario.changes()) == scenario
    assert scenario.id != dataclasses.replace(scenario, board='mixed').id
    test_pullback_is_the_gradient_of_the_transfer(scenario)
    test_gradients_of_the_bound_are_limits_of_differences(scenario)
    rng = np.random.default_rng(0)
    sizes = [scenario.sizes[name] for name in ('N_B', 'N_SB', 'F', 'K')]
    beams = AppliedBeams(tunings_of(scenario, rng), complex_normal(rng, *sizes))
    assert np.isfinite(MeasurementModel(scenario, beams).covariance()).all()
    with pytest.raises(ValueError, match="'mixed' couples its elements, expected a board whose"):
        radiation_matrix(scenario, beams, (1.0, 0.5, 1.0))
    install('other', 'def make(): return 3', {plugins.BOARDS: {'broken': 'make'}})
    with pytest.raises(ScenarioError, match='^board: entry point .*: returned 3, .* of Board'):
        Scenario(board='broken')


def test_states_have_a_default_of_off_and_on():
    scenario = scenario_with('states', amplitude_levels=2)
    assert scenario.board == States()
    same = dataclasses.replace(scenario, board='paper')
    rng = np.random.default_rng(0)
    beams = AppliedBeams(rng.integers(2, size=(2, 4, 16)).astype(float),
                         complex_normal(rng, 2, 3, 4, 2))
    np.testing.assert_allclose(radiation_matrix(scenario, beams), radiation_matrix(same, beams))
