"""Cycles of a network of processes: their messages, their users and recovery from faults."""

import collections
import math
import signal
import types

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from ros_messages import to_ros

from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.measurement import receive_feeds
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.messages import check
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import EXCHANGE
from rhs_isac_ros.ros.role_node import CodebookClient

SCENARIO = Scenario()
SIZES = SCENARIO.sizes
# Number of messages of each class in one cycle.
COMPLETE = {m.Grant: 1, m.ReceivedSignals: 1, m.PositionEstimate: 1, m.Beam: 1, m.Capacity: 1,
         m.CapacityStatistics: 1, m.GroundTruth: 1, m.RhsCommand: SIZES['N_B'],
         m.RhsConfiguration: SIZES['N_B'] + 1,
         m.PilotRequest: 1, m.Pilot: SIZES['N_B'],
         m.FeedSignals: SIZES['N_B'], m.Data: 4, m.ProtocolState: 4}
# Parameters of the nodes, in another order than in test_start_and_stop.
BASE = {'channel': {}, 'transmission': {}, 'bs': {'rest_s': 0.02, 'ack_timeout_s': 0.3},
        'positioner': {}, 'optimizer': {}, 'rhs_controller': {}}
POSITIONS = {1: (9.0, 1.5, 0.3), 2: (12.0, -3.0, -0.5), 3: (6.5, 0.0, 0.0)}


@pytest.fixture(scope='module')
def network(module_processes, make_watch):
    """A network without users, in the scenario of the paper."""
    running = {name: module_processes.start(name, **values) for name, values in BASE.items()}
    watch = make_watch()
    watch.until(lambda: watch.received[m.Beacon], 'the first beacon', running.values())
    return types.SimpleNamespace(watch=watch, running=running)


def start_user(processes, user):
    return processes.start('user', name=f'user_{user}', user_id=user,
                           position_m=list(POSITIONS[user]))


@pytest.fixture
def join(network, processes):
    """Yield a function that starts a user, which ends with the test."""
    yield lambda user: start_user(processes, user)
    for process in network.running.values():
        assert process.running, process.log


def beacons_in_a_row(watch, since):
    """Return whether the last four of the beacons since an index belong to one cycle."""
    cycle_ids = [beacon.cycle_id for beacon in watch.received[m.Beacon][since:][-4:]]
    return len(cycle_ids) == 4 and len(set(cycle_ids)) == 1


def test_without_users_the_base_station_repeats_its_beacon(network):
    watch = network.watch
    before = len(watch.received[m.Beacon])
    watch.until(lambda: beacons_in_a_row(watch, before), 'repeated beacons')
    attempts = [beacon.attempt for beacon in watch.received[m.Beacon][-4:]]
    assert attempts == list(range(attempts[0], attempts[0] + 4))
    assert not watch.of_cycle(m.Grant, watch.received[m.Beacon][-1].cycle_id)


@pytest.fixture(scope='module')
def cycles(network, make_processes):
    """The messages of some served cycles of one user, by class, and the poses."""
    watch = network.watch
    with make_processes() as processes:
        start_user(processes, 1)
        # The first cycles are incomplete: not all nodes have discovered the topics of the user.
        numbers = watch.until(lambda: complete_cycles(watch), 'complete cycles')
        messages = [{kind: watch.of_cycle(kind, n) for kind in watch.received} for n in numbers]
        places = [message.position for cycle in messages for message in cycle[m.PositionEstimate]]
        poses = watch.until(lambda: poses_at(watch.poses, places), 'the poses')
    return types.SimpleNamespace(messages=messages, poses=poses)


def complete_cycles(watch, n=5):
    """Return the numbers of the last n complete cycles, or None if there are fewer."""
    numbers = [end.cycle_id for end in watch.served[-20:] if is_complete(watch, end.cycle_id)]
    return numbers[-n:] if len(numbers) >= n else None


def is_complete(watch, cycle_id):
    """Return whether the observer and the transmission have received all messages of a cycle."""
    return (all(len(watch.of_cycle(kind, cycle_id)) == n for kind, n in COMPLETE.items())
            and math.isfinite(watch.of_cycle(m.Capacity, cycle_id)[0].actual_bps))


def poses_at(poses, places):
    """Return one pose for each position, or None if one is missing."""
    found = [pose for place in places for pose in poses
             if tuple(place) == position_of(pose)]
    return found if len(found) == len(places) else None


def position_of(pose):
    point = pose.pose.pose.position
    return point.x, point.y, point.z


def test_all_messages_of_a_cycle_carry_its_user_and_codebook(cycles):
    codebook = Codebook.load(default_codebook_file())
    for messages in cycles.messages:
        assert {kind: len(messages[kind]) for kind in COMPLETE} == COMPLETE
        everything = [message for kind in COMPLETE for message in messages[kind]]
        assert {message.user for message in everything if hasattr(message, 'user')} == {1}
        assert {message.codebook_id for message in everything
                if hasattr(message, 'codebook_id')} == {codebook.id}
        for message in everything:
            check(message, SIZES)


def test_received_signals_are_the_combined_feed_signals_and_noise(cycles):
    codebook = Codebook.load(default_codebook_file())
    residuals = []
    for messages in cycles.messages:
        feeds = np.empty((2, 4, 8, 3), complex)
        for message in messages[m.FeedSignals]:
            feeds[message.band] = message.signals
        received, = messages[m.ReceivedSignals]
        residuals.append(received.signals - receive_feeds(SCENARIO, codebook, feeds, None))
    power = np.mean(np.abs(residuals)**2)
    # Of 320 samples, the mean power deviates by more than 20 % with probability 0.0003.
    assert power == pytest.approx(SCENARIO.noise_power_w, rel=0.2)


def test_estimates_are_close_to_the_user(cycles):
    low, high = SCENARIO.roi_bounds_m
    errors = []
    for messages in cycles.messages:
        estimate, = messages[m.PositionEstimate]
        truth, = messages[m.GroundTruth]
        assert tuple(truth.position) == POSITIONS[1]
        assert not truth.velocity.any()
        assert ((low <= estimate.position) & (estimate.position <= high)).all()
        assert np.linalg.eigvalsh(estimate.covariance_m2)[0] > 0
        assert estimate.estimator == 'bayes'
        assert 0 < estimate.crlb_m2 < 1
        assert 0 < estimate.latency_s < 30
        errors.append(np.linalg.norm(estimate.position - truth.position))
    # A random point of the region is about 5 m away.
    assert np.median(errors) < 2.5


def test_poses_are_the_estimates(cycles):
    assert len(cycles.poses) == len(cycles.messages)
    for pose, messages in zip(cycles.poses, cycles.messages, strict=True):
        estimate, = messages[m.PositionEstimate]
        assert position_of(pose) == tuple(estimate.position)
        covariance = np.reshape(pose.pose.covariance, (6, 6))
        np.testing.assert_array_equal(covariance[:3, :3], estimate.covariance_m2)
        assert pose.header.frame_id == 'map'
        assert pose.header.stamp.sec > 0


def test_the_capacities_are_consistent_with_the_beam_and_the_data(cycles):
    for messages in cycles.messages:
        report, beam = messages[m.Capacity][0], messages[m.Beam][0]
        assert report.expected_bps == beam.expected_bps
        assert 0 < report.actual_bps
        assert report.loss_bps == report.perfect_bps - report.actual_bps
        assert report.loss_percent == pytest.approx(100 * report.loss_bps / report.perfect_bps)
        # The search for the best beam may end slightly below the optimum.
        assert report.loss_percent > -0.05
        for direction in m.Direction:
            offered, delivered = (
                next(data for data in messages[m.Data]
                     if (data.direction, data.stage) == (direction, stage)) for stage in m.Stage)
            assert 0 < delivered.bits <= min(
                offered.bits, report.actual_bps * delivered.duration_s)
            assert offered.bits <= report.expected_bps * offered.duration_s


def test_a_late_user_is_served_and_both_users_take_turns(network, join):
    watch = network.watch
    join(1)
    watch.until_served(2, user=1)
    late = join(2)
    watch.until_served(2, user=2, processes=[late])
    turns = collections.Counter(end.user for end in watch.until_served(8))
    assert set(turns) == {1, 2}
    assert min(turns.values()) >= 2
    # Each is located at its own position.
    for user in (1, 2):
        places = [estimate.position for estimate in watch.received[m.PositionEstimate]
                  if estimate.user == user][-4:]
        distances = [math.dist(place, POSITIONS[user]) for place in places]
        assert np.median(distances) < 3.5


def test_a_user_that_crashes_in_its_cycle_is_served_after_its_restart(network, join):
    watch, interrupted = network.watch, None

    def crash(grant):
        nonlocal interrupted
        # A user of an earlier test may still be granted a cycle.
        if grant.user == 3:
            victim.signal(signal.SIGKILL)
            interrupted = grant.cycle_id
    # On a loaded machine, the cycle may end before the signal arrives.
    for _ in range(5):
        victim = join(3)
        watch.until_served(user=3, processes=[victim])
        watch.hooks[m.Grant] = crash
        watch.until(lambda victim=victim: not victim.running, 'the end of the user')
        assert victim.wait() == -signal.SIGKILL
        del watch.hooks[m.Grant]
        before = len(watch.received[m.Beacon])
        watch.until(lambda before=before: beacons_in_a_row(watch, before), 'repeated beacons',
                    network.running.values())
        if interrupted not in {end.cycle_id for end in watch.served}:
            break
    assert (interrupted, 3) in {(end.cycle_id, end.user) for end in watch.given_up}
    watch.until_served(2, user=3, processes=[join(3)])


def set_prior(watch, prior):
    client = AsyncParameterClient(watch.node, 'positioner')
    response = watch.call(client, lambda client: client.set_parameters(
        [Parameter('prior', value=prior)]))
    assert response.results[0].successful


def test_users_that_leave_and_return_elsewhere_are_tracked(network, join, processes):
    watch, tracks = network.watch, {1: [], 3: []}
    subscriptions = [watch.node.create_subscription(
        Odometry, topics.ODOMETRY.format(user=user), of_user.append, EXCHANGE)
        for user, of_user in tracks.items()]

    def follows(user, place, since=0):
        """Return whether the latest tracks are at a place, with a velocity that is known."""
        latest = tracks[user][since:][-3:]
        points = [track.pose.pose.position for track in latest]
        return len(latest) == 3 and all(
            math.dist((point.x, point.y, point.z), place) < 2.0 for point in points) and all(
            sum(track.twist.covariance[:21:7]) < 0.9 for track in latest)
    set_prior(watch, 'track')
    stays = join(1)
    watch.until(lambda: follows(1, POSITIONS[1]), 'the track of user 1', [stays])
    for place in (POSITIONS[3], POSITIONS[2]):
        guest = processes.start('user', name='user_3', user_id=3, position_m=list(place))
        before = len(tracks[3])
        watch.until(lambda since=before, place=place: follows(3, place, since),
                    'the track of user 3', [guest])
        guest.signal(signal.SIGINT)
        assert guest.wait() == 0, guest.log
    # The other user keeps its track.
    before = len(tracks[1])
    watch.until(lambda: len(tracks[1]) > before, 'the track of user 1', [stays])
    assert follows(1, POSITIONS[1])
    set_prior(watch, 'region')
    for subscription in subscriptions:
        watch.node.destroy_subscription(subscription)


@pytest.mark.parametrize('names', [
    ('bs',), ('channel', 'positioner', 'rhs_controller', 'transmission', 'optimizer')],
    ids=lambda names: '+'.join(names))
def test_cycles_continue_after_nodes_crash_and_restart(network, module_processes, join, names):
    watch, running = network.watch, network.running
    join(1)
    watch.until_served(user=1)
    for name in names:
        running[name].signal(signal.SIGKILL)
    for name in names:
        assert running[name].wait() == -signal.SIGKILL
        running[name] = module_processes.start(name, **BASE[name])
    before = len(watch.received[m.Beacon])
    watch.until(lambda: len(watch.received[m.Beacon]) > before, 'beacons', running.values())
    watch.until_served(3, user=1, processes=running.values())
    # The base station repeats no number after a restart.
    numbers = [beacon.cycle_id for beacon in watch.received[m.Beacon]]
    assert numbers == sorted(numbers)
    grants = [grant.cycle_id for grant in watch.received[m.Grant]]
    assert len(set(grants)) == len(grants)


def not_finite(message):
    return not np.isfinite(message.signals).all()


def test_nan_from_a_faulty_node_is_dropped(network, join):
    """A faulty node sends NaN for the current cycle."""
    watch, running = network.watch, network.running
    codebook = Codebook.load(default_codebook_file())
    feeds, received = watch.publisher(m.FeedSignals), watch.publisher(m.ReceivedSignals)
    sent = collections.Counter()

    def send_nan(request):
        signals = np.full((4, 8, 3), complex(math.nan, 0))
        feeds.publish(to_ros(m.FeedSignals(
            cycle_id=request.cycle_id, user=request.user, band=request.band, signals=signals),
            None))
        stamp = watch.node.get_clock().now().to_msg()
        signals = np.full((2, 8, 4), complex(0, math.inf))
        received.publish(to_ros(m.ReceivedSignals(
            cycle_id=request.cycle_id, user=request.user, codebook_id=codebook.id,
            signals=signals), stamp))
        sent.update({m.FeedSignals: 1, m.ReceivedSignals: 1})

    since = {kind: len(messages) for kind, messages in watch.received.items()}
    watch.hooks[m.PilotRequest] = send_nan
    join(2)
    watch.until_served(3, user=2, processes=running.values())
    # One request covers both bands.
    watch.until(lambda: min(sent[kind] for kind in (m.FeedSignals, m.ReceivedSignals)) >= 3,
                'three requests')
    del watch.hooks[m.PilotRequest]
    watch.until(lambda: all(sum(map(not_finite, watch.received[kind][since[kind]:])) == n
                            for kind, n in sent.items()), 'the messages with NaN')
    assert 'dropped: FeedSignals.signals: not finite' in running['bs'].log
    assert 'dropped: ReceivedSignals.signals: not finite' in running['positioner'].log
    for kind in watch.received:
        if kind not in sent:
            for message in watch.received[kind][since[kind]:]:
                check(message, SIZES)
    # Each error is logged once.
    assert running['bs'].log.count('dropped: ') == 1
    assert running['positioner'].log.count('dropped: ') == 1


def test_a_restarted_optimizer_with_another_codebook_is_followed(
        processes, make_watch, small_files):
    watch = make_watch('/restart')
    codebooks = {name: Codebook.load(small_files / f'{name}.yaml')
                 for name in ('first', 'second')}
    got = []
    CodebookClient(watch.node, Scenario.from_yaml(small_files / 'scenario.yaml'), got.append)
    for name, codebook in codebooks.items():
        process = processes.start(
            'optimizer', namespace='/restart', scenario_file=small_files / 'scenario.yaml',
            codebook_file=small_files / f'{name}.yaml')
        watch.until(lambda codebook=codebook: got and got[-1].id == codebook.id,
                    f'the {name} codebook', [process])
        process.signal(signal.SIGINT)
        assert process.wait() == 0
    assert [codebook.id for codebook in got] == [
        codebook.id for codebook in codebooks.values()]
