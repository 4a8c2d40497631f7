"""Names, addresses and commands of the hosts."""

import ipaddress

import pytest

from system.hosts import plan


def test_every_node_has_one_host():
    nodes = sum(plan.HOSTS.values(), ())
    assert len(nodes) == len(set(nodes))
    assert plan.host_of('transmission') == 'positioner'
    assert plan.host_of('user_12') == 'users'
    with pytest.raises(ValueError, match="'radio', expected one of"):
        plan.host_of('radio')


def test_commands_act_inside_the_namespaces_of_the_run():
    for command in plan.create(4711):
        assert command[0] == 'ip'
        name = command[3] if command[1:3] == ('netns', 'add') else command[2]
        assert command[1] == '-n' or command[1:3] == ('netns', 'add')
        assert name.startswith('rhs_isac-4711-')
        if 'netns' in command[3:]:
            assert command[-1].startswith('rhs_isac-4711-')


def test_addresses_differ_and_are_in_one_network():
    given = [ipaddress.ip_interface(command[5]) for command in plan.create(1)
             if command[3:5] == ('address', 'add')]
    assert len(set(given)) == len(plan.HOSTS) + 1
    (network,) = {address.network for address in given}
    assert network.subnet_of(ipaddress.ip_network('198.18.0.0/15'))


def test_names_of_devices_differ_and_are_short_enough():
    ports = {plan.port(host) for host in (*plan.HOSTS, plan.OBSERVER)}
    assert len(ports) == len(plan.HOSTS) + 1
    assert max(map(len, ports)) <= 15


def test_namespaces_of_terminated_processes_are_stale():
    running, terminated = plan.namespace(1, 'users'), plan.namespace(22, 'users')
    names = [running, terminated, 'lab', 'rhs_isac-lab', 'other-22-users']
    assert plan.stale(names, lambda pid: pid == 1) == [terminated]


@pytest.mark.parametrize(('seconds', 'nodes'), [
    (4.0, ()), (6.0, ('bs',)), (22.0, ('bs',)), (25.0, ('bs', 'user'))])
def test_users_miss_an_unreachable_node_later_than_the_base_station(seconds, nodes):
    assert plan.waiting('channel', seconds) == nodes
