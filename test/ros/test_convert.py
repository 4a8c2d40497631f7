"""Conversions between plain messages and ROS messages."""

import dataclasses
import enum
import functools
import math
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from rclpy.serialization import deserialize_message, serialize_message
from ros_messages import codebook_from_ros, from_ros, to_ros

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.messages import MessageError
from rhs_isac_ros.protocol.presences import Presence
from rhs_isac_ros.ros import cdr, convert, topics
from rhs_isac_ros.ros.convert import CodebookMessage
from rhs_isac_ros.ros.topics import Frame

SIZES = Scenario().sizes
STAMP = Time(sec=12, nanosec=345)
KINDS = list(topics.NAMES)
FILES = Path(__file__).resolve().parents[2] / 'msg_defs' / 'msg'
# Types that are parts of messages, and a message outside the protocol.
OTHER_TYPES = {'Presence', 'RealArray', 'ComplexArray', 'Codebook'}
ENUMS = {'RhsConfiguration': [m.Mode], 'Data': [m.Direction, m.Stage], 'ProtocolState': [m.Phase]}


def random_scalar(field, rng):
    meta = field.metadata
    if 'index_of' in meta:
        return int(rng.integers(SIZES[meta['index_of']]))
    if issubclass(field.type, enum.IntEnum):
        return rng.choice(list(field.type))
    if field.type is int:
        bits = 64 if field.name == 'cycle_id' else 32
        return [0, 1, 2**bits - 1, int(rng.integers(2**32))][rng.integers(4)]
    if field.type is float:
        special = [math.nan, math.inf] if 'nan_allowed' in meta else [0.0]
        return float(rng.choice([-0.0, cdr.TINY, 1.7e308, rng.normal(), *special]))
    assert field.type is str
    return ''.join(rng.choice(list('aZ09 _/µ漢\n"'), size=rng.integers(0, 20)))


def random_array(meta, rng):
    """Return an array with a random number of frames, which only `check` restricts."""
    shape = [SIZES.get(d) or int(d if d.isdigit() else rng.integers(1, 6)) for d in meta['dims']]
    declared = meta['declared']
    if declared.kind is complex:
        return rng.normal(size=(*shape, 2)) @ [1, 1j] * 10.0**rng.integers(-200, 200)
    if declared.kind is int:
        return rng.integers(declared.low, declared.high, shape)
    if declared.range:
        return rng.uniform(declared.low, declared.high, shape)
    return rng.normal(size=shape) * 10.0**rng.integers(-200, 200)


def random_message(kind, rng):
    return kind(**{
        field.name: random_array(field.metadata, rng) if 'dims' in field.metadata
        else random_scalar(field, rng) for field in dataclasses.fields(kind)})


def assert_same(one, other):
    """Assert equal classes, types and values, bit for bit."""
    assert type(one) is type(other)
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name == 'stamp_ns':
            # The conversion takes it as an argument.
            continue
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape) == (b.dtype, b.shape), field.name
            assert a.tobytes() == b.tobytes(), field.name
        elif isinstance(a, float):
            assert np.float64(a).tobytes() == np.float64(b).tobytes(), field.name
        else:
            assert isinstance(b, field.type), field.name
            assert a == b, field.name


@pytest.mark.parametrize('kind', KINDS)
def test_rclpy_and_the_bytes_agree(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    for _ in range(20):
        message = random_message(kind, rng)
        content = convert.to_bytes(message, 10**9 * STAMP.sec + STAMP.nanosec, (7, 'sc2'))
        received = deserialize_message(content, convert.ros_type(kind))
        # The padding may differ.
        assert len(serialize_message(received)) == len(content)
        assert (received.header.stamp, received.header.frame_id) == (STAMP, 'rhs_link')
        expected = dataclasses.replace(message, sender=7, scenario_id='sc2')
        assert_same(expected, from_ros(kind, received))
        assert_same(expected, convert.from_bytes(kind, content))
        for name in received.get_fields_and_field_types():
            sent, value = getattr(expected, name, None), getattr(received, name)
            if isinstance(sent, (int, float, str)):
                assert sent == value or sent != sent, name


def test_a_message_gets_the_fields_that_it_lacks_only_if_they_have_defaults():
    fields = list(ros.Presence.get_fields_and_field_types())
    presence = Presence(sender=3, scenario_id='sc', role='bs', node='/bs', scenario='{}',
                        stamp_ns=7, use_sim_time=True, library_id='lib')
    whole = convert.to_bytes(presence, 7)
    n = fields.index('use_sim_time')
    extend = convert.extension(ros.Presence, n)
    # A flag, and the size and the content of a text follow.
    lacking = whole[:-1 - 4 - len('lib\0')]
    assert convert.from_bytes(Presence, extend(lacking)) == dataclasses.replace(
        presence, use_sim_time=False, library_id='')
    for bad in (b'', lacking[:-1], b'\0\0' + lacking[2:]):
        assert extend(bad) == bad
    assert convert.extension(ros.Presence, n - 1) is None
    assert convert.extension(Point, 3) is None


def test_another_encoding_is_named():
    content = convert.to_bytes(m.Ack(cycle_id=3, user=7), 0)
    with pytest.raises(m.MessageError, match='^Ack: .* representation 0000, expected 0001$'):
        convert.from_bytes(m.Ack, b'\0\0' + content[2:])


def test_a_stamp_with_a_second_or_more_of_nanoseconds_is_refused():
    """Together with many seconds, it would exceed the range of a stamp that is sent on."""
    content = bytearray(convert.to_bytes(m.Ack(cycle_id=3, user=7), 0))
    struct.pack_into('<iI', content, len(cdr.HEADER), 2**31 - 1, 10**9)
    with pytest.raises(m.MessageError, match='1000000000 ns, expected less than'):
        convert.from_bytes(m.Ack, bytes(content))


@pytest.mark.parametrize(('stamp_ns', 'second'), [
    (10**9 * 2**31, 2**31), (-10**9 * 2**31 - 1, -2**31 - 1)])
def test_a_stamp_that_no_message_can_have_is_refused(stamp_ns, second):
    with pytest.raises(m.MessageError, match=f'Ack.header: stamp of {second} s, expected -2147'):
        convert.to_bytes(m.Ack(cycle_id=3, user=7), stamp_ns)
    inside_ns = stamp_ns - 1 if stamp_ns > 0 else stamp_ns + 1
    content = convert.to_bytes(m.Ack(cycle_id=3, user=7), inside_ns)
    assert convert.from_bytes(m.Ack, content).stamp_ns == inside_ns


@pytest.mark.parametrize('kind', KINDS)
def test_arrays_are_sent_in_c_order_whatever_their_layout(kind):
    message = random_message(kind, np.random.default_rng(0))
    fortran = {field.name: np.asfortranarray(getattr(message, field.name))
              for field in dataclasses.fields(kind) if 'dims' in field.metadata}
    sent = to_ros(dataclasses.replace(message, **fortran), STAMP)
    assert_same(message, from_ros(kind, sent))


@pytest.mark.parametrize(('field', 'dtype', 'expected'), [
    ('analog', np.float32, float), ('analog', int, float), ('analog', '>f8', float),
    ('digital', np.complex64, complex), ('digital', float, complex), ('digital', '>c16', complex)])
def test_arrays_of_other_numbers_are_converted(field, dtype, expected):
    values = np.arange(12).reshape(3, 4)
    message = dataclasses.replace(
        random_message(m.Beam, np.random.default_rng(0)), **{field: values.astype(dtype)})
    received = getattr(convert.from_bytes(m.Beam, convert.to_bytes(message, 0)), field)
    assert received.dtype == expected
    assert np.array_equal(received, values)


def test_every_message_has_a_ros_type_and_every_ros_type_a_message():
    kinds = {kind.__name__ for kind in KINDS}
    assert kinds == {kind.__name__ for kind in m.Message.__subclasses__()}
    files = {path.stem for path in FILES.glob('*.msg')}
    assert files == kinds | OTHER_TYPES
    assert files == {name for name in dir(ros) if isinstance(getattr(ros, name), type)}


@pytest.mark.parametrize(
    'path', sorted(FILES.parent.glob('*/*.[ma][sc]*')), ids=lambda path: path.name)
def test_every_field_has_a_comment(path):
    """It tells the author of another node what to fill in."""
    lines = path.read_text(encoding='utf-8').splitlines()
    fields = [line for line in lines if re.match(r'[\w/\[\]]+ +[a-z]\w*', line)]
    assert fields
    assert [line for line in fields if not re.search(r'  # \S', line)] == []


def test_no_sequence_is_bounded():
    types = [text for name in (*OTHER_TYPES, *(kind.__name__ for kind in KINDS))
             for text in getattr(ros, name).get_fields_and_field_types().values()]
    assert 'double[9]' in types
    assert not [text for text in types if re.search(r'sequence<.*,|<=|string<', text)]


@pytest.mark.parametrize('name', [path.stem for path in sorted(FILES.glob('*.msg'))])
def test_constants_are_those_of_the_enumerations(name):
    constants = re.findall(r'^uint8 (\w+)=(\d+)$', (FILES / f'{name}.msg').read_text(), re.M)
    members = [member for kind in ENUMS.get(name, ()) for member in kind]
    assert [(key, int(value)) for key, value in constants] == [
        (member.name, member.value) for member in members]
    for member in members:
        assert getattr(getattr(ros, name), member.name) == member.value


def test_every_enumeration_is_in_a_ros_type():
    listed = [kind for kinds in ENUMS.values() for kind in kinds]
    assert {kind for kind in vars(m).values()
            if isinstance(kind, type) and issubclass(kind, enum.IntEnum)
            and kind is not enum.IntEnum} == set(listed)


@pytest.mark.parametrize(('kind', 'field'), [
    (m.NoFix, 'reason'), (m.NoFix, 'codebook_id'), (m.NoFix, 'scenario_id'),
    (m.PositionEstimate, 'estimator')])
def test_a_string_without_an_encoding_is_rejected(kind, field):
    message = dataclasses.replace(
        random_message(kind, np.random.default_rng(0)), **{field: 'a\ud800b'})
    with pytest.raises(MessageError, match=(
            rf"^{kind.__name__}\.{field}: 'a\\ud800b', expected valid Unicode: surrogates")):
        convert.to_bytes(message, 0)


def test_a_type_of_a_field_without_a_codec_is_named():
    types = ros.Ack.get_fields_and_field_types() | {'user': 'float'}
    with pytest.raises(TypeError, match=r"^Ack\.user: float, expected one of \['uint8', "):
        cdr.Codec(m.Ack, types)


REAL = 'Beam.analog'
COMPLEX = 'FeedSignals.signals'


@pytest.mark.parametrize('kind', [kind for kind in KINDS if any(
    isinstance(field.default_factory, functools.partial) for field in dataclasses.fields(kind))])
def test_optional_arrays_may_be_empty(kind):
    message = random_message(kind, np.random.default_rng(0))
    empty = {field.name: field.default_factory() for field in dataclasses.fields(kind)
             if isinstance(field.default_factory, functools.partial)}
    message = dataclasses.replace(message, **empty)
    found = convert.from_bytes(kind, convert.to_bytes(message, 0, (0, '')))
    for name, array in empty.items():
        assert getattr(found, name).shape == array.shape


@pytest.mark.parametrize(('where', 'array'), [
    (COMPLEX, ros.ComplexArray(shape=[2], re=[1.0, 2.0], im=[1.0])),
    (COMPLEX, ros.ComplexArray(shape=[2], re=[1.0], im=[1.0, 2.0])),
    (COMPLEX, ros.ComplexArray(shape=[2], re=[1.0] * 3, im=[1.0] * 3)),
    (COMPLEX, ros.ComplexArray(shape=[2], im=[1.0, 2.0])),
    (COMPLEX, ros.ComplexArray(shape=[0, 3])),
    (COMPLEX, ros.ComplexArray(re=[1.0, 2.0], im=[1.0, 2.0])),
    (COMPLEX, ros.ComplexArray(shape=[1] * 200, re=[1.0], im=[1.0])),
    # One value with a shape of 16 TB, and with one beyond the address space.
    (COMPLEX, ros.ComplexArray(shape=[2**20] * 2, re=[1.0], im=[1.0])),
    (COMPLEX, ros.ComplexArray(shape=[2**32 - 1] * 2, re=[1.0], im=[1.0])),
    (REAL, ros.RealArray(shape=[3], data=[1.0] * 2)),
    (REAL, ros.RealArray(data=[1.0] * 2)),
    (REAL, ros.RealArray()),
    (REAL, ros.RealArray(shape=[2**32 - 1] * 8, data=[1.0])),
    (REAL, ros.RealArray(shape=[1] * 200, data=[1.0])),
])
def test_an_array_that_does_not_fill_its_shape_is_rejected(where, array):
    name, _, field = where.partition('.')
    kind = getattr(m, name)
    message = to_ros(random_message(kind, np.random.default_rng(0)), STAMP)
    setattr(message, field, array)
    with pytest.raises(MessageError, match=rf'^{where}: .'):
        from_ros(kind, message)


@pytest.mark.parametrize(('kind', 'field', 'number'), [
    (m.RhsConfiguration, 'mode', 2), (m.Data, 'direction', 2), (m.Data, 'stage', 255),
    (m.ProtocolState, 'phase', 5)])
def test_an_unknown_constant_is_rejected(kind, field, number):
    message = to_ros(random_message(kind, np.random.default_rng(0)), STAMP)
    setattr(message, field, number)
    with pytest.raises(MessageError, match=rf'^{kind.__name__}.{field}: {number} '):
        from_ros(kind, message)


@pytest.mark.parametrize('kind', KINDS, ids=lambda kind: kind.__name__)
def test_bytes_convert_to_the_message_or_an_error_that_names_it(kind):
    message = random_message(kind, np.random.default_rng(3))
    serialized = serialize_message(to_ros(message, STAMP))
    assert_same(message, convert.from_bytes(kind, serialized))
    for broken in (b'', serialized[:4], serialized[:-1], b'\xff' * len(serialized)):
        with pytest.raises(MessageError, match=f'{kind.__name__}'):
            m.check(convert.from_bytes(kind, broken), Scenario())


def test_a_round_trip_preserves_every_bit_of_a_codebook(shipped, small):
    assert math.isnan(small.codebook.average_crlb_m2)
    for codebook in (shipped, small.codebook):
        received = to_ros(CodebookMessage.of(codebook), STAMP)
        assert received.codebook_id == codebook.id
        assert (received.header.stamp, received.header.frame_id) == (STAMP, 'rhs_link')
        back = codebook_from_ros(received)
        assert back.id == codebook.id
        for name in ('analog', 'digital', 'average_crlb_m2'):
            assert np.array(getattr(back, name)).tobytes() == np.array(
                getattr(codebook, name)).tobytes()


def test_a_malformed_codebook_is_rejected(shipped):
    sent = to_ros(CodebookMessage.of(shipped), STAMP)
    sent.analog.data[0] = 1.5
    with pytest.raises(CodebookError, match='analog: .* expected 0 to 1'):
        codebook_from_ros(sent)
    sent.analog.data = sent.analog.data[:-1]
    with pytest.raises(MessageError, match='^CodebookMessage.analog: 799 values'):
        codebook_from_ros(sent)


def test_pose_holds_position_and_covariance():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    estimate = dataclasses.replace(
        random_message(m.PositionEstimate, rng), position=np.array([9.0, -2.0, 0.5]),
        covariance_m2=root @ root.T)
    pose = convert.pose(estimate, STAMP, Frame())
    assert (pose.header.stamp, pose.header.frame_id) == (STAMP, 'map')
    point, turn = pose.pose.pose.position, pose.pose.pose.orientation
    assert (point.x, point.y, point.z) == (9.0, -2.0, 0.5)
    assert (turn.x, turn.y, turn.z, turn.w) == (0, 0, 0, 1)
    covariance = np.reshape(pose.pose.covariance, (6, 6))
    np.testing.assert_array_equal(covariance[:3, :3], estimate.covariance_m2)
    # The variance of an angle that is uniform from -pi to pi; nothing correlates with it.
    angles = np.linspace(-math.pi, math.pi, 100_001)
    np.testing.assert_allclose(covariance[3:, 3:], np.eye(3) * np.var(angles), rtol=1e-4)
    assert not covariance[:3, 3:].any()
    assert not covariance[3:, :3].any()


@pytest.mark.parametrize(('kind', 'name', 'value'), [
    (ros.PositionEstimate, 'crlb_m2', 1), (ros.GroundTruth, 'position', Point(x=5, y=1.0)),
    (ros.ProtocolState, 'began_s', np.array([1, 2, 3, 4]))],
    ids=lambda value: getattr(value, '__name__', None))
def test_an_integer_in_a_field_for_floats_is_an_error(kind, name, value):
    """Python sends it as a number near 0, unless messages check their fields."""
    message = kind()
    # As messages do without the environment variable of the tests.
    object.__setattr__(message, f'_{name}', value)
    content = serialize_message(message)
    with pytest.raises(MessageError, match=f'{kind.__name__}.{name}: [0-9.]+e-32[34], which is '
                                           'how Python sends an integer, expected a float such'):
        convert.from_bytes(getattr(m, kind.__name__), content)


def test_small_probabilities_are_sent_as_zero(example):
    estimate = example(m.PositionEstimate, outside_probability=1e-310, blocked_probability=1e-300)
    found = convert.from_bytes(m.PositionEstimate, convert.to_bytes(estimate, 0))
    assert (found.outside_probability, found.blocked_probability) == (0.0, 1e-300)
