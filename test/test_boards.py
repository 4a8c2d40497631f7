"""Every board with everything that depends on it: each combination runs, or is refused by name."""

import dataclasses
import json

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.calibration import Pilots, calibrate, fit_board, known_states
from rhs_isac_ros.codebook import optimize
from rhs_isac_ros.codebook.cell import Cell
from rhs_isac_ros.codebook.unoptimised import directional_codebook, random_codebook
from rhs_isac_ros.link import applied_beam, capacity, capacity_report, choose_beam
from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.waveguides import board_of_guides
from rhs_isac_ros.positioning import BayesEstimator, Tracker
from rhs_isac_ros.positioning.site import Site, SiteEstimator
from rhs_isac_ros.system import System

GRID = Scenario(n_subbands=2, n_frames=3, elements_per_side=4, n_feeds=2,
                roi_center_m=(4, 0, 0), roi_size_m=(1, 1, 0.5))
BOARDS = {
    'lossy': {'kind': 'paper', 'loss_db_per_m': 9.0, 'masked': [0]}, 'phase': 'phase',
    'resonant': 'resonant', 'states': {'kind': 'states', 'states': [[0.5, 0.5], [-1, 0]]},
    'three states': {'kind': 'states', 'states': [[0.5, 0.5], [-1, 0], [0.3, -0.7]]},
    'network': {'kind': 'network'}}
USER = np.array([[4.1, 0.2, 0.1]])


@pytest.fixture(scope='module')
def network_file(tmp_path_factory):
    path = tmp_path_factory.mktemp('boards') / 'board.npz'
    np.savez(path, **board_of_guides(GRID))
    return str(path)


@pytest.fixture(params=BOARDS)
def system(request, network_file):
    board = BOARDS[request.param]
    if request.param == 'network':
        board = board | {'file': network_file}
    scenario = dataclasses.replace(
        GRID, board=board, amplitude_levels=len(board.get('states', ()))
        if isinstance(board, dict) else 0)
    return System(scenario, random_codebook(scenario, np.random.default_rng(0)))


def optimised(system):
    scenario = Scenario(**json.loads(json.dumps(system.scenario.changes())))
    assert scenario == system.scenario
    result = optimize(scenario, n_positions=8, max_steps=3)
    assert result.history[-1].value_m2 < result.history[0].value_m2


def of_a_library(system):
    cell = Cell((4.0, 0.0, 0.0), 0.2)
    codebook = optimize(system.scenario, n_positions=4, max_steps=2, objective='error',
                        start=system.codebook, prior=cell).codebook
    codebook.check(system.scenario)


def located(system):
    estimate = BayesEstimator(system).estimate(system.sample(USER, np.random.default_rng(1)))
    assert np.isfinite(estimate.mean).all()


def bounded(system):
    assert (crlb(system.scenario, system.codebook, USER) > 0).all()


def steered(system, surface=None):
    """The beam that is designed is the best one of what is applied."""
    scenario = system.scenario
    choice = choose_beam(scenario, USER[0], 0.01 * np.eye(3), surface=surface)
    assert choice.expected_bps > 0
    report = capacity_report(scenario, choice.beam, USER[0], surface=surface)
    assert report.actual_bps > 0
    step = (1 / (scenario.amplitude_levels - 1) if scenario.amplitude_levels else
            1.0 if scenario.board.is_affine else 0.02)
    for change in step * np.concatenate([np.eye(16), -np.eye(16)]):
        analog = np.clip(choice.beam.analog + change, 0, 1)
        other = applied_beam(dataclasses.replace(choice.beam, analog=analog), surface)
        assert capacity(scenario, other, USER)[0] <= (1 + 1e-4) * report.actual_bps


def steered_with_offsets(system):
    gains = 1 + 0.2 * np.random.default_rng(4).normal(size=(16, 2)) @ [1, 1j]
    steered(system, SurfaceEstimate(
        gains, 0.5 * gains[::-1], [0.9, 1.1j], np.zeros((34, 0)), np.zeros(16)))


def calibrated(system):
    rng = np.random.default_rng(2)
    positions = system.scenario.sample_positions(40, rng)
    pilots = Pilots(system.codebook, positions, system.sample(positions, rng))
    found = calibrate(system.scenario, [pilots]).surface
    known = System(system.scenario, system.codebook, found)
    assert np.isfinite(known.crlb(USER)).all()


def focused(system):
    directional_codebook(system.scenario).check(system.scenario)


def with_states(system):
    known_states(system.scenario, 1, -1)


def with_failures(system):
    dataclasses.replace(system.scenario, failed_element_share=0.02)


def at_a_site(system):
    moved = dataclasses.replace(system.scenario, pose=Pose((4, -4, 0), (0, 0, 1, 1)))
    site = Site({'front': system, 'side': System(moved, system.codebook)},
                np.array([[3.5, -0.5, -0.25], [4.5, 0.5, 0.25]]))
    received = site.sample(USER, np.random.default_rng(3))
    assert np.isfinite(SiteEstimator(site).estimate(received).mean).all()


def impaired(system):
    scenario = dataclasses.replace(
        system.scenario, band_phase_std_rad=1.0, user_gain_std_db=3.0, timing_std_s=1e-8,
        element_error_rms=0.03)
    other = System(scenario, system.codebook)
    assert (other.crlb(USER) > system.crlb(USER)).all()
    located(other)


def tracked(system):
    """The second cycle takes the first one as its prior."""
    tracker, rng = Tracker(BayesEstimator(system)), np.random.default_rng(5)
    first, second = (tracker.update(time_s, system.sample(USER, rng)[0]) for time_s in (0.0, 0.1))
    assert np.trace(second.covariance[:3, :3]) < np.trace(first.covariance[:3, :3])


def moving(system):
    """The user walks during the cycle."""
    walking = dataclasses.replace(system.scenario, user_speed_std_mps=1.0, retune_s=0.01)
    other = System(walking, system.codebook)
    estimate = BayesEstimator(other).estimate(other.sample(USER, np.random.default_rng(6)))
    assert np.isfinite(estimate.mean).all()


def fitted(system):
    """Pilots tell the gains of feeds, or of a network."""
    board, rng = system.scenario.board, np.random.default_rng(7)
    name, true = ('gain', 1.2) if board.kind == 'network' else ('feed_gains', [1.2, 0.8])
    other = dataclasses.replace(
        system.scenario, board=dataclasses.replace(board, **{name: true}))
    positions = system.scenario.sample_positions(40, rng)
    pilots = Pilots(system.codebook, positions,
                    System(other, system.codebook).sample(positions, rng))
    fit = fit_board(system.scenario, [pilots], [name])
    errors = (fit.values - true) / np.sqrt(np.diagonal(fit.covariance))
    assert (np.abs(errors) < 4).all()


CELLS = [optimised, of_a_library, located, bounded, steered, steered_with_offsets,
         calibrated, focused, with_states, with_failures, at_a_site, impaired, tracked, moving,
         fitted]
COUPLED = "'network' couples its elements"
REFUSED = {
    **{(cell, 'network'): COUPLED for cell in (calibrated, focused, steered_with_offsets)},
    **{(with_states, kind): f"board: '{kind}' with states of elements"
       for kind in ('phase', 'resonant', 'states', 'network')},
    **{(with_failures, kind): f"'{kind}' with failed_element_share = 0.02"
       for kind in ('phase', 'resonant', 'states', 'network')}}


@pytest.mark.filterwarnings('ignore::rhs_isac_ros.calibration.CalibrationWarning')
@pytest.mark.parametrize('cell', CELLS, ids=lambda cell: cell.__name__)
def test_every_combination_runs_or_is_refused_by_name(cell, system):
    expected = REFUSED.get((cell, system.scenario.board.kind))
    if expected is None:
        cell(system)
        return
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - compared below
        cell(system)
    assert expected in str(caught.value)
