"""A site of two surfaces, as processes: fusion, handover, faults of a surface, and wrong poses."""

import contextlib
import re
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from forked import Forked
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_processes import STEPS
from policy_rules import permissions, rules, used
from scipy.stats import chi2
from std_srvs.srv import Trigger

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.positioning import Site, fuse
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.fusion import sighting_of
from rhs_isac_ros.ros import convert, topics
from rhs_isac_ros.ros.diagnostics import subscribe_reports
from rhs_isac_ros.ros.endpoints import EXCHANGE
from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.ros.roster import FOLLOWING, ROSTER
from rhs_isac_ros.tools import demo

ROOT = Path(__file__).parents[2]
BOTH, FRONT = 'fusion of front, side', 'fusion of front'
# Users who walk slowly: with more of them, the positions of a window differ more.
N_USERS = 8
# Roles without which a surface carries no data, and those without which it has no posterior.
OF_DATA = {'rhs_controller', 'transmission', 'channel', 'receiver'}
OF_POSTERIOR = {'rhs_controller', 'positioner', 'channel', 'receiver'}
NODES_OF_FRONT = ['users' if role == 'user' else role for role in ROSTER]
# Other tests examine the choice of the band, which would take time in each cycle.
ONE_BAND = {'band': 0}
FILES = {'front': {'scenario': 'table1.yaml', 'codebook': 'codebook.yaml'},
         'side': {'scenario': 'resonant.yaml', 'codebook': 'codebook_resonant.yaml'}}
POSES = {'front': ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]),
         'side': ([10.0, -10.0, 0.0], [0.0, 0.0, 1.0, 1.0])}


@pytest.fixture(scope='module')
def make_site_file(tmp_path_factory):
    """Function that writes a site file: the paper's surface in front, a resonant one beside."""
    def make(*names):
        file = tmp_path_factory.mktemp('site') / 'site.yaml'
        file.write_text(yaml.safe_dump({
            'roi_center_m': [10.0, 0.0, 0.0], 'roi_size_m': [10.0, 10.0, 2.0],
            'surfaces': {name: {
                **{kind: str(ROOT / 'config' / file) for kind, file in FILES[name].items()},
                'pose': {'position_m': POSES[name][0], 'quaternion': POSES[name][1],
                         'uncertainty': [0.02, 0.2]}} for name in names}},
            sort_keys=False), encoding='utf-8')
        return file
    return make


@pytest.fixture(scope='module')
def site_file(make_site_file):
    return make_site_file('front', 'side')


# First, while no other site runs.
def test_the_demonstration_compares_all_surfaces_with_the_fusion_and_counts_their_data(
        make_site_file, monkeypatch, capfd):
    def fork(processes, name):
        command = processes._commands[name]
        # On a busy machine, no cycle may be given up either.
        if Path(command[0]).name in ('bs', 'user'):
            command += ['-p', f'step_timeout_s:={STEPS["step_timeout_s"]}']
        processes._running[name] = Forked(
            command, processes._logs / f'{name}.log', processes._environment)
    monkeypatch.setattr(Processes, '_spawn', fork)
    monkeypatch.setattr(demo, '_CYCLE_TIMEOUT_S', 240.0)
    # The environment of this process remains as it is.
    monkeypatch.setattr(demo, 'private_domain', dict)
    names = ('side', 'front')
    code = demo.main(
        ['--site', str(make_site_file(*names)), '--cycles', '4', '--prior', 'track'])
    out, err = capfd.readouterr()
    assert code == 0, err
    for text in (*(f'{name}: ' for name in names), 'fused: 4 positions, root mean square error'):
        assert text in out
    carried, handovers = out.splitlines()[-1].removeprefix('data: ').split('; ')
    assert sum(int(one.split(' over ')[0]) for one in carried.split(', ')) == 4
    assert re.fullmatch(r'\d handovers?', handovers)


def test_a_process_with_all_nodes_of_a_site_locates_its_users(
        make_site_file, processes, make_watch):
    watch, file = make_watch('/lab'), make_site_file('front')
    network = processes.start('network', namespace='/lab', site_file=file, users=1)
    watch.until(lambda: FRONT in [one.estimator for one in watch.received[m.PositionEstimate]],
                'a position of the site', [network])
    spaces = {space for _, space in watch.node.get_node_names_and_namespaces()}
    assert spaces == {'/lab', '/lab/front'}


def known(watch, kind, estimate):
    """Return the messages that an observer has received about the user and cycle of a position."""
    return [one for one in watch.of_cycle(kind, estimate.cycle_id) if one.user == estimate.user]


class Running:
    """The processes of a site with walking users, and observers of its three namespaces."""

    def __init__(self, processes, make_watch, site_file):
        self._processes, self.site_file = processes, site_file
        self.site = Site.from_yaml(site_file)
        self.fused, self.front, self.side = (
            make_watch(namespace) for namespace in ('/', '/front', '/side'))
        self._clients = {name: self.front.node.create_client(Trigger, f'bs/{name}')
                         for name in ('pause', 'resume')}
        self.running = {}
        # Tests kill the nodes of the second surface one by one. Those of the first one share a
        # process, as by default.
        for role in FOLLOWING:
            self.start('/side', role)
        # Fewer references than 300 suffice: a user is compared with the nearest 40.
        self.start('/', 'fusion', attributes={'_N_REFERENCES': 60})
        # With the site file of the process, it would run the other surface, too.
        file = site_file.with_name('front.yaml')
        file.write_text(yaml.safe_dump({f'/front/{node}': {'ros__parameters': {
            'site_file': str(site_file)}} for node in NODES_OF_FRONT}), encoding='utf-8')
        self.running['/front', 'network'] = self._processes.start(
            'network', '--params-file', file, namespace='/front',
            attributes={'MAX_USER_NODES': 0}, users=N_USERS, mobility='random_walk',
            speed_mps=1.0, rest_s=0.4, **ONE_BAND, **STEPS)

    def start(self, namespace, role, **parameters):
        if role == 'transmission':
            parameters |= ONE_BAND
        self.running[namespace, role] = self._processes.start(
            role, namespace=namespace, site_file=self.site_file, **parameters)

    def until(self, condition, what):
        """Spin all observers until a condition holds, while all nodes run; return its value."""
        def checked():
            self.front.spin()
            self.side.spin()
            return condition()
        return self.fused.until(checked, what, self.running.values())

    def until_fused(self, estimator, n=1):
        """Wait for positions of the given surfaces in `n` more cycles, and return them."""
        before = len(self.fused.received[m.PositionEstimate])

        def found():
            # The base station of a busy machine asks again, and gets the same answer.
            new = {(one.cycle_id, one.user): one
                   for one in self.fused.received[m.PositionEstimate][before:]
                   if one.estimator == estimator}
            return [*new.values()] if len(new) >= n else None
        return self.until(found, estimator)

    @contextlib.contextmanager
    def paused(self):
        """Context manager without cycles, which would take time from what a test computes."""
        self._request('pause')
        try:
            yield
        finally:
            self._request('resume')

    def wait_for(self, node):
        """Wait for a node of another process, which starts without cycles meanwhile."""
        with self.paused():
            self.until(lambda: node in self.fused.node.get_node_names(), node)

    def _request(self, name):
        client = self._clients[name]
        assert self.front.call(client, lambda client: client.call_async(Trigger.Request()),
                               self.running.values()).success

    def delivered(self):
        """Return the delivered uplink data that have arrived, by surface."""
        return {name: [one for one in watch.received[m.Data]
                       if (one.direction, one.stage) == (m.Direction.UPLINK, m.Stage.DELIVERED)]
                for name, watch in (('front', self.front), ('side', self.side))}

    def about(self, watch, kind, estimate):
        """Wait for the messages of a kind about the user and cycle of a position."""
        return self.until(lambda: known(watch, kind, estimate), kind.__name__)

    def verify(self, estimate):
        """Check that a position is the fusion of what the surfaces have published about it."""
        expected = fuse(
            [sighting_of(self.about(getattr(self, name), m.Posterior, estimate)[0])
             for name in estimate.estimator.removeprefix('fusion of ').split(', ')],
            self.site.bounds_m)
        mean, covariance = expected.mixture.moments()
        np.testing.assert_allclose(estimate.position, mean, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance_m2, covariance, atol=1e-9)


@pytest.fixture(scope='module')
def running(module_processes, make_watch, site_file):
    return Running(module_processes, make_watch, site_file)


def test_two_surfaces_locate_users_together(running):
    wanted = ((running.front, m.GroundTruth), (running.front, m.PositionEstimate),
              (running.front, m.Posterior), (running.side, m.Posterior))

    def located():
        """Return fused positions, if any of each user, with the messages that they result from."""
        found = [one for one in running.fused.received[m.PositionEstimate]
                 if one.estimator == BOTH and all(known(*where, one) for where in wanted)]
        return found if len({one.user for one in found}) == N_USERS else None
    estimates = running.until(located, 'a position of each user')
    errors_m, alone_m = [], []
    for estimate in estimates[-2 * N_USERS:]:
        running.verify(estimate)
        # The base station may have asked again.
        truth, alone = (known(*where, estimate)[0] for where in wanted[:2])
        errors_m.append(np.linalg.norm(estimate.position - truth.position))
        alone_m.append(np.linalg.norm(alone.position - truth.position))
    assert np.mean(np.square(errors_m)) < np.mean(np.square(alone_m))


def test_the_surfaces_receive_the_same_pilots_with_noise_of_their_own(running):
    (estimate,) = running.until_fused(BOTH)[:1]
    front, side = (running.about(watch, m.ReceivedSignals, estimate)[0]
                   for watch in (running.front, running.side))
    assert front.user_instance == side.user_instance
    assert not np.isclose(front.signals, side.signals).any()
    assert not running.side.received[m.Grant]


def test_the_policy_and_the_graph_of_a_site_agree(running):
    running.until_fused(BOTH)
    allowed = rules(permissions.policy(users=N_USERS, site=running.site))
    nodes = {'/fusion', *(f'/front/{node}' for node in NODES_OF_FRONT),
             *(f'/side/{role}' for role in FOLLOWING)}
    # Without tracks, a positioner publishes no odometry.
    unused = {f'{space}/{topics.ODOMETRY.format(user=user)}'
              for space in ('/front', '/side') for user in range(1, N_USERS + 1)}
    node = running.fused.node
    for path in sorted(nodes):
        expected = {right: names - unused for right, names in allowed[path].items()}
        running.fused.until(lambda path=path, expected=expected: all(
            names <= used(node, path)[right] for right, names in expected.items()),
            f'{path} in the graph')
        assert used(node, path) == expected, path


def test_any_program_can_read_posteriors_poses_and_odometry(running):
    posteriors, poses, tracks = [], [], []
    for kind, topic, store in ((ros.Posterior, 'posterior', posteriors),
                               (PoseWithCovarianceStamped, topics.POSE.format(user=1), poses),
                               (Odometry, topics.ODOMETRY.format(user=1), tracks)):
        running.fused.node.create_subscription(kind, topic, store.append, EXCHANGE)
    running.fused.until(lambda: posteriors and poses and tracks, 'a message on each topic')
    assert {one[0].header.frame_id for one in (posteriors, poses, tracks)} == {'map'}
    assert tracks[0].child_frame_id == 'user_1'
    posterior = posteriors[0]
    weights = np.exp(posterior.log_weights.data)
    assert weights.sum() == pytest.approx(1)
    assert posterior.means.shape.tolist() == [len(weights), 3]
    # A repeated request is answered again.
    estimate, *_ = running.fused.until(lambda: [
        one for one in running.fused.received[m.PositionEstimate]
        if one.cycle_id == posterior.cycle_id], 'the estimate of the same cycle')
    mean = weights @ np.reshape(posterior.means.data, (-1, 3))
    np.testing.assert_allclose(mean, estimate.position, rtol=0, atol=1e-6)


def test_data_of_walking_users_move_to_another_surface(running):
    def moved():
        """Return whether both surfaces have carried data of a user, and the latest ones of all."""
        data = running.delivered().values()
        front, side = ({one.user for one in carried} for carried in data)
        carried = {one.cycle_id for of_surface in data for one in of_surface}
        # The base station may have found the topic of a surface earlier than the observer.
        return front & side and {end.cycle_id for end in running.front.ends[-6:-1]} <= carried
    running.until(moved, 'a handover')
    for name, data in running.delivered().items():
        assert {one.scenario_id for one in data} == {running.site.surfaces[name].scenario.id}
    assert not running.front.given_up


@pytest.fixture(scope='module')
def recorded(running, built_scripts, tmp_path_factory):
    """A recording of some cycles, and the positions from both surfaces meanwhile."""
    pytest.importorskip('mcap', reason='mcap is not installed')
    from rhs_isac_ros.ros.recording import read
    path = tmp_path_factory.mktemp('recording') / 'site.mcap'
    with subprocess.Popen(
            [ROOT / 'scripts' / 'record', path, '--site', running.site_file],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        running.wait_for('recorder')
        # The recorder discovers the topics one by one.
        missing = {'front/ground_truth', 'position_estimate', *(
            f'{name}/{topic}' for name in ('front', 'side')
            for topic in ('received_signals', 'position_estimate', 'posterior'))}
        while missing:
            line = process.stderr.readline()
            assert line, f'no messages of {missing}'
            missing.discard(line.rpartition('first message of ')[2].strip())
        # Those that have waited in queues until now are not in the recording.
        begin_ns, positions = time.time_ns(), running.fused.received[m.PositionEstimate]
        running.until(lambda: len(positions) and positions[-1].stamp_ns > begin_ns, 'a new cycle')
        estimates = running.until_fused(BOTH, 2 * N_USERS)
        # Messages may wait in the queues of the recorder.
        partial = path.with_name(f'{path.name}.part')
        running.until(lambda: any(
            convert.from_bytes(m.PositionEstimate, data).cycle_id == estimates[-1].cycle_id
            for _, data, _ in read(partial, ['/position_estimate'])), 'the last position on disk')
        process.send_signal(signal.SIGINT)
        output = process.communicate(timeout=240)[0]
    assert process.returncode == 0, output
    return path, estimates


def test_a_recording_holds_each_surface_and_the_fusion(running, recorded):
    from rhs_isac_ros.ros.recording import read, read_networks
    path, estimates = recorded
    networks = read_networks(path)
    assert {name: one.id for name, one in networks.surfaces.items()} == {
        name: one.scenario.id for name, one in running.site.surfaces.items()}
    assert np.array_equal(networks.bounds_m, running.site.bounds_m)
    assert networks.of('/side').id == running.site.surfaces['side'].scenario.id
    assert networks.of('/').id == networks.of('/front/').id == networks.scenario.id
    names = {topic for topic, *_ in read(path)}
    assert {'/posterior', '/front/posterior', '/side/posterior', '/front/beacon',
            '/side/codebook', topics.DIAGNOSTICS} <= names


def test_a_replay_locates_the_users_of_each_surface_and_of_the_fusion_again(
        running, recorded, capsys):
    from rhs_isac_ros.ros.recording import read_networks
    from rhs_isac_ros.tools.replay import Recording, locate_in_site, main
    path, estimates = recorded
    networks = read_networks(path)
    recording = Recording(
        path, '/', {**networks.surfaces, '': next(iter(networks.surfaces.values()))})
    with running.paused():
        again = locate_in_site(recording, networks.bounds_m)
        assert main([str(path)]) == 0
    assert again.keys() == recording.logs.keys() == {'front', 'side', ''}
    # With all signals, the positions are the same.
    first = min(again['front'].keys() & again['side'].keys())
    keys = {(one.cycle_id, one.user) for one in estimates
            if (one.cycle_id, one.user) >= first} & recording.truths.keys()
    assert len(keys) > N_USERS
    for name, found in again.items():
        live = recording.live(name)
        for key in keys & live.keys():
            np.testing.assert_allclose(found[key], live[key], atol=1e-6)
    number, _, *rows = capsys.readouterr().out.splitlines()
    assert number == f'{len(recording.truths)} cycles'
    assert [row.split('  ')[0] for row in rows] == [
        f'{label}{name}' for name in ('front', 'side', 'fusion') for label in ('live ', '')]


@pytest.mark.parametrize(('arguments', 'code', 'expected'), [
    (['--publish'], 1, '--publish: not available for a whole site; select a surface with '
     '--namespace: /front, /side\n'),
    (['--estimator', 'ml'], 1, 'select a surface with --namespace: /front\n'),
    (['--namespace', '/side'], 2, 'namespace /side has no base station, expected that of front'),
    (['--namespace', '/lab'], 2, 'with a true position in the namespace /lab; --namespace selects '
     'one of /front, /side, and --site of a replay those of a site\n')])
def test_a_replay_of_a_site_names_what_is_not_available(
        recorded, capsys, arguments, code, expected):
    from rhs_isac_ros.tools.replay import main
    assert main([str(recorded[0]), *arguments]) == code
    assert expected in capsys.readouterr().err


def test_the_leading_surface_is_replayed_like_a_single_network(running, recorded, capsys):
    from rhs_isac_ros.tools.replay import main
    with running.paused():
        assert main([str(recorded[0]), '--namespace', '/front']) == 0
    _, _, live, bayes = capsys.readouterr().out.splitlines()
    assert live.split()[2:] == bayes.split()[1:]


# The roles whose absence has the same effect are killed together.
@pytest.mark.parametrize('roles', [
    ('rhs_controller', 'channel', 'receiver'), ('positioner',), ('transmission', 'optimizer')],
    ids='+'.join)
def test_the_others_continue_without_nodes_of_one_surface(running, roles):
    running.until_fused(BOTH, 2)
    for role in roles:
        process = running.running.pop(('/side', role))
        process.signal(signal.SIGKILL)
        process.wait()
    # Observers may have missed the last messages of the processes, and the latest grant.
    latest = max(running.until(lambda: [
        grant.cycle_id for grant in running.front.received[m.Grant]], 'a grant')) + 1

    def continued():
        return [end for end in running.front.ends if end.cycle_id > latest] and [
            one for one in running.fused.received[m.PositionEstimate] if one.cycle_id > latest]
    estimates = running.until(continued, 'a position')
    # Without its optimizer, a surface keeps its codebook.
    rest = running.until_fused(FRONT if OF_POSTERIOR.intersection(roles) else BOTH, 5)
    if OF_DATA.intersection(roles):
        def front_alone():
            carried = sorted(
                (one.cycle_id, name) for name, data in running.delivered().items()
                for one in data if one.cycle_id > latest)
            return [name for _, name in carried[-5:]] == 5 * ['front']
        running.until(front_alone, 'data over the first surface')
    for estimate in [*estimates, *rest]:
        running.verify(estimate)
    for role in roles:
        running.start('/side', role)
    n_posteriors = len(running.side.received[m.Posterior])
    running.until(lambda: len(running.side.received[m.Posterior]) > n_posteriors,
                  'the second surface')
    running.verify(running.until_fused(BOTH, 2)[-1])
    assert not running.front.given_up


def test_a_surface_that_has_moved_is_named_and_its_pose_is_found(
        running, built_scripts, tmp_path):
    reports = []
    subscribe_reports(running.fused.node, lambda name, report: reports.append(report.details))
    # The fusion draws them between cycles.
    assert running.front.set_parameters('bs', {'rest_s': 0.5}).successful
    running.until(lambda: reports and 'agreement.front.side' in reports[-1], 'the references')
    assert running.front.set_parameters('bs', {'rest_s': 0.1}).successful
    assert 'warning.poses' not in reports[-1]
    assert running.side.set_parameters('channel', {'surface_shift_m': 0.3}).successful
    running.until_fused(BOTH, 2)
    with subprocess.Popen(
            [ROOT / 'scripts' / 'calibrate', '--site', running.site_file, '--cycles', '24',
             '--output', tmp_path / 'found.yaml'], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True) as process:
        running.wait_for('calibrator')
        # The node ends when it has received enough.
        running.until(lambda: 'calibrator' not in running.fused.node.get_node_names(),
                      'the calibration')
        running.until(lambda: 'warning.poses' in reports[-1], 'the warning')
        with running.paused():
            output, errors = process.communicate(timeout=240)
    assert (process.returncode, errors) == (0, '')
    assert reports[-1]['warning.poses'] == 'surfaces front, side disagree: a pose is wrong'
    assert 'surfaces front, side disagree' in running.running['/', 'fusion'].log
    assert running.side.set_parameters('channel', {'surface_shift_m': 0.0}).successful
    declared, found = (site.surfaces['side'].pose for site in (
        running.site, Site.from_yaml(tmp_path / 'found.yaml')))
    # The left of the surface is the negative x of the site.
    error = found.error_of(declared.displaced([-0.3, 0, 0, 0, 0, 0]))
    # Chance exceeds this limit once in ten thousand runs.
    assert error @ np.linalg.solve(found.covariance, error) < chi2.isf(1e-4, 6)
    assert declared.error_of(found)[0] < -0.05
    assert 'side: moved by [-0.' in output
