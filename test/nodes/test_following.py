"""Codebooks of a library in a network of processes, and a node that lacks the library."""

import signal
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.codebook.library import Library
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.diagnostics import subscribe_reports
from rhs_isac_ros.ros.parameters import NODES
from rhs_isac_ros.ros.roster import UNIQUE

CONFIG = Path(__file__).parents[2] / 'config'
LIBRARY = CONFIG / 'library_bandplan.npz'
# A slow user, whose position is known well enough even if cycles are seconds apart.
VALUES = {
    'scenario_file': CONFIG / 'bandplan.yaml', 'library_file': LIBRARY,
    'codebook_file': CONFIG / 'codebook_bandplan.yaml', 'prior': 'track',
    'track_speed_mps': 0.02, 'rest_s': 0.02}


@pytest.fixture
def start(processes):
    """Return a function that starts a role with the values that it has as parameters."""
    def start(role, without=(), **others):
        known = {parameter.name for parameter in NODES[role]}.difference(without)
        return processes.start(role, **others, **{
            name: value for name, value in VALUES.items() if name in known})
    return start


def test_a_network_uses_its_library_until_a_node_lacks_it(start, make_watch):
    library, watch = Library.load(LIBRARY), make_watch()
    running = {role: start(role) for role in UNIQUE}
    summaries = {}
    subscribe_reports(watch.node, lambda name, report: summaries.update({name: report.summary}))
    running['user'] = start('user', user_id=1, position_m=[9.0, 1.5, 0.3])

    def followed():
        """Return cycles that were served with a codebook of the library."""
        return [end.cycle_id for end in watch.served if any(
            signals.codebook_id in library.by_id
            for signals in watch.of_cycle(m.ReceivedSignals, end.cycle_id))]
    cycles = watch.until(lambda: followed()[4:], 'cycles that follow', running.values())
    for kind in (m.RhsCommand, m.RhsConfiguration, m.PositionEstimate, m.Beam):
        assert watch.of_cycle(kind, cycles[0])[0].codebook_id in library.by_id
    (estimate,) = watch.of_cycle(m.PositionEstimate, cycles[0])[:1]
    assert np.linalg.norm(estimate.position - [9.0, 1.5, 0.3]) < 1.0
    # The newer controller serves. Without the library, the base station does not count it.
    running['newer'] = start('rhs_controller', ['library_file'], name='newer')
    watch.until(lambda: '/newer: library of codebooks none' in summaries.get('bs', '')
                and summaries.get('user') == 'blocked: no_beacon', 'a pause', running.values())
    newer = running.pop('newer')
    newer.signal(signal.SIGINT)
    newer.wait()
    watch.until_served(2, processes=running.values())
