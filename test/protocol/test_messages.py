"""Messages and events as data, and the check of malformed messages."""

import dataclasses
import inspect
import math

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.events import CodebookOffered, LogMessage, PeersChanged, Send, Timeout

KINDS = [kind for _, kind in inspect.getmembers(m, inspect.isclass)
         if issubclass(kind, m.Message) and kind is not m.Message]


def name_of(value):
    return getattr(value, '__name__', None)


@pytest.mark.parametrize('kind', KINDS, ids=name_of)
def test_an_example_of_every_message_is_valid(example, scenario, kind):
    for rng in (None, np.random.default_rng(0)):
        m.check(example(kind, rng), scenario.sizes)


@pytest.mark.parametrize('kind', KINDS, ids=name_of)
def test_the_first_field_of_every_message_is_its_cycle(kind):
    assert dataclasses.fields(kind)[0].name == 'cycle_id'


@pytest.mark.parametrize('kind', KINDS, ids=name_of)
def test_messages_cannot_be_changed(example, kind):
    message = example(kind)
    for field in dataclasses.fields(message):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(message, field.name, None)


@pytest.mark.parametrize(('event', 'field'), [
    (CodebookOffered(None), 'codebook'), (PeersChanged(()), 'missing'),
    (Send(None), 'message'), (LogMessage('text'), 'text'), (LogMessage('text'), 'warning')])
def test_events_and_actions_cannot_be_changed(event, field):
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(event, field, None)


def test_messages_are_the_same_if_all_fields_are_equal(example):
    one = example(m.Beam, cycle_id=3, user=1)
    assert m.same(one, example(m.Beam, cycle_id=3, user=1))
    for changes in ({'cycle_id': 4}, {'user': 2}, {'analog': one.analog + 0.5}):
        assert not m.same(one, dataclasses.replace(one, **changes))
    assert not m.same(m.Ack(cycle_id=1, user=2), m.Grant(cycle_id=1, user=2))
    unknown = example(m.PositionEstimate, crlb_m2=np.nan)
    assert m.same(unknown, dataclasses.replace(unknown))
    assert not m.same(unknown, dataclasses.replace(unknown, crlb_m2=0.5))


def test_a_message_takes_the_fields_of_its_cycle_from_another():
    request = m.PilotRequest(cycle_id=3, user=2, user_instance=5, band=1, last_band=1, n_frames=2,
                             sender=9, scenario_id='sc', stamp_ns=7)
    pilot = m.derive(m.Pilot, request, symbols=np.ones(2, complex))
    assert (pilot.cycle_id, pilot.user, pilot.band) == (3, 2, 1)
    assert (pilot.sender, pilot.scenario_id, pilot.stamp_ns) == (0, '', 0)
    assert m.derive(m.Pilot, request, band=0, symbols=pilot.symbols).band == 0


def test_events_without_arrays_compare_by_value():
    assert Timeout() == Timeout()
    assert PeersChanged(('a',)) == PeersChanged(('a',)) != PeersChanged(('b',))
    assert LogMessage('a') == LogMessage('a', False) != LogMessage('a', True)


def test_messages_compare_by_identity(example):
    beacon = example(m.Beacon)
    assert beacon == beacon
    assert beacon != example(m.Beacon)


# Sizes of the small scenario: N_B = 2, N_SB = 3, F = 2, N_E = 16, K = 2.
SHAPES = [
    (m.RhsConfiguration, 'analog', (2, 15), '[FRAMES = 2, N_E = 16]'),
    (m.RhsConfiguration, 'analog', (16,), '[FRAMES = 2, N_E = 16]'),
    (m.RhsConfiguration, 'analog', (0, 16), '[FRAMES = 2, N_E = 16]'),
    (m.Pilot, 'symbols', (3,), '[F = 2]'),
    (m.FeedSignals, 'signals', (3, 2), '[F = 2, N_SB = 3, K = 2]'),
    (m.FeedSignals, 'signals', (3, 3, 2), '[F = 2, N_SB = 3, K = 2]'),
    (m.ReceivedSignals, 'signals', (2, 3), '[N_B = 2, N_SB = 3, F = 2]'),
    (m.ReceivedSignals, 'signals', (2, 2, 3), '[N_B = 2, N_SB = 3, F = 2]'),
    (m.ReceivedSignals, 'signals', (0,), '[N_B = 2, N_SB = 3, F = 2]'),
    (m.PositionEstimate, 'position', (2,), '[3]'),
    (m.PositionEstimate, 'covariance_m2', (3,), '[3, 3]'),
    (m.PositionEstimate, 'covariance_m2', (3, 2), '[3, 3]'),
    (m.Beam, 'analog', (1, 16), '[N_E = 16]'),
    (m.Beam, 'digital', (3, 3), '[N_SB = 3, K = 2]'),
    (m.CapacityStatistics, 'actual_bps', (2,), '[3]'),
    (m.CapacityStatistics, 'loss_percent', (3, 1), '[3]'),
    (m.GroundTruth, 'position', (), '[3]'),
    (m.GroundTruth, 'velocity', (4,), '[3]'),
]


@pytest.mark.parametrize(('kind', 'field', 'shape', 'expected'), SHAPES)
def test_a_wrong_shape_is_named(example, scenario, kind, field, shape, expected):
    message = example(kind, **{field: np.zeros(shape)})
    with pytest.raises(m.MessageError) as caught:
        m.check(message, scenario.sizes)
    assert str(caught.value) == (
        f'{kind.__name__}.{field}: shape {list(shape)}, expected {expected}')


@pytest.mark.parametrize('frames', [0, 1, 2, 7])
@pytest.mark.parametrize(('mode', 'right'), [(m.Mode.POSITIONING, 2), (m.Mode.TRANSMISSION, 1)])
def test_a_surface_reports_all_frames_or_the_one_of_the_beam(
        example, scenario, mode, right, frames):
    message = example(m.RhsConfiguration, mode=mode, analog=np.zeros((frames, 16)))
    if frames == right:
        m.check(message, scenario.sizes)
        return
    with pytest.raises(m.MessageError, match=r'expected \[FRAMES = '):
        m.check(message, scenario.sizes)


ARRAYS = [(kind, field) for kind in KINDS for field in dataclasses.fields(kind)
          if 'dims' in field.metadata and field.metadata['declared'].kind is not int]


@pytest.mark.parametrize(('kind', 'field'), ARRAYS, ids=name_of)
@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_an_array_with_a_value_that_is_not_finite_is_named(example, scenario, kind, field, bad):
    message = example(kind)
    getattr(message, field.name).flat[-1] = bad
    if field.metadata['nan_allowed'] and math.isnan(bad):
        m.check(message, scenario.sizes)
        return
    with pytest.raises(m.MessageError) as caught:
        m.check(message, scenario.sizes)
    assert str(caught.value) == (
        f'{kind.__name__}.{field.name}: not finite, expected finite numbers')


@pytest.mark.parametrize(('kind', 'field'), [
    (kind, field) for kind, field in ARRAYS
    if field.metadata['declared'].kind is complex], ids=name_of)
def test_an_imaginary_part_that_is_not_finite_is_named(example, scenario, kind, field):
    message = example(kind)
    getattr(message, field.name).flat[0] = complex(0, math.nan)
    with pytest.raises(m.MessageError, match='not finite'):
        m.check(message, scenario.sizes)


@pytest.mark.parametrize('kind', [m.RhsConfiguration, m.Beam], ids=name_of)
@pytest.mark.parametrize(('low', 'high', 'text'), [
    (-1e-9, 0.5, '-1e-09 to 0.5'), (0.0, 1.25, '0 to 1.25'), (-2.0, 3.0, '-2 to 3')])
def test_a_configuration_out_of_range_is_named(example, scenario, kind, low, high, text):
    message = example(kind)
    message.analog.flat[0], message.analog.flat[1:] = low, high
    with pytest.raises(m.MessageError) as caught:
        m.check(message, scenario.sizes)
    assert str(caught.value) == f'{kind.__name__}.analog: {text}, expected 0 to 1'


@pytest.mark.parametrize('kind', [m.RhsConfiguration, m.Beam], ids=name_of)
def test_the_ends_of_the_range_are_valid(example, scenario, kind):
    message = example(kind)
    message.analog.flat[::2] = 1.0
    m.check(message, scenario.sizes)


INDICES = [(kind, field.name, field.metadata['index_of']) for kind in KINDS
           for field in dataclasses.fields(kind) if 'index_of' in field.metadata]


@pytest.mark.parametrize(('kind', 'field', 'symbol'), INDICES, ids=name_of)
@pytest.mark.parametrize('value', [-1, 2, 4_000_000_000])
def test_an_index_out_of_range_is_named(example, scenario, kind, field, symbol, value):
    assert scenario.sizes[symbol] == 2
    with pytest.raises(m.MessageError) as caught:
        m.check(example(kind, **{field: value}), scenario.sizes)
    assert str(caught.value) == (
        f'{kind.__name__}.{field}: {value}, expected 0 to 1 ({symbol} = 2)')


def test_bands_are_indices():
    assert {(kind.__name__, field) for kind, field, _ in INDICES} == {
        (kind.__name__, field.name) for kind in KINDS for field in dataclasses.fields(kind)
        if field.name in ('band', 'last_band')}


NUMBERS = [(kind, field) for kind in KINDS for field in dataclasses.fields(kind)
           if field.type is float and 'dims' not in field.metadata]


@pytest.mark.parametrize(('kind', 'field'), NUMBERS, ids=name_of)
@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_a_number_must_be_finite_unless_it_may_be_unknown(example, scenario, kind, field, bad):
    message = example(kind, **{field.name: bad})
    unknown = {'crlb_m2', 'actual_bps', 'perfect_bps', 'loss_bps', 'loss_percent'}
    if field.name in unknown:
        m.check(message, scenario.sizes)
        return
    with pytest.raises(m.MessageError) as caught:
        m.check(message, scenario.sizes)
    assert str(caught.value) == (
        f'{kind.__name__}.{field.name}: {bad}, expected a finite number')


RANGES = [(kind, field) for kind in KINDS for field in dataclasses.fields(kind)
          if 'declared' in field.metadata and 'dims' not in field.metadata]


@pytest.mark.parametrize(('kind', 'field'), RANGES, ids=name_of)
def test_a_number_out_of_range_is_named(example, scenario, kind, field):
    declared = field.metadata['declared']
    low, high = declared.low, declared.high
    for good in (low, high):
        m.check(example(kind, **{field.name: field.type(good)}), scenario.sizes)
    for bad in (low - 1, high + 1):
        with pytest.raises(m.MessageError) as caught:
            m.check(example(kind, **{field.name: field.type(bad)}), scenario.sizes)
        assert str(caught.value) == (
            f'{kind.__name__}.{field.name}: {field.type(bad)}, expected {declared.range}')


def test_users_start_at_one_and_amounts_are_not_negative():
    ranges = {(kind, field.name): field.metadata['declared'].low for kind, field in RANGES}
    for kind in KINDS:
        for field in dataclasses.fields(kind):
            if field.name == 'user':
                assert ranges[kind, 'user'] == (0 if kind is m.ProtocolState else 1)
            elif 'dims' in field.metadata:
                continue
            elif field.name in ('duration_s', 'latency_s', 'bits', 'expected_bps',
                                'at_estimate_bps'):
                assert ranges[kind, field.name] == 0


@pytest.mark.parametrize('n_frames', [0, 1, 3, 2**31])
def test_a_request_with_a_wrong_number_of_frames_is_named(example, scenario, n_frames):
    with pytest.raises(m.MessageError) as caught:
        m.check(example(m.PilotRequest, n_frames=n_frames), scenario.sizes)
    assert str(caught.value) == f'PilotRequest.n_frames: {n_frames}, expected F = 2'


@pytest.mark.parametrize('kind', [m.PositionEstimate, m.GroundTruth], ids=name_of)
def test_a_position_out_of_range_is_named(example, scenario, kind):
    with pytest.raises(m.MessageError, match=rf'{kind.__name__}\.position: 0 to 2e\+06'):
        m.check(example(kind, position=np.array([2e6, 0, 0])), scenario.sizes)


def test_an_error_of_a_message_is_a_value_error():
    assert issubclass(m.MessageError, ValueError)
