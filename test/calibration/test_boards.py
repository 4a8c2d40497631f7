"""Comparison of boards, and estimation of their parameters, from pilots."""

import dataclasses
import functools
import re

import numpy as np
import pytest
from scipy.special import chdtri

from rhs_isac_ros.calibration import Pilots, board_evidence, fit_board
from rhs_isac_ros.calibration.estimate import log_evidence
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario, simulate_received
from rhs_isac_ros.model.boards import board_of
from rhs_isac_ros.model.elementwise import PhaseShift
from rhs_isac_ros.model.waveguides import board_of_guides
from rhs_isac_ros.positioning import make_estimator

TRUE = {'kind': 'resonant', 'quality_factor': 30.0, 'loss_db_per_m': 4.0}
GRID = Scenario(n_subbands=2, n_frames=6, elements_per_side=5, board=TRUE)
NUMBER = r'[\d.e+]+'
UNKNOWN = {'user_gain_std_db': 3.0, 'phase_std_rad': 2 * np.pi}


class OwnBoard(PhaseShift):
    """A board of a plug-in with a number that is no field."""

    kind, share = 'own', 0.5


def pilots_of(scenario, n=60, seed=0):
    rng = np.random.default_rng(seed)
    codebook = random_codebook(scenario, rng)
    positions = scenario.sample_positions(n, rng)
    return Pilots(codebook, positions, simulate_received(scenario, codebook, positions, rng))


@pytest.mark.parametrize('changes', [{}, UNKNOWN])
def test_the_true_board_has_the_largest_evidence(changes):
    scenario = dataclasses.replace(GRID, **changes)
    pilots = [pilots_of(scenario)]
    evidence = [board_evidence(scenario, pilots, board_of(board)) for board in (
        TRUE, TRUE | {'quality_factor': 33.0}, 'resonant', 'phase', 'paper')]
    assert evidence[0] > max(evidence[1:]) + 5
    # The prior of the gain weighs less than the signals of a wrong board.
    assert min(evidence[:3]) > max(evidence[3:])


@pytest.mark.slow
def test_parameters_have_the_errors_that_their_covariance_states():
    true = dataclasses.replace(GRID, **UNKNOWN)
    scenario = dataclasses.replace(true, board='resonant')
    truth = np.array([30.0, 4.0, *GRID.center_frequencies_hz])
    fit = fit_board(scenario, [pilots_of(true, 40)],
                    ['quality_factor', 'loss_db_per_m', 'resonances_hz'])
    assert fit.names[-2:] == ('resonances_hz[0]', 'resonances_hz[1]')
    assert fit.board.quality_factor == fit.values[0] == pytest.approx(30, abs=3)
    error, n = fit.values - truth, len(truth)
    square = error @ np.linalg.solve(fit.covariance, error)
    assert chdtri(n, 0.995) < square < chdtri(n, 0.005)


@pytest.mark.slow
@pytest.mark.parametrize('changes', [{}, UNKNOWN])
def test_slopes_of_the_evidence_have_the_covariance_of_its_curvature(changes):
    """So that errors of fits have the stated covariance; gains also scale the multipath."""
    scenario, n = dataclasses.replace(GRID, **changes), 1500
    pilots, units = pilots_of(scenario, n, seed=7), np.diag([0.05, 0.25, 1e5])

    @functools.cache
    def evidence_at(quality, loss, band):
        board = board_of(TRUE | {'quality_factor': quality, 'loss_db_per_m': loss,
                                 'resonances_hz': [band, 3e9]})
        return log_evidence(MeasurementModel(
            dataclasses.replace(scenario, board=board), pilots.beams), pilots)

    def evidence(shift):
        return evidence_at(*(np.array([30.0, 4.0, 2.5e9]) + shift))
    slopes = np.array([evidence(unit) - evidence(-unit) for unit in units]) / 2
    curvature = np.array([[-np.sum(evidence(one + other) - evidence(one - other)
                                   - evidence(other - one) + evidence(-one - other)) / 4
                           for one in units] for other in units])
    ratios = np.linalg.eigvals(np.linalg.solve(curvature, n * np.cov(slopes))).real
    assert (0.85 < ratios).all()
    assert (ratios < 1.15).all()


def test_two_groups_of_pilots_are_one_survey():
    both = [pilots_of(GRID, 10, seed) for seed in range(2)]
    assert board_evidence(GRID, both, GRID.board) == pytest.approx(sum(
        board_evidence(GRID, [one], GRID.board) for one in both))


@pytest.mark.parametrize('name', ['masked', 'kind', 'nothing'])
def test_a_field_without_positive_numbers_is_refused(name):
    with pytest.raises(ValueError, match=f"^{name}: expected a field of the board 'resonant'"):
        fit_board(GRID, [pilots_of(GRID, 2)], [name])


@pytest.mark.parametrize(('board', 'name'), [
    ({'kind': 'states', 'states': [[1, 0], [0, 1]]}, 'states'), (OwnBoard(), 'share'),
    ('phase', 'kind')])
def test_fields_of_other_boards_that_cannot_be_fitted_are_refused_by_name(board, name):
    scenario = dataclasses.replace(GRID, board=board, amplitude_levels=2)
    with pytest.raises(ValueError, match=f"^{name}: expected a field of the board '"):
        fit_board(scenario, [pilots_of(scenario, 2)], [name])


def test_loads_of_coupled_elements_are_fitted_from_those_of_the_file(tmp_path):
    grid = dataclasses.replace(GRID, board='paper')
    arrays, path = board_of_guides(grid), tmp_path / 'board.npz'
    np.savez(path, **arrays)
    scenario = dataclasses.replace(grid, board={'kind': 'network', 'file': str(path)})
    true = 1.3 * float(arrays['load_susceptance_slope_s'])
    pilots = pilots_of(dataclasses.replace(scenario, board=dataclasses.replace(
        scenario.board, load_susceptance_slope_s=true)), 20)
    fit = fit_board(scenario, [pilots], ['load_susceptance_slope_s'])
    assert abs(fit.values[0] - true) < 3 * np.sqrt(fit.covariance[0, 0]) < 0.05 * true
    arrays['load_conductance_s'] = np.full(25, arrays['load_conductance_s'])
    np.savez(path, **arrays)
    scenario = dataclasses.replace(grid, board={'kind': 'network', 'file': str(path)})
    with pytest.raises(ValueError, match="^load_conductance_s: expected a field of the board 'n"):
        fit_board(scenario, [pilots], ['load_conductance_s'])


def test_the_reason_of_a_missing_fix_names_the_declared_board():
    scenario = dataclasses.replace(GRID, multipath_to_los_db=-20.0)
    pilots = pilots_of(scenario, 10)
    for board, hint in (('phase', "; the surface may have another board than 'phase'"),
                        ('paper', '')):
        assumed = dataclasses.replace(scenario, board=board)
        reasons = [reason for reason in make_estimator(
            'bayes', assumed, pilots.beams).estimate(pilots.received).reason if reason]
        assert reasons
        for reason in reasons:
            assert re.fullmatch(f'residual energy at the best position: .*, .* {NUMBER}{hint}',
                                reason)
