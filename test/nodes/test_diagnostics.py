"""The diagnostics of every node of a running network."""

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from ros_messages import to_ros

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import EXCHANGE
from rhs_isac_ros.ros.roster import UNIQUE

NODES = {*UNIQUE, 'user_1'}


def test_every_node_reports_phase_cycles_drops_and_codebook(processes, make_watch, small_files):
    watch = make_watch('/diagnosed')
    reported = {}

    def store(message):
        for status in message.status:
            reported[status.name.removeprefix('diagnosed/')] = status
    watch.node.create_subscription(
        DiagnosticArray, topics.DIAGNOSTICS, store, EXCHANGE)
    network = processes.start(
        'network', namespace='/diagnosed', users=1, rest_s=0.0,
        scenario_file=small_files / 'scenario.yaml', codebook_file=small_files / 'first.yaml')
    watch.until_served(3, processes=[network])
    reported.clear()
    watch.until(lambda: reported.keys() >= NODES, 'the diagnostics of every node', [network])
    values = {name: {pair.key: pair.value for pair in status.values}
              for name, status in reported.items()}
    assert reported.keys() == NODES
    assert int(values['bs']['cycles.served']) >= 3
    assert {'phase', 'cycle_ms.p50', 'handling_ms.p99'} <= values['bs'].keys()
    assert values['user_1']['phase'] in {'disconnected', 'listening', 'acknowledged', 'granted'}
    assert float(values['positioner']['estimate_ms.p50']) > 0
    followers = {'bs', 'rhs_controller', 'positioner', 'transmission', 'optimizer'}
    assert len({values[name]['codebook_id'] for name in followers}) == 1

    # Malformed messages are counted where they are dropped.
    publisher = watch.publisher(m.Pilot)
    publisher.publish(to_ros(
        m.Pilot(cycle_id=1, user=1, band=99, symbols=np.ones(4, complex)), None))
    watch.until(lambda: ('dropped.malformed', '1') in {
        (pair.key, pair.value) for pair in reported['channel'].values}, 'the count', [network])
