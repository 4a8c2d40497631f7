"""A network in one process: its diagnostics, its parameters, and another one on its domain."""

import types

import pytest
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.diagnostics import subscribe_reports
from rhs_isac_ros.ros.endpoints import EXCHANGE
from rhs_isac_ros.ros.roster import UNIQUE

NAMESPACE = 'dynamic'


class Running:
    """A running network: its diagnostics, and the parameters of its nodes."""

    def __init__(self, process, watch):
        self.process, self.watch = process, watch
        self.diagnostics = {}
        subscribe_reports(watch.node, lambda name, report: self.diagnostics.update(
            {name.removeprefix(f'{NAMESPACE}/'): report.details}))

    def set(self, node, **values):
        """Set parameters together and return the result."""
        return self.watch.set_parameters(node, values)

    def until_reported(self, *nodes, **values):
        """Wait until new diagnostics of nodes have the given values; None: no value."""
        wanted = {name.replace('__', '.'): value for name, value in values.items()}
        self.diagnostics.clear()
        self.watch.until(
            lambda: all(node in self.diagnostics and all(
                self.diagnostics[node].get(name) == value for name, value in wanted.items())
                for node in nodes),
            f'{wanted} of {nodes}', [self.process])


@pytest.fixture(scope='module')
def running(make_watch, module_processes, small_files):
    # Without a pause, cycles are faster than the observer.
    process = module_processes.start(
        'network', namespace=f'/{NAMESPACE}', users=2, rest_s=0.05,
        scenario_file=small_files / 'scenario.yaml',
        codebook_file=small_files / 'first.yaml')
    running = Running(process, make_watch(f'/{NAMESPACE}'))
    running.watch.until_served(2, processes=[process])
    return running


@pytest.fixture
def other(make_watch, processes, small_files):
    """Another network, with one user, another seed and the second codebook."""
    process = processes.start(
        'network', namespace='/other', users=1, seed=2, rest_s=0.05,
        scenario_file=small_files / 'scenario.yaml', codebook_file=small_files / 'second.yaml')
    return types.SimpleNamespace(process=process, watch=make_watch('/other'))


def test_each_network_serves_its_users_and_none_of_the_other(running, other, small_files):
    positions = []
    for network, users in ((running, {1, 2}), (other, {1})):
        watch = network.watch
        for user in users:
            watch.until_served(2, user, [network.process])
        assert {end.user for end in watch.served} == users
        positions.append({tuple(truth.position) for truth in watch.received[m.GroundTruth]})
    assert not positions[0] & positions[1]
    assert {signals.codebook_id for signals in other.watch.received[m.ReceivedSignals]} == {
        Codebook.load(small_files / 'second.yaml').id}
    names = {'network', *UNIQUE, 'user_1', 'watch'}
    expected = {'/other': names, f'/{NAMESPACE}': {*names, 'user_2'}}

    def nodes():
        found = running.watch.node.get_node_names_and_namespaces()
        return {space: {name for name, where in found if where == space} for space in expected}
    # The names of nodes arrive independently of their messages.
    running.watch.until(lambda: nodes() == expected, 'the names of the nodes')


def test_every_node_reports_its_state_its_cycles_and_the_codebook(running, small_files):
    first = Codebook.load(small_files / 'first.yaml').id
    running.until_reported('optimizer', 'bs', 'rhs_controller', 'positioner', 'transmission',
                           codebook_id=first)
    running.watch.until(lambda: running.diagnostics.keys() == {*UNIQUE, 'user_1', 'user_2'},
                        'every node', [running.process])
    values = running.diagnostics
    running.watch.until(
        lambda: int(values['bs'].get('cycles.served', 0)) >= 2 and 'cycle_ms.p50' in values['bs']
        and 'handling_ms.p99' in values['bs'] and values['bs']['phase']
        and float(values['positioner'].get('estimate_ms.p50', 0)) > 0
        and values['user_1']['phase'] in {'listening', 'acknowledged', 'granted'},
        'the statistics', [running.process])


def test_changes_of_policy_and_noise_are_reported(running):
    before = len(running.watch.given_up)
    assert running.set('bs', policy='first', receiver_noise=False).successful
    running.until_reported('bs', parameter__policy='first', parameter__receiver_noise='false',
                           pending__policy=None, pending__receiver_noise=None)
    assert running.set('bs', policy='round_robin', receiver_noise=True).successful
    running.watch.until_served(2, processes=[running.process])
    assert len(running.watch.given_up) == before
    assert "settings applied: receiver_noise 'false', policy 'first'" in running.process.log


def test_the_estimator_changes_without_the_loss_of_a_cycle(running):
    watch, before = running.watch, len(running.watch.given_up)
    for name in ('ml', 'bayes'):
        assert running.set('positioner', estimator=name).successful
        watch.until(lambda name=name: watch.received[m.PositionEstimate][-1].estimator == name,
                    name, [running.process])
    names = {}
    for estimate in watch.received[m.PositionEstimate]:
        assert names.setdefault(estimate.cycle_id, estimate.estimator) == estimate.estimator
    # One change to the other estimator and one back.
    order = [names[cycle_id] for cycle_id in sorted(names)]
    assert sum(a != b for a, b in zip(order, order[1:], strict=False)) == 2
    assert len(watch.given_up) == before


def test_users_are_tracked_on_request(running):
    """Odometry of both users begins with the prior."""
    watch, before, tracks = running.watch, len(running.watch.given_up), []
    for user in (1, 2):
        watch.node.create_subscription(
            Odometry, topics.ODOMETRY.format(user=user), tracks.append, EXCHANGE)
    assert running.set('positioner', prior='track').successful
    running.until_reported('positioner', parameter__prior='track', pending__prior=None)
    watch.until(lambda: {track.child_frame_id for track in tracks} == {
        'dynamic/user_1', 'dynamic/user_2'}, 'odometry', [running.process])
    assert running.set('positioner', prior='region').successful
    running.until_reported('positioner', parameter__prior='region', pending__prior=None)
    assert len(watch.given_up) == before


def test_band_and_impairments_change(running):
    for band in (0, 1):
        assert running.set('transmission', band=band).successful
        running.watch.until(lambda band=band: {
            beam.band for beam in running.watch.received[m.Beam][-3:]} == {band},
            f'band {band}', [running.process])
    assert running.set('transmission', band=-1).successful
    assert running.set('channel', double_probability=1.0, delay_s=0.001).successful
    running.watch.until_served(2, processes=[running.process])
    running.until_reported('channel', parameter__double_probability='1.0',
                           parameter__delay_s='0.001', pending__delay_s=None)
    assert int(running.diagnostics['channel']['dropped.emulated_double']) > 0
    assert running.set('channel', double_probability=0.0, delay_s=0.0).successful


def test_a_new_codebook_is_used_from_one_cycle_to_the_next(running, small_files):
    watch, begin = running.watch, running.watch.until_served(2)[-1].cycle_id
    first, second = (Codebook.load(small_files / f'{name}.yaml') for name in ('first', 'second'))
    for codebook in (second, first):
        assert running.set('optimizer', **codebook.to_parameters()).successful
        running.until_reported('optimizer', 'bs', 'rhs_controller', 'positioner', 'transmission',
                               codebook_id=codebook.id, pending__codebook_id=None)
    last, used = watch.until_served(2)[-1].cycle_id, {}
    for kind in (m.RhsCommand, m.RhsConfiguration, m.ReceivedSignals, m.PositionEstimate, m.Beam,
                 m.Capacity):
        for message in watch.received[kind]:
            if begin <= message.cycle_id <= last:
                used.setdefault(message.cycle_id, set()).add(message.codebook_id)
    assert all(len(names) == 1 for names in used.values())
    in_order = [name for cycle_id in sorted(used) for name in used[cycle_id]]
    assert [name for name, before in zip(in_order, ['', *in_order], strict=False)
            if name != before] == [first.id, second.id, first.id]


def test_the_base_station_can_be_paused_stepped_and_resumed(running):
    watch = running.watch
    clients = {name: watch.node.create_client(Trigger, f'bs/{name}')
               for name in ('pause', 'resume', 'step')}

    def request(name):
        response = watch.call(clients[name], lambda client: client.call_async(Trigger.Request()))
        return response.success, response.message
    assert request('step') == (False, 'not paused; a step requires a pause')
    assert request('pause')[0]
    running.until_reported('bs', phase='paused')

    def ended():
        # Some signals have no position, and their cycle ends without being served.
        return sum(bool(message.outcome) for message in watch.received[m.ProtocolState])
    before = ended()
    assert request('step')[0]
    watch.until(lambda: ended() > before, 'the end of the cycle', [running.process])
    running.until_reported('bs', phase='paused')
    assert ended() == before + 1
    assert request('resume') == (True, 'resumed')
    watch.until_served(2, processes=[running.process])
