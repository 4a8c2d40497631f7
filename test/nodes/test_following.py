"""Codebooks of a library in a network, and a node of another process that lacks the library."""

import signal
from pathlib import Path

import numpy as np

from rhs_isac_ros.codebook.library import Library
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.diagnostics import subscribe_reports

CONFIG = Path(__file__).parents[2] / 'config'
LIBRARY = CONFIG / 'library_bandplan.npz'
SCENARIO = CONFIG / 'bandplan.yaml'


def test_a_network_uses_its_library_until_a_node_lacks_it(processes, make_watch):
    library, watch, space = Library.load(LIBRARY), make_watch('/following'), '/following'
    # A slow user, whose position is known well enough even if cycles are seconds apart.
    network = processes.start(
        'network', namespace=space, users=1, position_m=[9.0, 1.5, 0.3], rest_s=0.1,
        prior='track', track_speed_mps=0.02, scenario_file=SCENARIO, library_file=LIBRARY,
        codebook_file=CONFIG / 'codebook_bandplan.yaml')
    summaries = {}
    subscribe_reports(watch.node, lambda name, report: summaries.update({name: report.summary}))

    def followed():
        """Return cycles that were served with a codebook of the library."""
        return [end.cycle_id for end in watch.served if any(
            signals.codebook_id in library.by_id
            for signals in watch.of_cycle(m.ReceivedSignals, end.cycle_id))]
    cycles = watch.until(lambda: followed()[4:], 'cycles that follow', [network])
    for kind in (m.RhsCommand, m.RhsConfiguration, m.PositionEstimate, m.Beam):
        assert watch.of_cycle(kind, cycles[0])[0].codebook_id in library.by_id
    (estimate,) = watch.of_cycle(m.PositionEstimate, cycles[0])[:1]
    assert np.linalg.norm(estimate.position - [9.0, 1.5, 0.3]) < 1.0
    # The newer controller serves. Without the library, the base station does not count it.
    newer = processes.start(
        'rhs_controller', namespace=space, name='newer', scenario_file=SCENARIO)
    watch.until(lambda: '/newer: library of codebooks none' in summaries.get('following/bs', '')
                and summaries.get('following/user_1') == 'blocked: no_beacon', 'a pause',
                [network, newer])
    newer.signal(signal.SIGINT)
    newer.wait()
    watch.until_served(2, processes=[network])
