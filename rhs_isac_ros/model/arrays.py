"""Array operations that several parts of the package use."""

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
    """Normalise weights, given as logarithms, over `axis`; return them and the log of the sum."""
    highest = log_weights.max(axis=axis, keepdims=True)
    weights = np.exp(log_weights - highest)
    total = weights.sum(axis=axis, keepdims=True)
    return weights / total, np.squeeze(highest + np.log(total), axis=axis)


def blocks(n: int, size: int) -> list[slice]:
    """Return slices that split n items into blocks of the given size; the last may be smaller."""
    return [slice(start, start + size) for start in range(0, n, size)]


@functools.cache
def gauss_legendre(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the n nodes and weights of Gauss-Legendre quadrature from -1 to 1, read-only."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return read_only(nodes), read_only(weights)


def digest(*arrays: np.ndarray) -> str:
    """Return 16 hexadecimal digits that identify the bytes of little-endian arrays."""
    return hashlib.sha256(b''.join(array.tobytes() for array in arrays)).hexdigest()[:16]


def check_arrays(owner: Any, shapes: Mapping[str, tuple[int, ...]],
                 error: type[ValueError] = ValueError) -> None:
    """Raise `error` unless `owner` has finite attributes with the names and shapes in `shapes`."""
    for name, shape in shapes.items():
        array = getattr(owner, name)
        if np.shape(array) != shape:
            raise error(f'{name}: shape {np.shape(array)}, expected {shape}')
        if not np.isfinite(array).all():
            raise error(f'{name}: not finite, expected finite numbers')
