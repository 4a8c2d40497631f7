"""The policy allows each node what it does, as the graph of a network shows, and nothing else."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from rhs_isac_ros.ros import topics
from rhs_isac_ros.tools import permissions

ROOT = Path(__file__).parents[2]
RIGHTS = ('publish', 'subscribe', 'reply', 'request')


def rules(text):
    """What a policy allows, with full names, by path of the enclave: {right: names}."""
    found = {}
    for enclave in ElementTree.fromstring(text).iter('enclave'):
        (profile,) = enclave.iter('profile')
        space = profile.get('ns').rstrip('/')
        rights = {right: set() for right in RIGHTS}
        for group in profile:
            for right, rule in group.attrib.items():
                assert rule == 'ALLOW'
                for name in (element.text for element in group):
                    full = name.replace('~', f'{space}/{profile.get("node")}')
                    rights[right].add(full if full.startswith('/') else f'{space}/{full}')
        found[enclave.get('path')] = rights
    return found


def test_the_file_is_what_the_command_prints(capsys):
    assert permissions.main([]) == 0
    printed = capsys.readouterr().out
    assert printed == (ROOT / 'config' / 'sros2' / 'policy.xml').read_text(encoding='utf-8')


def test_a_user_says_nothing_in_the_name_of_another_role():
    allowed = rules(permissions.policy(users=3))
    mine = {f'/{name}' for name in ('ack', 'data', 'ground_truth', 'pilot', topics.DIAGNOSTICS)}
    always = {'/parameter_events', '/rosout'}
    for number in (1, 2, 3):
        assert allowed[f'/user_{number}']['publish'] == mine | always
        assert not allowed[f'/user_{number}']['request']


def test_nobody_but_the_operator_sets_parameters_of_others():
    for path, rights in rules(permissions.policy()).items():
        if path != '/operator':
            assert rights['request'] <= {'/optimizer/get_parameters'}
            assert {name.rpartition('/')[0] for name in rights['reply']} == {path}


def test_publishers_are_those_of_the_documentation():
    page = (ROOT / 'docs' / 'interfaces.rst').read_text(encoding='utf-8')
    rows = re.findall(r'^   "``([a-z_/]+)``", "``[A-Za-z_/]+``", "([a-z_, ]+)"', page, re.M)
    allowed = rules(permissions.policy(users=1))
    assert len(rows) >= len(topics.NAMES)
    for topic, publishers in rows:
        may = {path[1:].replace('user_1', 'user') for path, rights in allowed.items()
               if f'/{topic}' in rights['publish']}
        # The visualizer has no diagnostics, and the operator says nothing.
        everybody = {path[1:].replace('user_1', 'user') for path in allowed} - {
            'visualizer', 'operator'}
        assert may == (everybody if publishers == 'every node' else set(publishers.split(', ')))


@pytest.mark.parametrize('arguments', [['--namespace', 'lab'], ['--users', '-1']])
def test_wrong_arguments_are_refused(arguments, capsys):
    with pytest.raises(SystemExit):
        permissions.main(arguments)
    assert 'error: argument' in capsys.readouterr().err


def test_policy_and_graph_agree(processes, make_watch, small_files):
    """No right is missing in a running network, and none is left over."""
    space, watch = '/closed', make_watch('/closed')
    network = processes.start(
        'network', namespace=space, users=2, rest_s=0.0,
        scenario_file=small_files / 'scenario.yaml', codebook_file=small_files / 'first.yaml')
    visualizer = processes.start(
        'visualizer', namespace=space, scenario_file=small_files / 'scenario.yaml')
    allowed = rules(permissions.policy(space, users=2))
    del allowed[f'{space}/operator']

    def used(path):
        ask, name = watch.node, path.rpartition('/')[2]
        if (name, space) not in ask.get_node_names_and_namespaces():
            return {right: set() for right in RIGHTS}
        found = {
            'publish': ask.get_publisher_names_and_types_by_node(name, space),
            'subscribe': ask.get_subscriber_names_and_types_by_node(name, space),
            'reply': ask.get_service_names_and_types_by_node(name, space),
            'request': ask.get_client_names_and_types_by_node(name, space)}
        return {right: {name for name, _ in pairs} for right, pairs in found.items()}

    # The last to listen does so for the first cycle; who does too much has done it by then.
    watch.until_served(2, processes=[network, visualizer])
    watch.until(lambda: {f'{place}/{name}' for name, place in
                         watch.node.get_node_names_and_namespaces()} >= allowed.keys(),
                'every node in the graph', [network, visualizer])
    for path, rights in allowed.items():
        watch.until(lambda path=path, rights=rights: all(
            used(path)[right] >= rights[right] for right in RIGHTS), f'{path} in the graph')
        assert used(path) == rights, path
