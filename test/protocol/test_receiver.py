"""The receiver of a surface that follows the base station of another one."""

import numpy as np
import pytest
from in_memory_network import feed

from rhs_isac_ros.model.measurement import receive_feeds
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import CodebookOffered, LogMessage, SettingsOffered
from rhs_isac_ros.protocol.receiver import Receiver, ReceiverState
from rhs_isac_ros.protocol.settings import ReceiverSettings


@pytest.fixture
def receiver(scenario, codebooks):
    role = Receiver(scenario, 3)
    feed(role, [CodebookOffered(codebooks[0])])
    return role


@pytest.fixture
def signals(example):
    """Function that returns the feed signals of a band in a cycle."""
    def make(band, cycle_id=5, user=2, **fields):
        return example(m.FeedSignals, np.random.default_rng(band), cycle_id=cycle_id, user=user,
                       band=band, **{'user_instance': 7, 'sender': 4, 'stamp_ns': 9} | fields)
    return make


def grant(cycle_id=5, user=2):
    return m.Grant(cycle_id=cycle_id, user=user, user_instance=7)


def test_a_grant_of_another_surface_commands_the_own_surface(receiver, scenario, codebooks):
    (commands,) = feed(receiver, [grant()])
    assert [(one.cycle_id, one.band, one.codebook_id) for one in commands] == [
        (5, band, codebooks[0].id) for band in range(scenario.n_bands)]
    assert receiver.state is ReceiverState.SOUNDING


@pytest.mark.parametrize('adds_noise', [True, False])
def test_the_signals_of_all_bands_are_combined_with_the_own_codebook(
        receiver, scenario, codebooks, signals, adds_noise):
    """Their stamp is the middle of four frames of 4 us."""
    settings = SettingsOffered(ReceiverSettings(receiver_noise=adds_noise))
    *_, (received,) = feed(receiver, [settings, grant(), signals(1), signals(0)])
    assert (received.cycle_id, received.user, received.user_instance, received.codebook_id,
            received.stamp_ns) == (5, 2, 7, codebooks[0].id, 9 + 6000)
    feeds = np.stack([signals(band).signals for band in range(scenario.n_bands)])
    noiseless = receive_feeds(scenario, codebooks[0], feeds, None)
    noise = np.abs(received.signals - noiseless).max()
    assert noise < 10 * np.sqrt(scenario.noise_power_w) and (noise > 0) == adds_noise
    assert receiver.state is ReceiverState.LISTENING


def test_surfaces_with_different_seeds_have_independent_noise(scenario, codebooks, signals):
    def received(seed):
        *_, (message,) = feed(Receiver(scenario, seed), [
            CodebookOffered(codebooks[0]), grant(), signals(1), signals(0)])
        return message.signals
    assert np.array_equal(received(0), received(0))
    assert not np.isclose(received(0), received(2**31), rtol=1e-9, atol=0).any()


def test_the_codebook_of_the_grant_is_used_to_the_end_of_the_cycle(receiver, codebooks, signals):
    *_, (received,) = feed(receiver, [grant(), CodebookOffered(codebooks[1]), signals(0),
                                      signals(1)])
    assert received.codebook_id == codebooks[0].id
    (commands,) = feed(receiver, [grant(6)])
    assert {one.codebook_id for one in commands} == {codebooks[1].id}


@pytest.mark.parametrize(('fields', 'outcome'), [
    ({'cycle_id': 4}, 'wrong_cycle'), ({'user': 3}, 'wrong_user'),
    ({'user_instance': 8}, 'wrong_instance'), ({'sender': 5}, 'wrong_instance'),
    ({}, 'duplicate')])
def test_signals_of_something_else_do_not_count(receiver, signals, fields, outcome):
    feed(receiver, [grant(), signals(0)])
    assert feed(receiver, [signals(0, **fields)]) == [[]]
    assert receiver.counters == {outcome: 1}
    assert receiver.state is ReceiverState.SOUNDING


def test_late_signals_change_nothing(receiver, signals):
    feed(receiver, [grant(), signals(0), signals(1)])
    assert feed(receiver, [signals(1), grant()]) == [[], []]
    assert receiver.counters == {'duplicate': 2}


def test_incomplete_signals_are_discarded_and_logged_by_user(receiver, signals):
    feed(receiver, [grant(5), signals(0, 5)])
    (warning,) = [action for action in receiver.handle(grant(6), 2.0)
                  if isinstance(action, LogMessage)]
    assert warning == LogMessage(
        'cycle 5: no signals of user 2 in the bands [1]', True, 'signals of user 2', True)
    assert receiver.counters == {'incomplete': 1}
    *_, (received,) = feed(receiver, [signals(0, 6), signals(1, 6)])
    assert received.cycle_id == 6


def test_no_command_is_sent_without_a_codebook(scenario):
    receiver = Receiver(scenario, 0)
    assert feed(receiver, [grant()]) == [[]]
    assert receiver.counters == {'wrong_codebook': 1}
