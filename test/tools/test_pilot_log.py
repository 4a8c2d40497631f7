"""Pilots at known positions, assembled from messages."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.tools.calibrate import PilotLog

SCENARIO = Scenario(elements_per_side=3, n_feeds=2, n_subbands=2, n_frames=2)


@pytest.fixture
def codebook(random_beams):
    return random_beams(SCENARIO, np.random.default_rng(0))


@pytest.fixture
def log(codebook):
    log = PilotLog(Scenario())
    log.add(codebook)
    return log


def truth(cycle_id, user=1, sender=7):
    return m.GroundTruth(cycle_id=cycle_id, user=user, sender=sender, velocity=np.zeros(3),
                         position=np.array([8.0, cycle_id, 0.0]))


def signals(cycle_id, codebook_id, user=1, instance=7):
    return m.ReceivedSignals(
        cycle_id=cycle_id, user=user, user_instance=instance, codebook_id=codebook_id,
        signals=np.full((2, 2, 2), cycle_id + 1j))


def test_signals_are_paired_with_the_position_of_their_cycle(log, codebook):
    for message in (truth(1), signals(2, codebook.id), signals(1, codebook.id), truth(2)):
        log.add(message)
    (pilots,) = log.pilots()
    assert (log.n_pilots, pilots.beams) == (2, codebook)
    np.testing.assert_array_equal(pilots.positions[:, 1], [2, 1])
    np.testing.assert_array_equal(pilots.received[:, 0, 0], [2 + 1j, 1 + 1j])


def test_positions_are_converted_to_the_frame_of_the_surface(codebook):
    log = PilotLog(Scenario(pose={'position_m': [1, 2, 3], 'quaternion': [0, 0, 1, 1]}))
    for message in (codebook, truth(9), signals(9, codebook.id)):
        log.add(message)
    (pilots,) = log.pilots()
    # The truth is 7 m in front of the surface, which faces along y, and 7 m to its right.
    np.testing.assert_allclose(pilots.positions, [[7.0, -7.0, -3.0]], atol=1e-12)


@pytest.mark.parametrize('message', [
    truth(0), truth(3, user=2), truth(3, sender=8)], ids=['no cycle', 'user', 'instance'])
def test_positions_of_others_do_not_count(log, codebook, message):
    log.add(message)
    log.add(signals(3, codebook.id))
    assert (log.n_pilots, log.pilots()) == (0, [])


@pytest.mark.parametrize(('speed_mps', 'n_pilots'), [(0.01, 1), (0.1, 0)])
def test_users_who_move_during_long_frames_are_left_out(codebook, speed_mps, n_pilots):
    """In three frames of 0.1 s, the phase at 3 GHz changes by a radian at 0.05 m/s."""
    log = PilotLog(Scenario(n_frames=2, frame_duration_s=0.1))
    velocity = np.array([0.0, speed_mps, 0.0])
    for message in (codebook, dataclasses.replace(truth(1), velocity=velocity),
                    signals(1, codebook.id)):
        log.add(message)
    assert (log.n_pilots, log.n_moving) == (n_pilots, 1 - n_pilots)


def test_repeated_signals_count_once(log, codebook):
    for message in (truth(1), signals(1, codebook.id), signals(1, codebook.id)):
        log.add(message)
    assert log.n_pilots == 1


def test_signals_of_an_unknown_codebook_wait_for_it(log, random_beams, codebook):
    other = random_beams(SCENARIO, np.random.default_rng(1))
    for message in (truth(1), signals(1, other.id), truth(2), signals(2, codebook.id)):
        log.add(message)
    assert (log.missing_codebooks, log.n_pilots) == ([other.id], 1)
    log.codebooks[other.id] = codebook
    assert (log.missing_codebooks, log.n_pilots, len(log.pilots())) == ([], 2, 2)
