"""A network with an emulated board, whose faults end cycles but not the service."""

import numpy as np
import pytest
import yaml
from faulty_board import FaultyBoard
from rclpy.node import Node

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m

SCENARIO = Scenario(
    n_subbands=2, n_frames=3, n_feeds=1, elements_per_side=16, amplitude_levels=2,
    roi_center_m=(3, 0, 0), roi_size_m=(1, 1, 1))
# Times for an answer of the board, and for a step of a cycle [s], which suffice on a busy machine.
ANSWER_S, STEP_S = 1.0, 4.0


@pytest.fixture(scope='module')
def board():
    with FaultyBoard(is_paced=True) as board:
        yield board


@pytest.fixture(scope='module')
def observed(module_bench, board, tmp_path_factory):
    """The states and the estimates of a network that serves a user."""
    bench, folder = module_bench, tmp_path_factory.mktemp('network')
    (folder / 'scenario.yaml').write_text(yaml.safe_dump(SCENARIO.changes()), encoding='utf-8')
    random_codebook(SCENARIO, np.random.default_rng(0)).save(folder / 'codebook.yaml')
    for role, values in {
            'optimizer': {'codebook_file': folder / 'codebook.yaml'}, 'rhs_controller': {},
            'positioner': {'table_folder': folder}, 'transmission': {},
            'channel': {'surface': 'opensourceris',
                        'surface_options': f'port={board.port} timeout_s={ANSWER_S}'},
            'user': {'position_m': [3.0, 0.1, 0.2], 'step_timeout_s': STEP_S},
            'bs': {'rest_s': 0.02, 'step_timeout_s': STEP_S}}.items():
        bench.add_role(role, values={'scenario_file': folder / 'scenario.yaml', **values})
    receiver = bench.add(Node, 'receiver')
    return bench.collect(receiver, m.ProtocolState), bench.collect(receiver, m.PositionEstimate)


@pytest.fixture
def served(module_bench, observed):
    """Return a function that awaits the end of a cycle with service."""
    states, _ = observed

    def wait():
        n = len(states)
        return module_bench.until(lambda: [
            state.cycle_id for state in states[n:] if state.outcome == 'served'],
            'a served cycle')[0]
    return wait


# At a pattern of the first band, of the second one or of the beam.
@pytest.mark.parametrize(('fault', 'pattern'), [
    ('late', 0), ('occupied', SCENARIO.n_frames), ('restart', 2 * SCENARIO.n_frames)])
def test_users_are_served_again_after_a_fault(module_bench, board, served, fault, pattern):
    served()
    occurs = board.n_patterns + pattern
    board.faults = {occurs: fault}
    module_bench.until(lambda: board.n_patterns > occurs, 'the fault')
    if fault == 'occupied':
        board.plug()
    served()


def test_without_a_board_there_are_no_estimates(module_bench, board, observed, served):
    states, estimates = observed
    served()
    board.unplug()
    n = len(states)
    # The cycle in progress ends, and the next one is given up.
    given_up = module_bench.until(
        lambda: [state.cycle_id for state in states[n:] if state.outcome == 'channel_silent'],
        'a cycle that is given up')
    board.plug()
    assert served() > given_up[0]
    assert not {estimate.cycle_id for estimate in estimates}.intersection(given_up)
