"""Other ways to convert messages of the protocol to bytes than the codec of the network.

``python -m parts.serializers NAME PROGRAM [ARGUMENT ...]`` runs a program with one of them.
"""

import dataclasses
import functools
import math
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from ament_index_python.packages import get_package_share_directory
from rclpy.serialization import deserialize_message, serialize_message

from rhs_isac_ros.protocol.messages import MessageError
from rhs_isac_ros.ros import convert

_NANOSECONDS = 10**9
_ARRAYS = {'rhs_isac_msgs/RealArray': ('data',), 'rhs_isac_msgs/ComplexArray': ('re', 'im')}
_VECTORS = ('geometry_msgs/Point', 'geometry_msgs/Vector3')


class Serializer:
    """Converts messages by way of the objects of a library, which have the fields in ROS.

    Parameters
    ----------
    make
        Creates an object of a type in ROS, such as ``rhs_isac_msgs/msg/Ack``, with any content.
    write, read
        Convert an object to bytes, and bytes to an object of a type in ROS.
    to_array
        Converts an array of NumPy, of numbers of 4 or 8 bytes, for a field.
    """

    def __init__(
            self, make: Callable[[str], Any], write: Callable[[Any, str], bytes],
            read: Callable[[bytes, str], Any], to_array: Callable[[np.ndarray], Any]) -> None:
        self._make, self._write, self._read, self._to_array = make, write, read, to_array

    def to_bytes(
            self, message: Any, stamp_ns: int, identity: tuple[int, str] | None = None,
            frame: str = convert.RHS_FRAME) -> bytes:
        """Replace `convert.to_bytes`."""
        name, fields = _described(type(message))
        found = self._make(name)
        found.header.stamp.sec, found.header.stamp.nanosec = divmod(stamp_ns, _NANOSECONDS)
        found.header.frame_id = frame
        for field, kind, own in fields:
            value = getattr(message, field)
            if kind in _VECTORS:
                target = getattr(found, field)
                target.x, target.y, target.z = value.tolist()
            elif kind in _ARRAYS:
                self._fill(getattr(found, field), value, len(_ARRAYS[kind]) == 2)
            elif isinstance(value, np.ndarray):
                setattr(found, field, self._to_array(value.astype('u4')) if 'seq' in kind
                        else value.ravel())
            else:
                setattr(found, field, own(value))
        if identity:
            found.sender, found.scenario_id = identity
        return self._write(found, name)

    def _fill(self, target: Any, value: np.ndarray, is_complex: bool) -> None:
        target.shape = self._to_array(np.array(value.shape, 'u4'))
        flat = value.ravel()
        if is_complex:
            target.re, target.im = self._to_array(flat.real), self._to_array(flat.imag)
        else:
            target.data = self._to_array(flat)

    def from_bytes(self, kind: type, content: bytes) -> Any:
        """Replace `convert.from_bytes`."""
        name, fields = _described(kind)
        try:
            found = self._read(content, name)
            values = {field: _value(getattr(found, field), ros, own)
                      for field, ros, own in fields}
        # Each library has errors of its own.
        except Exception as error:
            raise MessageError(f'{kind.__name__}: {error}') from None
        if 'stamp_ns' in kind.__dataclass_fields__:
            stamp = found.header.stamp
            values['stamp_ns'] = _NANOSECONDS * stamp.sec + stamp.nanosec
        message = object.__new__(kind)
        vars(message).update(values)
        return message


def _value(value: Any, ros: str, own: type) -> Any:
    if ros in _VECTORS:
        return np.array([value.x, value.y, value.z])
    if ros in _ARRAYS:
        parts = [np.array(getattr(value, name)) for name in _ARRAYS[ros]]
        if {len(part) for part in parts} != {math.prod(value.shape)}:
            raise ValueError('an array that does not fill its shape')
        result = parts[0]
        if len(parts) == 2:
            result = np.empty(len(parts[0]), complex)
            result.real, result.imag = parts
        return result.reshape(tuple(value.shape))
    if own is np.ndarray:
        return np.array(value, int if 'seq' in ros else float).reshape(
            (3, 3) if ros == 'double[9]' else -1)
    return own(value)


@functools.cache
def _described(kind: type) -> tuple[str, list[tuple[str, str, type]]]:
    """Return the type in ROS, and each field with its type in ROS and in the dataclass."""
    ros = convert.ros_type(kind)
    own = {field.name: field.type for field in dataclasses.fields(kind)}
    return f'rhs_isac_msgs/msg/{ros.__name__}', [
        (name, text, own[name]) for name, text in ros.get_fields_and_field_types().items()
        if name != 'header']


def _rclpy() -> Serializer:
    kinds = {_described(kind)[0]: convert.ros_type(kind) for kind in convert._ROS_TYPES}
    # From bytes, because the setters of ROS messages copy other sequences number by number.
    return Serializer(
        lambda name: kinds[name](), lambda found, name: serialize_message(found),
        lambda content, name: deserialize_message(content, kinds[name]), np.ndarray.tobytes)


def _rosbags() -> Serializer:
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, types = get_typestore(Stores.ROS2_JAZZY), {}
    for path in (Path(get_package_share_directory('rhs_isac_msgs')) / 'msg').glob('*.msg'):
        types |= get_types_from_msg(
            path.read_text(encoding='utf-8'), f'rhs_isac_msgs/msg/{path.stem}')
    store.register(types)

    def make(name: str) -> Any:
        return store.types[name](**{
            field: make(detail) if node is Nodetype.NAME else None
            for field, (node, detail) in store.get_msgdef(name).fields})
    return Serializer(
        make, lambda found, name: bytes(store.serialize_cdr(found, name)),
        store.deserialize_cdr, np.ascontiguousarray)


SERIALIZERS = {'rclpy': _rclpy, 'rosbags': _rosbags}


def main() -> None:
    """Run a program with the serializer that the first argument names."""
    serializer = SERIALIZERS[sys.argv[1]]()
    convert.to_bytes, convert.from_bytes = serializer.to_bytes, serializer.from_bytes
    sys.argv = sys.argv[2:]
    runpy.run_path(sys.argv[0], run_name='__main__')


if __name__ == '__main__':
    main()
