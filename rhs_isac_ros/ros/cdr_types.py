"""How the types of ROS messages are encoded in the common data representation."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np


class Type(NamedTuple):
    """How a type of ROS is encoded.

    Attributes
    ----------
    wire
        Characters of `struct` for numbers, ``s`` for a string, ``*I`` and ``*d`` for sequences.
    encode, decode
        From a value to its items on the wire, and back.
    """

    wire: tuple[str, ...]
    encode: Callable[[Any], Sequence[Any]]
    decode: Callable[[Sequence[Any]], Any]


_REAL, _COMPLEX = np.dtype('<f8'), np.dtype('<c16')


def _encode_real(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.array(values.shape, '<u4'), np.asarray(values, _REAL).ravel()


def _encode_complex(values: np.ndarray) -> tuple[np.ndarray, ...]:
    # Radios often return complex64.
    flat = np.asarray(values, _COMPLEX).ravel()
    return np.array(values.shape, '<u4'), flat.real, flat.imag


def _decode_real(items: Sequence[np.ndarray]) -> np.ndarray:
    shape, values = items
    # The numbers are not aligned in memory, so that computations with them would be slow.
    return values.astype(float).reshape(_shape(values, shape))


def _decode_complex(items: Sequence[np.ndarray]) -> np.ndarray:
    shape, real, imag = items
    sizes = _shape(real, shape)
    _shape(imag, shape)
    result = np.empty(len(real), complex)
    result.real, result.imag = real, imag
    return result.reshape(sizes)


def _shape(values: np.ndarray, shape: np.ndarray) -> list[int]:
    sizes: list[int] = shape.tolist()
    if len(values) != math.prod(sizes) or not len(values):
        raise ValueError(
            f'{len(values)} values, expected shape {sizes} with at least one value')
    return sizes


def _numbers(n: int) -> Type:
    return Type(('d',) * n, lambda values: values.ravel().tolist(), np.array)


def _encode_integers(values: np.ndarray) -> tuple[np.ndarray]:
    return (values.astype('<u4'),)


def _decode_integers(items: Sequence[np.ndarray]) -> np.ndarray:
    return items[0].astype(int)


# Types of one item on the wire.
SCALARS = {'uint8': 'B', 'uint32': 'I', 'uint64': 'Q', 'double': 'd', 'string': 's'}
# The other types.
TYPES = {
    'geometry_msgs/Point': _numbers(3),
    'geometry_msgs/Vector3': _numbers(3),
    'double[3]': _numbers(3),
    'double[4]': _numbers(4),
    'double[9]': _numbers(9)._replace(decode=lambda items: np.array(items).reshape(3, 3)),
    'sequence<uint32>': Type(('*I',), _encode_integers, _decode_integers),
    'rhs_isac_msgs/RealArray': Type(('*I', '*d'), _encode_real, _decode_real),
    'rhs_isac_msgs/ComplexArray': Type(('*I', '*d', '*d'), _encode_complex, _decode_complex),
}
