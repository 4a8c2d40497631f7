"""Boards with coupled elements: their files, checks, transfer and gradient."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb
from rhs_isac_ros.model import Scenario, ScenarioError
from rhs_isac_ros.model.__main__ import main
from rhs_isac_ros.model.board import BoardError, Ports
from rhs_isac_ros.model.network import Admittances, CoupledNetwork
from rhs_isac_ros.model.surface import AppliedBeams, ports_of
from rhs_isac_ros.model.waveguides import Guides, admittances, board_of_guides

FILE = Path(__file__).parents[1] / 'data' / 'board.npz'
VECTORS = dict(np.load(FILE))
SMALL = Scenario(elements_per_side=4, n_feeds=2, n_subbands=3)


def ports_at(*frequencies_hz):
    return Ports((0,), np.array([frequencies_hz]), VECTORS['elements_m'], VECTORS['feeds_m'], 1.0)


def saved(path, **changes):
    arrays = {**VECTORS, **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return str(path)


@pytest.fixture(scope='module')
def coupled(tmp_path_factory):
    """A scenario with waveguides of coupled dipoles."""
    path = tmp_path_factory.mktemp('board') / 'board.npz'
    np.savez(path, **board_of_guides(SMALL))
    return dataclasses.replace(SMALL, board={'kind': 'network', 'file': str(path)})


def test_transfer_and_gradient_match_the_vectors():
    board, ports = CoupledNetwork(file=str(FILE)), ports_at(VECTORS['frequency_hz'])
    tunings = VECTORS['tuning'][None]
    np.testing.assert_allclose(
        board.transfer(ports, tunings)[0, 0], VECTORS['transfer'], atol=1e-12)
    weights = np.broadcast_to(VECTORS['weights'], (1, 1, 3, 10, 2))
    gradient = board.pullback(ports, tunings, weights)[0]
    np.testing.assert_allclose(
        gradient, VECTORS['gradient'], atol=1e-6 * np.abs(VECTORS['gradient']).max())


def test_waveguides_with_dipoles_match_the_vectors():
    guides = Guides(*(float(VECTORS[name]) for name in ('width_m', 'height_m', 'length_m')))
    found = admittances(
        np.array([float(VECTORS['frequency_hz'])]), guides, VECTORS['elements_m'][:, 0],
        VECTORS['elements_m'], np.repeat([0, 1], 5), np.array([0, 1]))
    for name in ('y_tt', 'y_st', 'y_ss'):
        scale = np.abs(VECTORS[name]).max()
        # The constants of nature differ in the tenth digit.
        np.testing.assert_allclose(found[name][0], VECTORS[name], atol=1e-9 * scale)


def test_a_guide_that_is_too_narrow_carries_no_wave():
    with pytest.raises(ValueError, match='^width_m: 0.01 with 1e.10 Hz, expected more than 0.01'):
        Guides(0.01, 0.005, 0.1).admittance(10e9, np.zeros(1), np.zeros(1))


def test_feeds_that_reach_no_element_are_no_error_of_interpolation(tmp_path):
    arrays, path = board_of_guides(SMALL), tmp_path / 'board.npz'
    np.savez(path, **{**arrays, 'y_st': 0 * arrays['y_st']})
    assert CoupledNetwork(file=str(path)).misfit(SMALL) == ''


@pytest.mark.parametrize(('shape', 'n_feeds'), [((6, 1), 1), ((1, 6), 6), ((5, 3), 2)])
def test_guides_may_be_single_and_have_single_elements(shape, n_feeds):
    scenario = Scenario(elements_per_side=shape, n_feeds=n_feeds)
    network = Admittances.of(board_of_guides(scenario, loss_db_per_m=0.0))
    assert network.between.shape == (4, np.prod(shape), n_feeds)
    # Each element is connected to one feed, and each feed to some elements.
    assert (network.between[0] != 0).sum(axis=1).tolist() == [1] * np.prod(shape)
    assert (network.between[0] != 0).any(axis=0).all()


@pytest.mark.parametrize(('changes', 'options', 'expected'), [
    ({'n_feeds': 5}, {}, '^n_feeds: 5, expected at most one for each of 4 rows'),
    ({}, {'across': 1.0}, '^across: 1.0, expected 0.001 to 0.999')])
def test_guides_that_cannot_be_built_are_refused(changes, options, expected):
    with pytest.raises(ValueError, match=expected):
        board_of_guides(dataclasses.replace(SMALL, **changes), **options)


def test_the_gradient_of_the_bound_is_a_limit_of_differences(coupled):
    rng = np.random.default_rng(0)
    average = AverageCrlb(coupled, coupled.sample_positions(4, rng))
    beams = AppliedBeams(rng.uniform(0.1, 0.9, (2, 4, 16)),
                         0.01 * rng.normal(size=(2, 3, 4, 2, 2)) @ [1, 1j])
    _, by_analog, by_digital = average(beams)
    steps = 1e-6 * rng.normal(size=(2, 4, 16)), 1e-8 * rng.normal(size=(2, 3, 4, 2, 2)) @ [1, 1j]
    high, low = (average.value(AppliedBeams(*(
        part + sign * step for part, step in zip(beams, steps, strict=True)))) for sign in (1, -1))
    expected = np.sum(by_analog * steps[0]) + np.sum((np.conj(by_digital) * steps[1]).real)
    assert (high - low) / 2 == pytest.approx(expected, rel=1e-5)


def test_the_transfer_is_interpolated_between_near_frequencies(tmp_path):
    ones = np.ones(2)[:, None, None]
    path = saved(tmp_path / 'two.npz', frequency_hz=[10e9, 10.1e9], y_tt=ones * VECTORS['y_tt'],
                 y_st=[VECTORS['y_st'], 3 * VECTORS['y_st']], y_ss=ones * VECTORS['y_ss'])
    board, tunings = CoupledNetwork(file=path), VECTORS['tuning'][None]
    low, quarter, high = board.transfer(ports_at(10e9, 10.025e9, 10.1e9), tunings)[0]
    np.testing.assert_allclose(high, 3 * low)
    np.testing.assert_allclose(quarter, 1.5 * low)
    weights = np.random.default_rng(0).normal(size=(1, 3, 3, 10, 2, 2)) @ [1, 1j]
    np.testing.assert_allclose(
        board.pullback(ports_at(10e9, 10.025e9, 10.1e9), tunings, weights),
        board.pullback(ports_at(10e9), tunings,
                       (weights * [[[[1]]], [[[1.5]]], [[[3]]]]).sum(axis=1, keepdims=True)))
    far = saved(tmp_path / 'far.npz', frequency_hz=[10e9, 11e9], y_tt=ones * VECTORS['y_tt'],
                y_st=ones * VECTORS['y_st'], y_ss=ones * VECTORS['y_ss'])
    for file, wanted_hz in ((path, 9.9e9), (path, 10.2e9), (far, 10.5e9)):
        with pytest.raises(BoardError, match=re.escape(f'at {wanted_hz:.9g} Hz, exp')):
            CoupledNetwork(file=file).transfer(ports_at(wanted_hz), tunings)


def test_frequencies_of_a_file_have_six_digits_or_more(tmp_path):
    path = saved(tmp_path / 'board.npz', frequency_hz=9.99999e9)
    for wanted_hz in (9.99996e9, 10.00003e9):
        CoupledNetwork(file=path).transfer(ports_at(wanted_hz), VECTORS['tuning'][None])


@pytest.mark.parametrize(('step_hz', 'below', 'is_refused'), [
    (5e6, 0.5, False), (15e6, 0.5, True), (20e6, 0.98, False), (25e6, 0.3, True),
    (45e6, 0.5, True)])
def test_an_interpolated_transfer_is_accurate_or_the_file_is_refused(
        step_hz, below, is_refused, tmp_path):
    rng, along = np.random.default_rng(0), 0.036 * np.arange(1, 11)
    elements = np.array([[0, y, z] for z in (0, 0.036) for y in along])

    def board_at(*frequencies_hz):
        arrays = admittances(np.array(frequencies_hz), Guides(0.036, 0.012, 0.4, 2.0),
                             np.tile(along, 2), elements, np.repeat([0, 1], 10), np.arange(2), 0.1)
        own = np.diagonal(arrays['y_ss'].real, axis1=1, axis2=2).mean()
        np.savez(tmp_path / f'{len(frequencies_hz)}.npz', **arrays,
                 load_conductance_s=0.05 * own, load_susceptance_slope_s=8 * own)
        return CoupledNetwork(file=str(tmp_path / f'{len(frequencies_hz)}.npz'))

    exact, sampled = board_at(2.5e9), board_at(2.5e9 - below * step_hz, 2.5e9 + (
        1 - below) * step_hz)
    ports, tunings = ports_at(2.5e9), rng.uniform(size=(1, 5, 20))
    expected = exact.transfer(ports, tunings)
    error = np.linalg.norm(sampled.transfer(ports, tunings) - expected) / np.linalg.norm(expected)
    reason = sampled.misfit(Scenario(
        elements_per_side=(10, 2), n_feeds=2, n_subbands=1, center_frequencies_hz=[2.5e9]))
    assert (error > 0.03) == is_refused
    assert ('Hz would have an error of about' in reason) == is_refused


@pytest.mark.parametrize(('changes', 'expected'), [
    ({'y_ss': None}, 'no y_ss, expected the admittances of a network'),
    ({'y_st': np.ones((10, 3))}, r'y_tt: shape \(1, 2, 2\), expected \(1, 3, 3\)'),
    ({'frequency_hz': -1.0}, 'frequency_hz: .*, expected ascending ones above 0'),
    ({'y_ss': VECTORS['y_ss'] + np.triu(np.ones((10, 10)), 1)}, 'not reciprocal at 1e.10 Hz: '),
    ({'y_ss': VECTORS['y_ss'] - 20 * np.eye(10)}, 'not passive at 1e.10 Hz: '),
    ({'y_ss': VECTORS['y_ss'] * np.nan}, 'y_ss: not finite'),
    ({'load_conductance_s': np.ones(3)}, r'load_conductance_s: shape \(3,\), expected a number'),
])
def test_a_file_with_impossible_admittances_is_refused(changes, expected, tmp_path):
    with pytest.raises(BoardError, match=expected):
        Admittances.load(saved(tmp_path / 'board.npz', **changes))


def test_loads_come_from_the_file_or_the_scenario(tmp_path):
    path = saved(tmp_path / 'board.npz', load_conductance_s=None)
    with pytest.raises(BoardError, match='^load_conductance_s: None, expected a number, as '):
        CoupledNetwork(file=path)
    board = CoupledNetwork(file=path, load_conductance_s=VECTORS['load_conductance_s'], gain=2.0)
    transfer = board.transfer(ports_at(10e9), VECTORS['tuning'][None])
    np.testing.assert_allclose(transfer[0, 0], 2 * VECTORS['transfer'])


def test_a_network_belongs_to_the_scenario_by_its_content(coupled, tmp_path):
    assert Scenario(**coupled.changes()) == coupled
    file = tmp_path / 'copy.npz'
    np.savez(file, **board_of_guides(SMALL))
    (tmp_path / 'scenario.yaml').write_text(
        'elements_per_side: 4\nn_feeds: 2\nn_subbands: 3\n'
        'board: {kind: network, file: copy.npz}\n', encoding='utf-8')
    copy = Scenario.from_yaml(tmp_path / 'scenario.yaml')
    assert copy == coupled
    assert copy.id == coupled.id
    assert copy.changes(tmp_path)['board']['file'].startswith('copy.npz@')
    np.savez(file, **board_of_guides(SMALL, loss_db_per_m=5.0))
    with pytest.raises(ScenarioError, match='^board: file: .*: digest .*the content has changed'):
        Scenario(**copy.changes())


def test_a_network_that_does_not_fit_is_refused_by_name(coupled):
    for changes, expected in (
            ({'elements_per_side': 5}, '16 elements and 2 feeds, expected 25 and 2'),
            ({'center_frequencies_hz': [2.5e9, 3.1e9]}, 'no admittances at 3.0'),
            ({'subband_spacing_hz': 1e6}, 'no admittances at 2.499'),
            ({'failed_element_share': 0.1}, "'network' with failed_element_share = 0.1")):
        with pytest.raises(ScenarioError, match='^board: ') as caught:
            dataclasses.replace(coupled, **changes)
        assert expected in str(caught.value)


def test_elements_of_guides_resonate_with_unit_rms_and_couple(coupled, tmp_path):
    board, arrays = coupled.board, board_of_guides(SMALL)
    arrays['y_ss'] = arrays['y_ss'] * np.eye(16)
    np.savez(tmp_path / 'alone.npz', **arrays)
    alone = CoupledNetwork(file=str(tmp_path / 'alone.npz'))
    resonant = np.full((2, 1, 16), 0.5)
    ports = ports_of(coupled)
    transfer = alone.transfer(ports, resonant)
    # Each element is connected to one of the two feeds.
    assert np.sqrt(2 * np.mean(np.abs(transfer)**2)) == pytest.approx(1, rel=0.01)
    together = board.transfer(ports, resonant)
    assert np.linalg.norm(together - transfer) > 0.5 * np.linalg.norm(together)


def test_the_command_writes_a_board(tmp_path, capsys):
    scenario, output = tmp_path / 'scenario.yaml', tmp_path / 'board.npz'
    scenario.write_text('elements_per_side: 4\nn_feeds: 2\nn_subbands: 3\nboard: none\n',
                        encoding='utf-8')
    assert main(['waveguides', '--scenario', str(scenario), '--output', str(output)]) == 0
    assert '4 frequencies, 16 elements, 2 feeds' in capsys.readouterr().out
    board = CoupledNetwork(file=str(output))
    assert board == dataclasses.replace(SMALL, board=board).board
    scenario.write_text('element_interval_wavelengths: 0.1\n', encoding='utf-8')
    assert main(['waveguides', '--scenario', str(scenario), '--output', str(output)]) == 2
    assert 'width_m: ' in capsys.readouterr().err


def touchstone(path, matrix, options, head=''):
    rows = '\n'.join(' '.join(f'{float(z.real)!r} {float(z.imag)!r}' for z in row)
                     for row in matrix)
    path.write_text(f'{head}# Hz {options} RI R 100\n1e10 {rows}\n', encoding='utf-8')
    return str(path)


def test_a_touchstone_file_becomes_a_board(tmp_path, capsys):
    pytest.importorskip('skrf')
    whole = np.block([[VECTORS['y_tt'], VECTORS['y_st'].T], [VECTORS['y_st'], VECTORS['y_ss']]])
    identity, output = np.eye(12), str(tmp_path / 'board.npz')
    scattering = np.linalg.solve(identity + 100 * whole, identity - 100 * whole)
    arguments = ['--feeds', '2', '--conductance', str(VECTORS['load_conductance_s']), '--slope',
                 str(VECTORS['load_susceptance_slope_s']), '--output', output]
    file = touchstone(tmp_path / 'board.s12p', scattering, 'S')
    assert main(['touchstone', file, *arguments]) == 0
    transfer = CoupledNetwork(file=output).transfer(ports_at(10e9), VECTORS['tuning'][None])
    np.testing.assert_allclose(transfer[0, 0], VECTORS['transfer'], atol=1e-7)
    capsys.readouterr()
    for content, expected in (
            (touchstone(tmp_path / 'y.s12p', 100 * whole, 'Y'), 'parameter Y of version 1'),
            (touchstone(tmp_path / 'nan.s12p', scattering * np.nan, 'S'), 'NaN'),
            (touchstone(tmp_path / 'low.s12p', scattering, 'S',
                        '[Version] 2.0\n[Matrix Format] Lower\n'), 'a lower or upper matrix')):
        assert main(['touchstone', content, *arguments]) == 2
        assert expected in capsys.readouterr().err
