"""Tracks of users in the network, on the bus in memory and from the signals alone."""

import numpy as np
import pytest
from in_memory_network import Network

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.mobility import Waypoints
from rhs_isac_ros.positioning import TrackEstimate, make_estimator
from rhs_isac_ros.positioning.tracking import MAX_GAP_S
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.positioner import Tracks

PLACE = np.array([8.0, -2.0, 0.5])


@pytest.fixture(scope='module')
def scenario():
    return Scenario(n_subbands=4, n_frames=2, elements_per_side=6, roi_center_m=(8.0, 0.0, 0.0),
                    roi_size_m=(4.0, 6.0, 2.0))


@pytest.fixture(scope='module')
def codebook(scenario):
    return random_codebook(scenario, np.random.default_rng(1))


@pytest.fixture(scope='module')
def estimator(scenario, codebook):
    return make_estimator('bayes', scenario, codebook)


@pytest.fixture
def signals(scenario, codebook):
    """Function that returns the signals of a cycle of a user at a fixed place."""
    model, rng = MeasurementModel(scenario, codebook), np.random.default_rng(2)

    def make(cycle_id, user=1, **fields):
        drawn = model.sample(PLACE[None], rng)[0].reshape(codebook.digital.shape[:3])
        return m.ReceivedSignals(
            cycle_id=cycle_id, user=user, codebook_id=codebook.id, signals=drawn, **fields)
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


def test_each_user_has_a_track(locate):
    assert [locate(n, user=1 + n % 2).n_phases for n in range(6)] == [1, 1, 2, 2, 3, 3]


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
        assert not isinstance(estimate, TrackEstimate)
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
    locate(2, user=2, now_s=30.0 + MAX_GAP_S)
    assert len(locate.tracks._tracks) == 1


def test_the_number_of_tracks_is_bounded(monkeypatch, locate):
    monkeypatch.setattr(locate.tracks._tracks, 'max_size', 2)
    counts = [locate(n, user=user, now_s=n / 10).n_phases
              for n, user in enumerate([1, 2, 1, 3, 1, 2])]
    assert counts == [1, 1, 2, 1, 3, 1]
    assert len(locate.tracks._tracks) == 2


@pytest.fixture
def tracked(scenario, codebook, estimator):
    """Function that runs a network with the prior ``track``."""
    def make(users, **options):
        network = Network(scenario, codebook, users, make=lambda codebook: estimator,
                          rest_s=0.02, ack_timeout_s=0.01, **options)
        network.change('positioner', prior='track')
        return network
    return make


def test_users_that_share_the_cycles_have_tracks_that_the_beam_uses(tracked):
    network = tracked({1: PLACE, 2: Waypoints([[7, 1, 0], [7, -1, 0], [9, -1, 0]], 1.0)})
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


def test_the_prior_region_ends_all_tracks(tracked):
    network = tracked({1: PLACE})
    network.run_cycles(10)
    network.change('positioner', prior='region')
    network.run_cycles(2)
    seen = len(network.tracks)
    network.run_cycles(5)
    assert len(network.tracks) == seen
    network.change('positioner', prior='track')
    network.run_cycles(5)
    assert network.tracks[seen].estimate.n_phases == 1
