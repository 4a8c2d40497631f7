"""Conversion of protocol messages to and from bytes, without intermediate ROS messages.

Converting a ROS message calls a Python function for each field and nested message, which takes
longer than the transport. Publishers and raw subscriptions of rclpy therefore exchange bytes, in
the Common Data Representation (CDR), version 1, little endian.
"""

import dataclasses
import enum
import itertools
import math
import struct
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.protocol.messages import MessageError


class Type(NamedTuple):
    """The encoding of a ROS type as a series of items, whose codes are in `wire`.

    Numbers have the codes of `struct`; a string is ``s``, a sequence ``*I`` or ``*d``.
    """

    wire: tuple[str, ...]
    encode: Callable[[Any], Sequence[Any]]
    decode: Callable[[Sequence[Any]], Any]


# Smallest normal number. Python sends an integer in a field for one float as a smaller number; the
# entries of a sequence are converted.
TINY = sys.float_info.min


def check_floats(numbers: Iterable[float]) -> None:
    """Raise ValueError if one of the numbers is an integer that was sent as a float."""
    for value in numbers:
        if 0 < abs(value) < TINY:
            raise ValueError(f'{value:g}, which is how Python sends an integer, expected a float '
                             'such as 1.0')


def _flushed(value: Any) -> Any:
    """Return 0 instead of a smaller number, such as a probability, and others unchanged."""
    return 0.0 if isinstance(value, float) and 0 < abs(value) < TINY else value


def _encode_complex(array: np.ndarray) -> tuple[np.ndarray, ...]:
    # Radios often return complex64.
    flat = np.asarray(array, '<c16').ravel()
    return np.array(array.shape, '<u4'), flat.real, flat.imag


def _decode_real(items: Sequence[np.ndarray]) -> np.ndarray:
    shape, array = items
    # A copy, because the received numbers may be unaligned in memory, which slows computations.
    return array.astype(float).reshape(_shape(array, shape))


def _decode_complex(items: Sequence[np.ndarray]) -> np.ndarray:
    shape, real, imag = items
    sizes = _shape(real, shape)
    _shape(imag, shape)
    if not len(real):
        raise ValueError(f'shape {sizes}, expected at least one value')
    result = np.empty(len(real), complex)
    result.real, result.imag = real, imag
    return result.reshape(sizes)


def _shape(array: np.ndarray, shape: np.ndarray) -> list[int]:
    sizes: list[int] = shape.tolist()
    if len(array) != math.prod(sizes):
        raise ValueError(f'{len(array)} values, expected shape {sizes}')
    return sizes


def _numbers(*shape: int) -> Type:
    def decode(items: Sequence[float]) -> np.ndarray:
        check_floats(items)
        return np.array(items).reshape(shape)
    return Type(('d',) * math.prod(shape),
                lambda array: list(map(_flushed, array.ravel().tolist())), decode)


# Types that are one item on the wire.
SCALARS = {'uint8': 'B', 'uint32': 'I', 'uint64': 'Q', 'double': 'd', 'string': 's',
           'boolean': '?'}
# The other supported types.
TYPES = {
    'geometry_msgs/Point': _numbers(3),
    'geometry_msgs/Vector3': _numbers(3),
    'geometry_msgs/Quaternion': _numbers(4),
    'double[3]': _numbers(3),
    'double[4]': _numbers(4),
    'double[9]': _numbers(3, 3),
    'double[36]': _numbers(6, 6),
    'sequence<uint32>': Type(
        ('*I',), lambda array: (array.astype('<u4'),), lambda items: items[0].astype(int)),
    'rhs_isac_msgs/RealArray': Type(
        ('*I', '*d'), lambda array: (
            np.array(array.shape, '<u4'), np.asarray(array, '<f8').ravel()), _decode_real),
    'rhs_isac_msgs/ComplexArray': Type(('*I', '*d', '*d'), _encode_complex, _decode_complex),
}


# Representation identifier of CDR version 1, little endian, and two bytes of options.
HEADER = b'\0\1\0\0'
_NANOSECONDS = 10**9
# The seconds of a stamp have 32 bits.
_END_S = 2**31
_NONE = np.empty(0)
# Position of the frame in a message, which follows the stamp.
_FRAME = len(HEADER) + 8
_SIZES = {'?': 1, 'B': 1, 'i': 4, 'I': 4, 'Q': 8, 'd': 8}


def frame_of(data: bytes) -> str:
    """Return the frame in the header of a message that has been decoded."""
    size, = struct.unpack_from('<I', data, _FRAME)
    return data[_FRAME + 4:_FRAME + 4 + size].removesuffix(b'\0').decode()


class _Run(NamedTuple):
    """Numbers of fixed size, followed by a string or a sequence with the code `tail`.

    `layouts` contains the layout of the numbers, and of the size of the tail, for each position in
    the message modulo 8. The last run has no tail: its `tail` is empty.
    """

    layouts: tuple[struct.Struct, ...]
    n_items: int
    tail: str


class _Field(NamedTuple):
    """A field of a message, and the range of its items on the wire.

    A field of a type in `SCALARS` has no `encode`; its `decode`, if any, converts an enumeration.
    """

    name: str
    first: int
    last: int
    encode: Callable[[Any], Sequence[Any]] | None
    decode: Callable[[Any], Any] | None


class Codec:
    """Encodes and decodes one class of messages.

    `kind` is a dataclass with the fields of the ROS type except the header, and with ``stamp_ns``
    if it keeps the stamp of the header; `types` is what ``get_fields_and_field_types`` of the ROS
    type returns. Raises TypeError if the type of a field is not supported.
    """

    def __init__(self, kind: type[Any], types: dict[str, str]) -> None:
        self._kind, self._types = kind, types
        own = {field.name: field.type for field in dataclasses.fields(kind)}
        self._keeps_stamp = 'stamp_ns' in own
        enums = {name: one for name, one in own.items()
                 if isinstance(one, type) and issubclass(one, enum.IntEnum)}
        # The stamp and the frame of the header.
        wire = ['i', 'I', 's']
        fields = []
        for name, text in types.items():
            if name == 'header':
                continue
            first = len(wire)
            if text in TYPES:
                one = TYPES[text]
                wire += one.wire
                fields.append(_Field(name, first, len(wire), one.encode, one.decode))
            elif text in SCALARS:
                wire.append(SCALARS[text])
                fields.append(_Field(name, first, first + 1, None, enums.get(name)))
            else:
                raise TypeError(f'{kind.__name__}.{name}: {text}, expected one of '
                                f'{[*SCALARS, *TYPES]}')
        self._fields, self._runs = tuple(fields), tuple(_runs(wire))

    def encode(
            self, message: Any, frame: str, stamp_ns: int, sender: int, scenario_id: str) -> bytes:
        """Return the bytes of a message, with the given header, sender and scenario id.

        Raises MessageError if a string has no UTF-8 encoding, or the stamp is out of range.
        """
        seconds, nanoseconds = divmod(stamp_ns, _NANOSECONDS)
        # A stamp may be that of another program, plus a duration.
        if not -_END_S <= seconds < _END_S:
            raise MessageError(f'{self._kind.__name__}.header: stamp of {seconds} s, expected '
                               f'{-_END_S} to {_END_S - 1}')
        items: list[Any] = [seconds, nanoseconds, frame]
        for name, _, _, encode, _ in self._fields:
            value = getattr(message, name)
            if encode is not None:
                items += encode(value)
            elif name == 'sender':
                items.append(sender)
            elif name == 'scenario_id':
                items.append(scenario_id)
            else:
                items.append(_flushed(value))
        return self._packed(items)

    def _packed(self, items: Sequence[Any]) -> bytes:
        pieces = [HEADER]
        position, first = len(HEADER), 0
        for layouts, n_items, tail in self._runs:
            layout, last = layouts[position & 7], first + n_items
            position += layout.size
            if not tail:
                pieces.append(layout.pack(*items[first:last]))
                break
            content = items[last]
            if tail == 's':
                content = self._encode_string(content, last) + b'\0'
                pieces += layout.pack(*items[first:last], len(content)), content
            else:
                pieces.append(layout.pack(*items[first:last], len(content)))
                padding = _padding(position) if tail == '*d' and len(content) else 0
                content = bytes(padding) + content.tobytes()
                pieces.append(content)
            position += len(content)
            first = last + 1
        return b''.join(pieces)

    def _encode_string(self, text: str, position: int) -> bytes:
        try:
            return text.encode()
        except UnicodeEncodeError as error:
            name = next(
                (field.name for field in self._fields if field.first == position), 'header')
            raise MessageError(f'{self._kind.__name__}.{name}: {text!r}, expected valid Unicode: '
                               f'{error.reason}') from None

    def decode(self, data: bytes) -> Any:
        """Decode a message; its arrays are copies.

        Raises MessageError if the bytes have another encoding or end too early, a string is not
        UTF-8, an array has the wrong number of values, or the stamp or the value of an enumeration
        is invalid.
        """
        # The options do not affect the encoding.
        if not data.startswith(HEADER[:2]):
            raise MessageError(f'{self._kind.__name__}: CDR data with the representation '
                               f'{data[:2].hex()}, expected {HEADER[:2].hex()}')
        try:
            items = self._items(data)
        except (struct.error, ValueError) as error:
            raise MessageError(f'{self._kind.__name__}: invalid CDR data of {len(data)} bytes: '
                               f'{error}') from None
        fields: dict[str, Any] = {}
        if self._keeps_stamp:
            # A larger number could put the seconds out of range when the stamp is forwarded.
            if items[1] >= _NANOSECONDS:
                raise MessageError(f'{self._kind.__name__}.header: stamp with {items[1]} ns, '
                                   f'expected less than {_NANOSECONDS}')
            fields['stamp_ns'] = _NANOSECONDS * items[0] + items[1]
        for name, first, last, encode, decode in self._fields:
            try:
                if decode is None:
                    fields[name] = value = items[first]
                    if isinstance(value, float):
                        check_floats((value,))
                    continue
                fields[name] = decode(items[first] if encode is None else items[first:last])
            except ValueError as error:
                raise MessageError(f'{self._kind.__name__}.{name}: {error}') from None
        # Unlike the constructor, this does not store each field of a frozen dataclass separately.
        message = object.__new__(self._kind)
        vars(message).update(fields)
        return message

    def extension(self, n_fields: int) -> Callable[[bytes], bytes] | None:
        """Return a function that adds the fields after the first `n_fields` to a message.

        The header is the first field. The function takes and returns bytes, and returns those that
        are no message unchanged. The added fields have the defaults of the dataclass; if one of
        them has none, there is no function.
        """
        earlier = Codec(self._kind, dict(itertools.islice(self._types.items(), n_fields)))
        defaults = {field.name: _default(field) for field in dataclasses.fields(self._kind)}
        added: list[Any] = []
        for name, _, _, encode, _ in self._fields[len(earlier._fields):]:
            if defaults[name] is dataclasses.MISSING:
                return None
            added += [defaults[name]] if encode is None else encode(defaults[name])

        def extend(data: bytes) -> bytes:
            if not data.startswith(HEADER[:2]):
                return data
            try:
                items = earlier._items(data)
            except (struct.error, ValueError):
                return data
            return self._packed([*items, *added])
        return extend

    def _items(self, data: bytes) -> list[Any]:
        items: list[Any] = []
        position = len(HEADER)
        for layouts, _, tail in self._runs:
            layout = layouts[position & 7]
            items += layout.unpack_from(data, position)
            position += layout.size
            if not tail:
                break
            size = items.pop()
            if tail == 's':
                content = data[position:position + size]
                if len(content) < size:
                    raise ValueError(f'string of {size} bytes')
                items.append(content.removesuffix(b'\0').decode())
                position += size
            elif tail == '*I':
                items.append(np.frombuffer(data, '<u4', size, position) if size else _NONE)
                position += 4 * size
            elif size:
                position += _padding(position)
                items.append(np.frombuffer(data, '<f8', size, position))
                position += 8 * size
            else:
                items.append(_NONE)
        return items


def _default(field: Any) -> Any:
    """Return the default of a field of a dataclass, or `dataclasses.MISSING`."""
    return (field.default if field.default_factory is dataclasses.MISSING
            else field.default_factory())


def _runs(wire: Sequence[str]) -> list[_Run]:
    runs, numbers = [], ''
    for one in [*wire, '']:
        if one in _SIZES:
            numbers += one
            continue
        # A string or a sequence starts with its size.
        written = numbers + 'I' if one else numbers
        runs.append(_Run(tuple(_layout(written, start) for start in range(8)), len(numbers), one))
        numbers = ''
    return runs


def _layout(numbers: str, start: int) -> struct.Struct:
    """Return the layout of numbers that begin at `start`, each aligned to its size."""
    text, position = '<', start
    for number in numbers:
        padding = (len(HEADER) - position) % _SIZES[number]
        text += f'{padding}x{number}'
        position += padding + _SIZES[number]
    return struct.Struct(text)


def _padding(position: int) -> int:
    """Return the number of padding bytes between a position and an eight-byte number."""
    return (len(HEADER) - position) % 8
