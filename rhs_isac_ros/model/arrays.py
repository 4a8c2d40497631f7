"""Array operations that all parts of the model use."""

import functools
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np


def read_only(array: np.ndarray) -> np.ndarray:
    """Make an array read-only and return it."""
    array.flags.writeable = False
    return array


def adjoint(matrices: np.ndarray) -> np.ndarray:
    """Return the conjugate transposes of matrices [..., n, m]."""
    return np.conj(np.swapaxes(matrices, -2, -1))


def mixture_weights(log_weights: np.ndarray, axis: int | tuple[int, ...] = -1
                    ) -> tuple[np.ndarray, np.ndarray]:
    """Normalise weights given as logarithms; return them and the log of their original sum."""
    highest = log_weights.max(axis=axis, keepdims=True)
    weights = np.exp(log_weights - highest)
    total = weights.sum(axis=axis, keepdims=True)
    return weights / total, np.squeeze(highest + np.log(total), axis=axis)


def blocks(n: int, size: int) -> list[slice]:
    """Split n items into blocks of the given size; the last one may be smaller."""
    return [slice(start, start + size) for start in range(0, n, size)]


@functools.cache
def gauss_legendre(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and weights of Gauss-Legendre quadrature from -1 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return read_only(nodes), read_only(weights)


def digest(*arrays: np.ndarray) -> str:
    """Return 16 hexadecimal digits that identify the bytes of little-endian arrays."""
    return hashlib.sha256(b''.join(array.tobytes() for array in arrays)).hexdigest()[:16]


def check_arrays(owner: Any, shapes: Mapping[str, tuple[int, ...]],
                 error: type[ValueError] = ValueError) -> None:
    """Raise `error` unless the attributes in `shapes` are finite and have the given shapes."""
    for name, shape in shapes.items():
        array = getattr(owner, name)
        if np.shape(array) != shape:
            raise error(f'{name}: shape {np.shape(array)}, expected {shape}')
        if not np.isfinite(array).all():
            raise error(f'{name}: not finite, expected finite numbers')
