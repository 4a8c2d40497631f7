"""The policy allows exactly what the nodes of a network use."""

import contextlib
import importlib.util
from pathlib import Path

import pytest
from policy_rules import RIGHTS, permissions, rules, used

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.nodes.user import UserNode
from rhs_isac_ros.positioning import Site
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.recording import Recorder, recorded_topics
from rhs_isac_ros.ros.session import Session
from rhs_isac_ros.tools import republish
from rhs_isac_ros.tools.calibrate import CalibratorNode, PilotLog
from rhs_isac_ros.tools.record import RecorderNode
from rhs_isac_ros.tools.republish import RepublisherNode
from rhs_isac_ros.tools.snapshot import SnapshotNode
from rhs_isac_ros.tools.view import ViewNode
from rhs_isac_ros.tools.watch import WatchNode


def test_the_command_prints_the_policy_of_two_users(capsys):
    assert permissions.main([]) == 0
    assert capsys.readouterr().out == permissions.policy('/', 2)


def test_a_robot_may_read_its_odometry_or_transforms(bench):
    node = bench.add(UserNode, 'user_1', namespace='/closed', values={
        'use_sim_time': True, 'mobility': 'odometry', 'odometry_topic': '/robot/odom'})
    allowed = rules(permissions.policy('/closed', 3, {1: '/robot/odom', 3: 'tf'}, True))
    rights = allowed['/closed/user_1']['subscribe']
    bench.until(lambda: used(node, '/closed/user_1')['subscribe'] >= rights, 'the subscriptions')
    assert used(node, '/closed/user_1')['subscribe'] == rights
    plain, robot = allowed['/closed/user_2'], allowed['/closed/user_3']
    assert '/clock' in plain['subscribe'] and '/robot/odom' not in plain['subscribe']
    assert robot['subscribe'] - plain['subscribe'] == {topics.TF, topics.TF_STATIC}
    assert '/closed/tf2_frames' in robot['reply']
    assert allowed['/closed/network']['subscribe'] >= rights | robot['subscribe']


@pytest.fixture(scope='module')
def of_site():
    site = Site.from_yaml(Path(__file__).parents[2] / 'config' / 'site.yaml')
    return rules(permissions.policy('/lab', site=site))


# The rights of the running nodes of a site are those that they use; see test_site.py.
def test_no_node_of_a_site_may_publish_in_the_namespace_of_a_surface_but_its_own(of_site):
    for name in ('visualizer', 'operator', 'replay'):
        read = of_site[f'/lab/side/{name}']['subscribe']
        assert not [one for one in read if one.startswith('/lab/front/')]
    for path, rights in of_site.items():
        space = path.rpartition('/')[0]
        for right in ('publish', 'reply'):
            assert {name.rpartition('/')[0] for name in rights[right]
                    if name.startswith('/lab/') and not name.startswith(f'{space}/')} == set()


def test_the_process_of_a_site_has_the_permissions_of_all_nodes(of_site):
    process = of_site.pop('/lab/network')
    for path, rights in of_site.items():
        if path.rpartition('/')[2] not in ('operator', 'replay', 'visualizer'):
            assert all(rights[right] <= process[right] for right in RIGHTS), path


def test_the_operator_of_a_site_has_the_permissions_of_those_of_its_surfaces(of_site):
    for name in ('front', 'side'):
        for right in RIGHTS:
            assert of_site[f'/lab/{name}/operator'][right] <= of_site['/lab/operator'][right]
    assert '/lab/fusion/set_parameters' in of_site['/lab/operator']['request']
    assert {'/lab/front/bs/pause', '/lab/side/channel/set_parameters'} <= of_site[
        '/lab/operator']['request']
    # Users and the base station are those of the leader.
    assert {path for path in of_site if 'user' in path or path.endswith('/bs')} == {
        f'/lab/front/{name}' for name in ('bs', 'user_1', 'user_2', 'users')}


def test_only_the_operator_may_set_parameters_of_other_nodes():
    allowed = rules(permissions.policy())
    assert {'/bs/set_parameters', '/bs/pause', '/users/set_parameters'} <= allowed.pop(
        '/operator')['request']
    del allowed['/replay']
    for path, rights in allowed.items():
        assert rights['request'] <= {'/optimizer/get_parameters'}
        if path != '/network':
            assert {name.rpartition('/')[0] for name in rights['reply']} <= {
                path, *(('/locate/_action',) if path == '/bs' else ())}


def test_the_process_of_a_network_has_the_permissions_of_its_nodes():
    allowed = rules(permissions.policy(users=2))
    others = [rights for path, rights in allowed.items()
              if path not in ('/network', '/operator', '/replay', '/visualizer')]
    for right in RIGHTS:
        united = set().union(*(rights[right] for rights in others))
        assert allowed['/network'][right] - united <= {
            service.replace('~', '/network') for service in permissions._OFFERED_SERVICES}
        assert united <= allowed['/network'][right]


def test_a_replay_may_publish_every_recorded_topic_and_be_an_optimizer():
    allowed = rules(permissions.policy(users=2))
    rights, optimizer = allowed['/replay'], allowed['/optimizer']
    assert rights['publish'] == {
        *(f'/{name.lstrip("/")}' for name in recorded_topics()), '/parameter_events', '/rosout'}
    assert rights['subscribe'] == optimizer['subscribe'] | {'/position_estimate', '/no_fix'}
    assert rights['reply'] == optimizer['reply']
    assert {name.rpartition('/')[0] for name in rights['request']} == {'/optimizer'}


def test_the_tools_use_no_more_than_the_permissions_of_the_operator(tmp_path):
    allowed = rules(permissions.policy(users=2))
    scenario = Scenario()
    recorder = Recorder(tmp_path / 'a.mcap', scenario)
    with Session() as session, contextlib.closing(recorder):
        view = ViewNode(scenario, lambda entries: None)
        # Only tracks have odometry.
        view._follow_track(1)
        nodes = [session.node, view, CalibratorNode(PilotLog(scenario), scenario), WatchNode(),
                 SnapshotNode(scenario), RecorderNode(recorder),
                 RepublisherNode([], [*recorded_topics()], 1.0, 1.0),
                 republish._optimizer(scenario, Codebook.default())]
        # It creates the clients.
        republish._optimizer_present(nodes[-2])
        for node in nodes:
            rights = allowed['/replay' if node in nodes[-2:] else '/operator']
            found = used(session.node, f'/{node.get_name()}')
            assert all(found[right] <= rights[right] for right in RIGHTS), node.get_name()
            assert '/rosout' in found['publish']
        for node in nodes[1:]:
            node.destroy_node()


@pytest.mark.parametrize(('arguments', 'expected'), [
    (['--namespace', 'lab'], 'argument --namespace'),
    (['--users', '-1'], 'expected 0 to 1000'),
    (['--site', 'missing.yaml'], 'missing.yaml'),
    (['--robot', '2'], "'2', expected USER=TOPIC or USER=tf"),
    (['--robot', '3=odom'], 'user 3, expected one of 2 users')])
def test_invalid_arguments_are_rejected(arguments, expected, capsys):
    with pytest.raises(SystemExit):
        permissions.main(arguments)
    assert expected in capsys.readouterr().err


def test_policy_and_graph_agree(processes, make_watch, small_files):
    """A running network uses all allowed rights and no others."""
    space, watch = '/closed', make_watch('/closed')
    network = processes.start(
        'network', namespace=space, users=2, rest_s=0.1, prior='track',
        scenario_file=small_files / 'scenario.yaml', codebook_file=small_files / 'first.yaml')
    visualizer = processes.start(
        'visualizer', namespace=space, scenario_file=small_files / 'scenario.yaml')
    users = processes.start(
        'user', namespace=space, name='users', user_id=3, user_count=2,
        scenario_file=small_files / 'scenario.yaml')
    allowed = rules(permissions.policy(space, users=4))
    # Those of several nodes have tests of their own, and users 3 and 4 have one node.
    for name in ('operator', 'replay', 'network', 'user_3', 'user_4'):
        del allowed[f'{space}/{name}']
    if not importlib.util.find_spec('tf2_msgs'):
        allowed[f'{space}/visualizer']['publish'] -= {topics.TF, topics.TF_STATIC}
    # This node has two of the four users.
    allowed[f'{space}/users']['publish'] -= {
        f'{space}/{topics.TRUE_ODOMETRY.format(user=user)}' for user in (1, 2)}

    # After two cycles, all nodes have created all their publishers and subscriptions.
    for user in range(1, 5):
        watch.until_served(2, user, processes=[network, visualizer, users])
    watch.until(lambda: {f'{place}/{name}' for name, place in
                         watch.node.get_node_names_and_namespaces()} >= allowed.keys(),
                'every node in the graph', [network, visualizer])
    for path, rights in allowed.items():
        watch.until(lambda path=path, rights=rights: all(
            used(watch.node, path)[right] >= rights[right] for right in RIGHTS),
            f'{path} in the graph')
        assert used(watch.node, path) == rights, path
