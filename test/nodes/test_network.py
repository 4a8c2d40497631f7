"""The executable that runs a whole network in one process; two of them on one domain."""

import types

import pytest
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.roster import UNIQUE


@pytest.fixture(scope='module')
def networks(module_processes, make_watch, small_files):
    """Two networks on one domain, with different users, seeds and codebooks."""
    result = {}
    for namespace, users, codebook in (('/a', 1, 'first'), ('/b', 2, 'second')):
        process = module_processes.start(
            'network', namespace=namespace, users=users, seed=users, rest_s=0.02,
            scenario_file=small_files / 'scenario.yaml',
            codebook_file=small_files / f'{codebook}.yaml')
        result[namespace] = types.SimpleNamespace(
            process=process, watch=make_watch(namespace), users=set(range(1, users + 1)),
            codebook=Codebook.load(small_files / f'{codebook}.yaml'))
    return types.SimpleNamespace(a=result['/a'], b=result['/b'])


def serve_all(network, n=2):
    for user in network.users:
        network.watch.until_served(n, user, [network.process])


def codebook_ids(watch, since=0):
    return {message.codebook_id for kind in watch.received for message in watch.received[kind]
            if hasattr(message, 'codebook_id') and message.cycle_id > since}


def test_each_network_serves_its_users_and_none_of_the_other(networks):
    for network in (networks.a, networks.b):
        serve_all(network)
        watch = network.watch
        assert {end.user for end in watch.served} == network.users
        watch.until(lambda watch=watch, users=network.users: users <= {
            truth.user for truth in watch.received[m.GroundTruth]}, 'all true positions')
        assert {truth.user for truth in watch.received[m.GroundTruth]} == network.users
        assert codebook_ids(watch) == {network.codebook.id}
    positions = [{tuple(truth.position) for truth in network.watch.received[m.GroundTruth]}
                 for network in (networks.a, networks.b)]
    assert not positions[0] & positions[1]
    names = {'network', *UNIQUE, 'user_1', 'watch'}
    expected = {'/a': names, '/b': {*names, 'user_2'}}

    def nodes():
        found = networks.a.watch.node.get_node_names_and_namespaces()
        return {space: {name for name, where in found if where == space} for space in expected}
    # The names of nodes arrive independently of their messages.
    networks.a.watch.until(lambda: nodes() == expected, 'the names of the nodes')


def test_a_new_codebook_is_used_from_one_cycle_to_the_next(networks):
    watch, process = networks.a.watch, networks.a.process
    watch.until_served(processes=[process])
    parameters = [Parameter(name, value=value)
                  for name, value in networks.b.codebook.to_parameters().items()]
    answer = watch.call(AsyncParameterClient(watch.node, 'optimizer'),
                          lambda client: client.set_parameters_atomically(parameters), [process])
    assert answer.result.successful

    def switched():
        received = (watch.of_cycle(m.ReceivedSignals, end.cycle_id) for end in watch.served[-2:])
        return all(messages and messages[0].codebook_id == networks.b.codebook.id
                   for messages in received)
    watch.until(switched, 'cycles with the new codebook', [process])
    last = watch.served[-1].cycle_id
    used = {}
    for kind in (m.RhsCommand, m.RhsConfiguration, m.ReceivedSignals, m.PositionEstimate, m.Beam,
                 m.Capacity):
        for message in watch.received[kind]:
            used.setdefault(message.cycle_id, set()).add(message.codebook_id)
    assert all(len(names) == 1 for names in used.values())
    in_order = [used[cycle_id] for cycle_id in sorted(used) if cycle_id <= last]
    changes = [one for one, next_one in zip(in_order, in_order[1:], strict=False)
               if one != next_one]
    assert changes == [{networks.a.codebook.id}]
    serve_all(networks.b)
    assert codebook_ids(networks.b.watch) == {networks.b.codebook.id}
