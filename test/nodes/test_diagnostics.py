"""Every node of a running network tells how it fares."""

from diagnostic_msgs.msg import DiagnosticArray

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, qos, topics

NODES = {'bs', 'channel', 'rhs_controller', 'positioner', 'transmission', 'optimizer', 'user_1'}


def test_every_node_tells_phase_cycles_drops_and_codebook(processes, make_watch, small_files):
    watch = make_watch('/told')
    told = {}

    def keep(message):
        for status in message.status:
            told[status.name.removeprefix('told/')] = status
    watch.node.create_subscription(
        DiagnosticArray, topics.DIAGNOSTICS, keep, qos.EXCHANGE)
    network = processes.start(
        'network', namespace='/told', users=1, rest_s=0.0,
        scenario_file=small_files / 'scenario.yaml', codebook_file=small_files / 'first.yaml')
    watch.until_served(3, processes=[network])
    told.clear()
    watch.until(lambda: told.keys() >= NODES, 'the diagnostics of every node', [network])
    values = {name: {pair.key: pair.value for pair in status.values}
              for name, status in told.items()}
    assert told.keys() == NODES
    assert int(values['bs']['cycles.served']) >= 3
    assert {'phase', 'cycle_ms.p50', 'handling_ms.p99'} <= values['bs'].keys()
    assert values['user_1']['phase'] in {'disconnected', 'listening', 'acknowledged', 'granted'}
    assert float(values['positioner']['estimate_ms.p50']) > 0
    takers = {'bs', 'rhs_controller', 'positioner', 'transmission', 'optimizer'}
    assert len({values[name]['codebook_id'] for name in takers}) == 1

    # What is malformed is counted where it is dropped.
    outlet = watch.outlet(m.Pilot)
    outlet.publish(convert.ros_type(m.Pilot)(cycle_id=1, user=1, band=99))
    watch.until(lambda: ('dropped.malformed', '1') in {
        (pair.key, pair.value) for pair in told['channel'].values}, 'the count', [network])
