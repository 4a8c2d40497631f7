"""Tracks of users, and codebooks that follow them."""

import numpy as np
import pytest
from in_memory_network import LATENCY_S, Fault, Network, feed

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.codebook.library import EMPTY, Library, Plan
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.mobility import Waypoints
from rhs_isac_ros.positioning import BayesEstimator
from rhs_isac_ros.positioning.tracking import MAX_GAP_S
from rhs_isac_ros.protocol import events
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.positioner import Positioner, Tracks
from rhs_isac_ros.protocol.settings import PositionerSettings
from rhs_isac_ros.system import System

PLACE = np.array([8.0, -2.0, 0.5])
TRACK = PositionerSettings(prior='track')


@pytest.fixture(scope='module')
def scenario():
    return Scenario(center_frequencies_hz=(2.5e9, 2.56e9, 2.58e9, 2.6e9), n_subbands=4,
                    n_frames=2, elements_per_side=6, roi_center_m=(8.0, 0.0, 0.0),
                    roi_size_m=(4.0, 6.0, 2.0))


@pytest.fixture(scope='module')
def region(scenario):
    return random_codebook(scenario, np.random.default_rng(1))


@pytest.fixture(scope='module')
def library(scenario, region):
    """Random codebooks for 12 cells of 2 m x 2 m x 1 m."""
    plan = Plan(scenario.unplaced.id, region.id, 'error', (0.5,), (2.0,))
    cells, rng = plan.cells(scenario), np.random.default_rng(2)
    return Library.of(plan, cells, [random_codebook(scenario, rng) for _ in cells])


@pytest.fixture(scope='module')
def estimator(scenario, region):
    return BayesEstimator(System(scenario, region))


@pytest.fixture
def net(scenario, region, library, estimator):
    """Function that returns a network with the prior ``track``; `follows` gives it the library."""
    def make(place=PLACE, follows=True, **options):
        users = place if isinstance(place, dict) else {1: place}
        return Network(scenario, region, users, library=library if follows else EMPTY,
                       positioner=TRACK, make=lambda codebook: estimator, **options)
    return make


@pytest.fixture
def signals(scenario, region):
    """Function that returns the signals of a cycle of a user at a fixed place."""
    model, rng = MeasurementModel(scenario, region), np.random.default_rng(2)

    def make(cycle_id, user=1, **fields):
        drawn = model.sample(PLACE[None], rng)[0].reshape(region.digital.shape[:3])
        return m.ReceivedSignals(
            cycle_id=cycle_id, user=user, codebook_id=region.id, signals=drawn, **fields)
    return make


@pytest.fixture
def locate(estimator, signals):
    """Function that locates a user in new signals; the cycles of a second have the ids 10 n."""
    tracks = Tracks()

    def locate(cycle_id, now_s=None, **fields):
        return tracks.locate(signals(cycle_id, **fields), estimator, 1.0,
                             cycle_id / 10 if now_s is None else now_s)
    locate.tracks = tracks
    return locate


def test_a_replaced_user_starts_a_new_track(locate):
    assert [locate(n, user_instance=7).n_phases for n in range(3)] == [1, 2, 3]
    assert [locate(n, user_instance=8).n_phases for n in range(3, 5)] == [1, 2]
    # An unknown instance, as in messages sent by hand, does not end the track.
    assert locate(5).n_phases == 3


def test_late_signals_are_located_without_the_track(locate, estimator):
    for n in (0, 1, 2, 4):
        locate(n, user_instance=7)
    for late in ({'user_instance': 7}, {'user_instance': 6}):
        estimate = locate(3, now_s=0.45, **late)
        assert estimate.fix
        assert not estimate.n_phases
    assert locate(5, user_instance=7).n_phases == 5


def test_a_track_survives_a_restart_of_the_base_station(locate):
    """The new base station may number its cycles from the beginning."""
    assert [locate(n, sender=1).n_phases for n in range(100, 103)] == [1, 2, 3]
    assert locate(1, now_s=11.0, sender=2).n_phases == 4
    # Delayed signals of the old one are not distinguished from those of a third one.
    assert locate(2, now_s=11.1, sender=2).n_phases == 5


def test_a_gap_ends_a_track(locate):
    assert locate(0).n_phases == 1
    assert locate(40).n_phases == 2
    assert locate(1, now_s=4.1 + MAX_GAP_S).n_phases == 1


def test_a_clock_that_goes_back_ends_a_track(locate):
    assert [locate(n, now_s=1000.0 + n).n_phases for n in range(2)] == [1, 2]
    assert [locate(n, now_s=float(n)).n_phases for n in range(2, 4)] == [1, 2]


@pytest.mark.parametrize('ahead_s', [-3600.0, 3600.0])
def test_users_on_hosts_with_other_clocks_do_not_end_tracks(locate, ahead_s):
    counts = {1: [], 2: []}
    for n, user in enumerate([1, 2, 2, 1, 2, 1]):
        counts[user].append(locate(
            n, user=user, now_s=n / 10 + ahead_s * (user == 2)).n_phases)
    assert counts == {1: [1, 2, 3], 2: [1, 2, 3]}


def test_each_user_has_a_track_and_their_number_is_bounded(monkeypatch, locate):
    monkeypatch.setattr(locate.tracks._tracks, 'max_size', 2)
    counts = [locate(n, user=user, now_s=n / 10).n_phases
              for n, user in enumerate([1, 2, 1, 3, 1, 2])]
    assert counts == [1, 1, 2, 1, 3, 1]
    assert len(locate.tracks._tracks) == 2


def test_users_that_share_the_cycles_have_tracks_that_the_beam_uses(net):
    network = net({1: PLACE, 2: Waypoints([[7, 1, 0], [7, -1, 0], [9, -1, 0]], 1.0)},
                  follows=False, rest_s=0.02, ack_timeout_s=0.01)
    network.run_cycles(50)
    assert {track.user for track in network.tracks} == {1, 2}
    for user in (1, 2):
        estimates = network.sent(m.PositionEstimate, user=user)
        tracks = [track for track in network.tracks if track.user == user]
        np.testing.assert_array_equal(estimates[-1].position, tracks[-1].estimate.mean)
        np.testing.assert_array_equal(
            estimates[-1].covariance_m2, tracks[-1].estimate.covariance)
        first, last = (np.trace(track.estimate.covariance) for track in (tracks[0], tracks[-1]))
        assert last < first / 2
    assert network['positioner'].status()['parameter.prior'] == 'track'


def test_the_prior_region_ends_all_tracks(net):
    network = net(follows=False)
    network.run_cycles(10)
    network.change('positioner', prior='region')
    network.run_cycles(2)
    seen = len(network.tracks)
    network.run_cycles(5)
    assert len(network.tracks) == seen
    network.change('positioner', prior='track')
    network.run_cycles(5)
    assert network.tracks[seen].estimate.n_phases == 1


# Codebooks


def used(network):
    """Return the id of the codebook in each cycle."""
    return [signals.codebook_id for signals in network.sent(m.ReceivedSignals)]


def test_codebooks_follow_a_walk(net, library, region):
    network = net(Waypoints([[8, -2.5, 0.5], [8, 2.5, 0.5]], 1.0))
    network.run_cycles(40)
    assert network.served() == [1] * 40
    ids = used(network)
    # The interval between cycles, and therefore the prediction, is known after two cycles.
    assert ids[:2] == [region.id] * 2
    assert set(ids[2:]) <= set(library.by_id)
    assert len(set(ids[2:])) >= 3
    network.verify()
    # Each estimator is prepared once.
    assert len(network.prepared) == len(set(ids[2:]))
    # The watch on residuals goes on.
    assert network['positioner'].status()['residual.fixes'] == '40'
    assert not any('wrong' in reason for c in network.counters().values() for reason in c)


def test_codebooks_follow_in_a_slow_simulation(net, library):
    network = net(world_rate=0.1)
    network.run_cycles(6)
    assert network.served() == [1] * 6
    assert set(used(network)[2:]) <= set(library.by_id)


class Jump:
    """A user that is 3 m away after a time [s]."""

    def __init__(self, time_s):
        self.time_s = time_s

    def state(self, time_s):
        return PLACE + [0.0, 3.0 * (time_s > self.time_s), 0.0], np.zeros(3)


def test_a_user_that_jumps_is_found_within_three_cycles(net, library, region):
    network = net(Jump(1.0))
    network.run(lambda: network.now_s > 1.0)
    network.run_cycles(4)
    ids, estimates = used(network), network.sent(m.PositionEstimate)
    errors = [estimate.position - network.sent(
        m.GroundTruth, cycle_id=estimate.cycle_id)[0].position for estimate in estimates]
    jumped = next(n for n, estimate in enumerate(estimates)
                  if network.sent(m.GroundTruth, cycle_id=estimate.cycle_id)[0].position[1] > 0)
    assert ids[jumped] in library.by_id
    # The signals speak against the track, although most of its weight is still at the old place.
    assert region.id in ids[jumped + 1:jumped + 3]
    for error, estimate in zip(errors[jumped + 2:], estimates[jumped + 2:], strict=True):
        # A chi-square variable with three degrees of freedom exceeds 21.1 with probability 1e-4.
        assert error @ np.linalg.solve(estimate.covariance_m2, error) < 21.1
        assert np.linalg.norm(error) < 1.5


@pytest.mark.parametrize(('fault', 'outcome'), [
    (Fault(m.PositionEstimate, 'bs', LATENCY_S, cycle_id=6,
           alter=lambda estimate: m.derive(m.NoFix, estimate, reason='none')), 'no_fix'),
    (Fault(m.Beam, 'rhs_controller', cycle_id=6), 'transmission_silent')])
def test_a_cycle_without_service_is_followed_by_one_for_the_whole_region(
        net, library, region, fault, outcome):
    network = net(transport=fault, step_timeout_s=0.1)
    network.run_cycles(8)
    assert network.ends()[5:] == [outcome, 'served', 'served']
    assert used(network)[5] in library.by_id
    assert used(network)[6] == region.id
    assert used(network)[7] in library.by_id


def pause(network):
    network.dispatch('bs', events.PauseRequested())
    network.run(limit_s=3.0)
    network.dispatch('bs', events.ResumeRequested())


@pytest.mark.parametrize('interrupt', [pause, lambda network: network.restart('user1')],
                         ids=['pause', 'restart of the user'])
def test_a_proposal_ends_with_time_and_with_its_user(net, library, region, interrupt):
    network = net()
    network.run_cycles(5)
    interrupt(network)
    network.run_cycles(1)
    assert used(network)[4] in library.by_id
    assert used(network)[-1] == region.id


@pytest.mark.parametrize('role', ['positioner', 'bs'])
def test_a_positioner_or_base_station_without_the_library_uses_the_codebook_of_the_region(
        net, region, role):
    network = net(without_library=[role])
    network.run_cycles(5)
    assert used(network) == [region.id] * 5


def test_a_controller_without_the_library_rejects_its_codebooks(net, region):
    network = net(without_library=['rhs_controller'])
    network.run_cycles(6)
    # After the long interval, the next prediction is too uncertain for a codebook.
    assert network.ends() == ['served', 'served', 'rhs_silent'] * 2
    assert set(used(network)) == {region.id}
    assert 'library: none' in network.logged('rhs_controller')[0]


def test_signals_of_a_cell_without_a_track_are_searched_in_the_whole_region(
        net, scenario, library):
    network = net()
    cell = library.codebook_at(PLACE, 0.3)
    drawn = MeasurementModel(scenario, cell).sample(PLACE[None], np.random.default_rng(3))[0]
    before = len(network.sent(m.PositionEstimate))
    network.dispatch('positioner', m.ReceivedSignals(
        cycle_id=1, user=7, codebook_id=cell.id,
        signals=drawn.reshape(cell.digital.shape[:3])))
    (estimate,) = network.sent(m.PositionEstimate)[before:]
    assert np.linalg.norm(estimate.position - PLACE) < 1.5


def test_estimators_of_a_library_leave_out_as_few_modes_as_the_positioner_does(
        scenario, region, library, estimator):
    """In a site, for example."""
    role, cell = Positioner(scenario, lambda: 0.0, TRACK, library=library,
                            left_out=5e-5), library.codebooks[0]
    feed(role, [events.CodebookOffered(region), events.EstimatorBuilt(region, estimator)])
    (signals,) = MeasurementModel(scenario, cell).sample(PLACE[None], np.random.default_rng(0))
    actions = role.handle(m.ReceivedSignals(
        cycle_id=3, user=2, user_instance=7, codebook_id=cell.id, stamp_ns=5,
        signals=signals.reshape(cell.shape[:3])), 1.0)
    (prepared,) = (one for one in actions if isinstance(one, events.PrepareEstimator))
    assert prepared.estimator.left_out == 5e-5
