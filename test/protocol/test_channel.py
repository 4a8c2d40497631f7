"""The channel."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from in_memory_network import emulated_front_end, feed

from rhs_isac_ros.calibration import known_states
from rhs_isac_ros.frontend import EmulatedSurface, RadioFault, Sounding, SurfaceFault
from rhs_isac_ros.link import Beamformer, capacity
from rhs_isac_ros.model import Pose
from rhs_isac_ros.model.geometry import frame_times_s
from rhs_isac_ros.model.hall import PathChannel
from rhs_isac_ros.model.los import los_gain
from rhs_isac_ros.model.surface import onboard_matrix
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel, apply_patterns
from rhs_isac_ros.protocol.events import (
    ApplyPatterns,
    FrontEndFailed,
    LogMessage,
    PatternsApplied,
    SettingsOffered,
)
from rhs_isac_ros.protocol.settings import Impairments

PLACE = np.array([8.0, -2.0, 0.5])


def truth_of(cycle_id, user=1, place=PLACE):
    return m.GroundTruth(cycle_id=cycle_id, user=user, position=place, velocity=np.zeros(3))


def configured(cycle_id, analog):
    return m.RhsConfiguration(cycle_id=cycle_id, mode=m.Mode.POSITIONING, band=0,
                              codebook_id='x', analog=analog)


def pilots_of(cycle_id, user=1, symbol=1 + 0j):
    return m.Pilot(cycle_id=cycle_id, user=user, band=0, symbols=np.full(2, symbol))


def signals_of(channel, analog, cycle_id=3, user=1, place=PLACE, symbol=1 + 0j):
    """Return the feed signals of the first band in a cycle, [F, N_SB, K]."""
    ((feeds,),) = feed(channel, [truth_of(cycle_id, user, place), configured(cycle_id, analog),
                                 pilots_of(cycle_id, user, symbol)])[-1:]
    return feeds.signals


@pytest.fixture
def configuration(codebooks):
    return configured(3, codebooks[0].analog[0])


@pytest.fixture
def pilots():
    return pilots_of(3)


@pytest.fixture
def downlink():
    return m.Data(
        cycle_id=3, user=1, direction=m.Direction.DOWNLINK, stage=m.Stage.OFFERED, duration_s=1e-3,
        bits=1e9)


def test_the_channel_answers_pilots_for_any_order_of_messages(
        scenario, truth, configuration, pilots):
    answers = []
    for order in itertools.permutations([truth, configuration, pilots]):
        sent = feed(Channel(scenario, 0), order)
        # No answer before all messages that it needs have arrived.
        assert sent[:2] == [[], []]
        answers += sent[2]
    assert len(answers) == 6
    for feeds in answers:
        assert (feeds.cycle_id, feeds.user, feeds.band) == (3, 1, 0)
        np.testing.assert_array_equal(feeds.signals, answers[0].signals)
    assert not np.isclose(answers[0].signals[0], answers[0].signals[1]).any()


def test_feed_signals_follow_the_configuration_and_are_those_of_unit_symbols(
        scenario, configuration):
    def signals(analog, symbol=1 + 0j):
        return signals_of(Channel(scenario, 0), analog, symbol=symbol)

    analog = configuration.analog
    plain = signals(analog)
    for symbol in (0.6 - 0.8j, -1j, 1.005 + 0j):
        np.testing.assert_allclose(signals(analog, symbol), plain, rtol=1e-14)
    np.testing.assert_allclose(signals(analog / 2), plain / 2)
    # Element by element: the path, including on-board propagation.
    single = [signals(np.tile(element, (2, 1))) for element in np.eye(16)]
    np.testing.assert_allclose(signals(np.ones((2, 16))), sum(single))


def test_a_pilot_of_another_node_with_the_number_is_not_answered(
        scenario, truth, configuration, pilots):
    channel = Channel(scenario, 0)
    known, foreign, by_hand = (dataclasses.replace(pilots, sender=sender)
                               for sender in (5, 6, 0))
    sent = feed(channel, [dataclasses.replace(truth, sender=5), configuration, foreign, known,
                          by_hand])
    assert [len(batch) for batch in sent] == [0, 0, 0, 1, 1]
    assert channel.counters == {'wrong_instance': 1}


def test_the_first_beam_of_a_cycle_stands(scenario, truth, beam, applied, downlink):
    """A second node may steer as well; data are delivered with the beam of the first."""
    channel = Channel(scenario, 0)
    first = dataclasses.replace(beam, sender=5)
    second = dataclasses.replace(beam, sender=6, digital=1e-3 * beam.digital)
    *_, (delivered,) = feed(channel, [truth, applied, first, second, downlink])
    *_, (expected,) = feed(Channel(scenario, 0), [truth, applied, first, downlink])
    assert delivered.bits == expected.bits > 0
    assert channel.counters == {'wrong_instance': 1}


def test_a_pilot_of_the_next_cycle_waits_for_it(scenario, truth, configuration, codebooks):
    channel = Channel(scenario, 0)
    sent = feed(channel, [
        truth, configuration, pilots_of(4), configured(4, configuration.analog), truth_of(4)])
    assert sent[:4] == [[]] * 4
    assert [f.cycle_id for f in sent[4]] == [4]


def test_the_channel_delivers_data_for_any_order_of_messages(
        scenario, truth, beam, applied, downlink):
    for order in itertools.permutations([truth, beam, applied, downlink]):
        sent = [s for batch in feed(Channel(scenario, 0), order) for s in batch]
        assert [(s.stage, s.bits) for s in sent] == [(m.Stage.DELIVERED, sent[0].bits)]


def test_the_channel_delivers_the_capacity_at_the_true_position(
        scenario, truth, beam, applied, downlink):
    channel = Channel(scenario, 0)
    feed(channel, [truth, beam, applied])
    rate = capacity(scenario, Beamformer(beam.analog, beam.digital), PLACE[None])[0]
    ((delivered,),) = feed(channel, [downlink])
    assert delivered.bits == math.floor(rate * 1e-3)
    assert (delivered.direction, delivered.stage) == (m.Direction.DOWNLINK, m.Stage.DELIVERED)
    ((delivered,),) = feed(channel, [dataclasses.replace(
        downlink, direction=m.Direction.UPLINK, bits=10.0)])
    assert (delivered.direction, delivered.bits) == (m.Direction.UPLINK, 10.0)
    # The surface may report another configuration than that of the beam.
    off = dataclasses.replace(applied, analog=np.zeros((1, 16)))
    (*_, (delivered,)) = feed(Channel(scenario, 0), [truth, beam, off, downlink])
    assert delivered.bits == 0


def handle_all(channel, events):
    """Return all actions of a channel, whose surface has not answered yet."""
    return [action for event in events for action in channel.handle(event, 0.0)]


def test_no_answer_precedes_the_confirmation_of_its_configurations(
        scenario, truth, configuration, pilots, beam, applied, downlink):
    channel = Channel(scenario, 0)
    (sounding,) = handle_all(channel, [truth, configuration, pilots])
    (steering,) = handle_all(channel, [beam, applied, downlink])
    np.testing.assert_array_equal(sounding.configurations, configuration.analog)
    np.testing.assert_array_equal(steering.configurations, beam.analog[None])
    # A repeated message asks for what is under way.
    assert handle_all(channel, [pilots, downlink]) == []
    assert channel.counters == {'duplicate': 2}
    assert steering.sounding is None
    (delivered,), (feeds,) = (
        channel.handle(apply_patterns(emulated_front_end(scenario), request), 0.0)
        for request in (steering, sounding))
    assert (type(delivered.message), type(feeds.message)) == (m.Data, m.FeedSignals)


def test_elements_have_the_coefficients_of_known_states(
        scenario, truth, configuration, beam, applied, downlink):
    switched = np.rint(configuration.analog)
    states = known_states(scenario, 1, -1).surface
    plain = [signals_of(Channel(scenario, 0), analog) for analog in (switched, 1 - switched)]
    np.testing.assert_allclose(signals_of(Channel(scenario, 0, None, states), switched),
                               plain[1] - plain[0], rtol=1e-9)
    events = [truth, beam, applied, downlink]
    ((known,), (unknown,)) = (feed(channel, events)[-1] for channel in (
        Channel(scenario, 0, None, states), Channel(scenario, 0)))
    assert known.bits != unknown.bits


def test_signals_are_those_of_the_configurations_that_were_shown(
        scenario, truth, configuration, pilots):
    """A later report, as of another codebook, does not change what the surface showed."""
    channel = Channel(scenario, 0)
    (request,) = handle_all(channel, [truth, configuration, pilots])
    handle_all(channel, [configured(3, 1 - configuration.analog)])
    (feeds,) = channel.handle(apply_patterns(emulated_front_end(scenario), request), 0.0)
    np.testing.assert_array_equal(
        feeds.message.signals, signals_of(Channel(scenario, 0), configuration.analog))


def test_configurations_that_are_confirmed_in_another_cycle_are_not_measured(
        scenario, truth, configuration, pilots):
    channel = Channel(scenario, 0)
    (request,) = handle_all(channel, [truth, configuration, pilots])
    assert handle_all(channel, [truth_of(4), PatternsApplied(request.key)]) == []
    assert channel.counters == {'stale': 1}


def test_a_fault_of_the_front_end_is_counted_and_logged_and_sends_nothing(
        scenario, truth, configuration, pilots):
    channel = Channel(scenario, 0)
    (request,) = handle_all(channel, [truth, configuration, pilots])
    assert channel.handle(FrontEndFailed(request.key, 'surface_silence', 'no answer'), 0.0) == [
        LogMessage('no answer', True, 'surface_silence')]
    assert channel.counters == {'surface_silence': 1}
    assert channel.status()['warning.front_end'] == 'no answer'
    # The base station asks again.
    (request,) = handle_all(channel, [pilots])
    recovery, feeds = channel.handle(
        apply_patterns(emulated_front_end(scenario), request), 0.0)
    assert recovery == LogMessage(
        'surface and radio work again', False, 'front end', False)
    assert feeds.message.band == 0
    assert 'warning.front_end' not in channel.status()


class Faulty(EmulatedSurface):
    """A surface that fails at configurations of given numbers, from 1."""

    def __init__(self, n_elements, faults, error=None):
        super().__init__(n_elements)
        self.faults, self.n = faults, 0
        self.error = error or SurfaceFault('silence', 'no answer')

    def apply(self, configuration):
        self.n += 1
        if self.n in self.faults:
            raise self.error
        super().apply(configuration)


@pytest.mark.parametrize(('error', 'kind', 'text'), [
    (SurfaceFault('restart', 'port: restarted'), 'surface_restart', 'surface: port: restarted'),
    (ValueError('configuration[1]: 0.5'), 'surface_ValueError',
     'surface: ValueError: configuration[1]: 0.5'),
    (OSError('gone'), 'surface_OSError', 'surface: OSError: gone'),
    (RadioFault('no samples'), 'radio', 'radio: no samples')])
@pytest.mark.parametrize('measured', [False, True])
def test_the_first_fault_ends_a_series_of_configurations(scenario, error, kind, text, measured):
    surface = Faulty(16, {2}, error)
    front_end = emulated_front_end(scenario, surface)
    request = ApplyPatterns((1, 2), np.eye(16)[:3], Sounding(
        1, 0, np.ones(3), np.ones((3, 3, 2)), 1, np.zeros(3), np.zeros(3)) if measured else None)
    assert apply_patterns(front_end, request) == FrontEndFailed((1, 2), kind, text)
    assert (surface.n, np.argmax(surface.applied)) == (2, 0)
    done = apply_patterns(front_end, request)
    assert done == PatternsApplied((1, 2))
    assert (done.feeds is not None) == measured
    assert np.argmax(surface.applied) == 2


def test_a_cycle_is_served_in_spite_of_a_fault_or_given_up(network):
    net = network(1, retries=1, rest_s=0.0)
    # The first cycle repeats both bands; the second fails in both attempts and both bands.
    net.front_end = emulated_front_end(
        net.scenario, Faulty(net.scenario.n_elements, {2, *range(14, 18)}))
    net.run_cycles(3)
    assert net.ends() == ['served', 'channel_silent', 'served']
    assert net['channel'].counters['surface_silence'] == 5
    assert len(net.sent(m.PositionEstimate)) == 2
    assert net.logged('channel').count('surface: no answer') == 5
    net.verify()


@pytest.mark.parametrize('duration_s', [0.0, 0.6, 10.0])
def test_users_are_served_within_three_seconds_after_a_fault_at_any_pattern(network, duration_s):
    net = network(1, retries=3)
    surface = Faulty(net.scenario.n_elements, ())
    net.front_end = emulated_front_end(net.scenario, surface)
    net.run_cycles(1)
    for pattern in range(1, surface.n + 1):
        first = surface.n + pattern
        surface.faults = range(first, 10**6 if duration_s else first + 1)
        net.run(lambda n=first: surface.n >= n)
        net.run(limit_s=duration_s)
        surface.faults, end_s, n_served = (), net.now_s, len(net.served())
        net.run(lambda n=n_served: len(net.served()) > n, limit_s=3.0)
        assert net.now_s - end_s < 3.0
    net.verify()


def make_deviating(scenario, **impairments):
    """Return a channel without multipath."""
    silent = dataclasses.replace(scenario, multipath_to_los_db=-200.0)
    return Channel(silent, 0, Impairments(**impairments))


# Whether the deviation is the same in another cycle of the user, and for another user.
@pytest.mark.parametrize(('name', 'strength', 'same_user', 'same_surface'), [
    ('user_gain_std_db', 3.0, True, False), ('carrier_offset_std_hz', 1e4, True, False),
    ('phase_std_rad', 7.0, False, False), ('band_phase_std_rad', 7.0, False, False),
    ('timing_std_s', 1e-6, False, False), ('element_error_rms', 0.2, True, True),
    ('failed_element_share', 0.3, True, True)])
def test_a_deviation_of_the_surface_the_user_or_the_cycle_can_be_switched_off(
        scenario, codebooks, name, strength, same_user, same_surface):
    analog = codebooks[0].analog[0]
    plain = signals_of(make_deviating(scenario), analog, 1)
    impaired = make_deviating(scenario, **{name: strength})
    declared = make_deviating(dataclasses.replace(scenario, **{name: strength}))
    first, again, other = (signals_of(impaired, analog, cycle_id, user)
                           for user, cycle_id in ((1, 1), (1, 2), (2, 3)))
    assert not np.allclose(first, plain, rtol=1e-3)
    assert np.allclose(again, first, rtol=1e-6) == same_user
    assert np.allclose(other, first, rtol=1e-6) == same_surface
    # The little multipath that is left differs.
    np.testing.assert_allclose(signals_of(declared, analog, 2), again, rtol=1e-6)
    for channel in (impaired, declared):
        channel.handle(SettingsOffered(Impairments(**{name: 0.0})), 0.0)
        np.testing.assert_allclose(signals_of(channel, analog), plain, rtol=1e-6)
        channel.handle(SettingsOffered(Impairments()), 0.0)
    np.testing.assert_allclose(signals_of(impaired, analog, 4), plain, rtol=1e-6)
    assert not np.allclose(signals_of(declared, analog, 4), plain, rtol=1e-3)


def test_gain_and_element_errors_change_the_capacity(scenario, truth, beam, applied, downlink):
    def bits(**impairments):
        channel = make_deviating(scenario, **impairments)
        feed(channel, [truth, beam, applied])
        ((delivered,),) = feed(channel, [downlink])
        return delivered.bits

    assert bits(phase_std_rad=7.0, carrier_offset_std_hz=1e4) == bits()
    assert bits(user_gain_std_db=3.0) != bits()
    assert bits(failed_element_share=1.0) < bits()


def test_a_channel_file_takes_the_place_of_fading(scenario, configuration):
    """Two users at one traced position have the same signals, and so have two cycles."""
    users = np.array([PLACE + [0.3, 0, 0], PLACE + [1, 0, 0]])
    distance = np.linalg.norm(users, axis=1)[:, None]
    paths = PathChannel(users, 299_792_458 / (4 * np.pi * 2.75e9 * distance) + 0j,
                        users[:, None], np.zeros((2, 1), int), 2.75e9)
    traced = dataclasses.replace(scenario, channel=paths)
    signals = [signals_of(Channel(traced, seed), configuration.analog) for seed in (0, 1)]
    np.testing.assert_array_equal(*signals)
    expected = np.einsum('jm,fm,jkm->fjk', los_gain(scenario, users[:1], 0)[0],
                         configuration.analog, onboard_matrix(scenario)[0])
    np.testing.assert_allclose(signals[0], expected, rtol=1e-9)


@pytest.mark.parametrize('pose', [Pose(), Pose((3.0, 1.0, 0.0), (0.0, 0.0, 0.6, 0.8))])
def test_the_user_moves_during_a_cycle(scenario, codebooks, pose):
    """Each frame has the signals of a user who stands at the position of this time."""
    slow = dataclasses.replace(scenario, frame_duration_s=0.015, retune_s=0.1, pose=pose)
    start, velocity = pose.to_site(PLACE), pose.vectors_to_site(np.array([0.6, -0.7, 0.3]))

    def signals(band, position, velocity):
        truth = m.GroundTruth(cycle_id=3, user=1, position=position, velocity=velocity)
        analog = codebooks[0].analog[band]
        ((feeds,),) = feed(Channel(slow, 0), [
            truth, dataclasses.replace(configured(3, analog), band=band),
            dataclasses.replace(pilots_of(3), band=band)])[-1:]
        return feeds.signals

    for band, times_s in enumerate(frame_times_s(slow)):
        moving = signals(band, start, velocity)
        for frame, time_s in enumerate(times_s):
            still = signals(band, start + time_s * velocity, np.zeros(3))
            np.testing.assert_allclose(moving[frame], still[frame], rtol=1e-9)
        assert not np.isclose(moving, signals(band, start, np.zeros(3))).any()


@pytest.mark.parametrize(('place', 'speed_mps'), [(-1.0, 0.0), (0.1, 1.0)])
def test_a_user_who_is_or_walks_behind_the_surface_has_no_signals(scenario, place, speed_mps):
    """Another surface of the site may have the user in sight."""
    channel = Channel(dataclasses.replace(scenario, frame_duration_s=0.1), 0)
    behind = m.GroundTruth(cycle_id=3, user=1, position=np.array([place, 0.0, 0.0]),
                           velocity=np.array([speed_mps, 0.0, 0.0]))
    assert feed(channel, [behind, configured(3, np.ones((2, 16))), pilots_of(3)]) == [[], [], []]
    assert channel.counters == {'behind': 1}


@pytest.mark.parametrize('pose', [Pose(), Pose((3.0, 1.0, 0.0), (0.0, 0.0, 0.6, 0.8))])
@pytest.mark.parametrize(('impairments', 'undone'), [
    ({'surface_shift_m': 0.3}, lambda place: place - [0.0, 0.3, 0.0]),
    ({'surface_turn_deg': 90.0}, lambda place: place @ [[0, -1, 0], [1, 0, 0], [0, 0, 1]])])
def test_a_surface_may_hang_elsewhere_than_its_pose_says(scenario, pose, impairments, undone):
    place = np.array([4.0, 3.0, 0.5])
    posed = dataclasses.replace(scenario, pose=pose)
    moved, expected = (
        signals_of(Channel(posed, 0, Impairments(**deviation)), np.ones((2, 16)),
                   place=pose.to_site(at))
        for deviation, at in ((impairments, place), ({}, undone(place))))
    np.testing.assert_allclose(moved, expected, rtol=1e-9)
