"""Array operations that several parts of the package use."""

import functools
import hashlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

# Largest coordinate of a position [m]; sums of squares of larger ones lose all digits of others.
_MAX_COORDINATE_M = 1e12
# Relative difference of values that are equal up to rounding.
_TIE = 1e-6
# For each axis, the two that follow it.
_SECOND, _THIRD = [1, 2, 0], [2, 0, 1]


def read_only(array: np.ndarray) -> np.ndarray:
    """Make an array read-only and return it."""
    array.flags.writeable = False
    return array


def adjoint(matrices: np.ndarray) -> np.ndarray:
    """Return the conjugate transposes of matrices [..., n, m]."""
    return np.conj(np.swapaxes(matrices, -2, -1))


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors [..., 3].

    Those of a few hundred vectors take a fifth of the time of `numpy.cross`.
    """
    return a[..., _SECOND] * b[..., _THIRD] - a[..., _THIRD] * b[..., _SECOND]


def multiply_rows(matrices: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Multiply rows ``[..., *B, n]`` by matrices ``[*B, m, n]``; return ``[..., *B, m]``.

    A row is rounded in the same way among any number of other rows.
    """
    # BLAS rounds by the sizes of a product, so each row has a product of its own.
    return np.matmul(matrices, rows[..., None])[..., 0]


def evenly_spread(n: int) -> np.ndarray:
    """Return numbers between 0 and 1 of which any part is evenly spread, float64 [n]."""
    # Multiples of the golden ratio, modulo 1.
    return (np.arange(n) + 0.5) * 0.6180339887498949 % 1


def mixture_weights(log_weights: np.ndarray, axis: int | tuple[int, ...] = -1
                    ) -> tuple[np.ndarray, np.ndarray]:
    """Normalise weights, given as logarithms, over `axis`; return them and the log of the sum."""
    highest = log_weights.max(axis=axis, keepdims=True)
    weights = np.exp(log_weights - highest)
    total = weights.sum(axis=axis, keepdims=True)
    return weights / total, np.squeeze(highest + np.log(total), axis=axis)


def n_sufficient(log_weights: Sequence[float] | np.ndarray, left_out: float) -> int:
    """Return how many weights, [W] in descending order, have all but a share of their sum."""
    weights, _ = mixture_weights(np.asarray(log_weights))
    return 1 + int(np.count_nonzero(1 - np.cumsum(weights) > left_out))


def log_sum(values: np.ndarray) -> float:
    """Return the logarithm of the sum of exponentials."""
    highest = float(values.max())
    if np.isneginf(highest):
        return highest
    return highest + float(np.log(np.sum(np.exp(values - highest))))


def marked(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column of each element that is set in a mask [R, C], row by row.

    Those of a large mask take a quarter of the time of `numpy.nonzero`.
    """
    (places,) = mask.ravel().nonzero()
    return np.divmod(places, mask.shape[1])


def untied(values: np.ndarray) -> np.ndarray:
    """Raise values [..., K] so little that only the order of equal ones along K is affected.

    The first of them is then the smallest. Otherwise, rounding would decide, and thus the
    processor.
    """
    return values + np.abs(values) * (_TIE * np.arange(values.shape[-1]))


def blocks(n: int, size: int) -> list[slice]:
    """Return slices that split n items into blocks of the given size; the last may be smaller."""
    return [slice(start, start + size) for start in range(0, n, size)]


@functools.cache
def gauss_legendre(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the n nodes and weights of Gauss-Legendre quadrature from -1 to 1, read-only."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return read_only(nodes), read_only(weights)


def digest(*arrays: np.ndarray) -> str:
    """Return 16 hexadecimal digits that identify the bytes of arrays, in little-endian order."""
    return hashlib.sha256(b''.join(array.astype(array.dtype.newbyteorder('<')).tobytes()
                                   for array in arrays)).hexdigest()[:16]


def to_tuples(entry: Any) -> Any:
    """Return nested lists as tuples, which are hashable."""
    return tuple(map(to_tuples, entry)) if isinstance(entry, list) else entry


def all_finite(values: np.ndarray) -> bool:
    """Return whether all numbers are finite."""
    # The sum of the squares is, in one operation, unless a number is not finite or is enormous.
    return values.dtype.kind in 'fc' and bool(np.isfinite(np.vdot(values, values))) or bool(
        np.isfinite(values).all())


def numbers(name: str, value: ArrayLike, kind: type | None = float,
            error: type[ValueError] = ValueError, *, shapes: Sequence[tuple[int | str, ...]] = (),
            finite: bool = True) -> np.ndarray:
    """Convert numbers to an array of `kind`: float, complex or int; else raise `error`.

    Without a kind, the array is complex if the numbers are, else float.

    NumPy drops masks and some imaginary parts, and converts text and objects, without an error.
    If `shapes` are given, the array must have one of them. In a shape, a text stands for any size,
    and ``'...'`` at the beginning for any number of axes. If `finite` is set, all numbers must be
    finite.
    """
    kinds = (kind,) if kind else (float, complex)
    array = value if type(value) is np.ndarray and value.dtype in kinds and all_finite(
        value) else _converted(name, value, kind, error, _listed(shapes), finite)
    if shapes and not any(_fits(array.shape, shape) for shape in shapes):
        raise error(f'{name}: shape {array.shape}, expected {_listed(shapes)}')
    return array


def _listed(shapes: Sequence[tuple[int | str, ...]]) -> str:
    return ' or '.join(
        f'[{", ".join(map(str, shape))}]' if shape else 'a number' for shape in shapes)


def _fits(sizes: tuple[int, ...], shape: tuple[int | str, ...]) -> bool:
    if shape[:1] == ('...',):
        sizes, shape = sizes[max(len(sizes) + 1 - len(shape), 0):], shape[1:]
    return len(sizes) == len(shape) and all(
        expected == size or isinstance(expected, str)
        for size, expected in zip(sizes, shape, strict=True))


def _converted(name: str, value: ArrayLike, kind: type | None, error: type[ValueError],
               shape: str, finite: bool) -> np.ndarray:
    expected = f'expected numbers {shape}'.rstrip()
    if is_masked(value):
        raise error(f'{name}: a masked array, {expected} without a mask')
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as problem:
        raise error(f'{name}: {problem}, {expected}') from None
    kind = kind or (complex if array.dtype.kind == 'c' else float)
    if array.dtype.kind == 'c' and kind is not complex:
        raise error(f'{name}: complex numbers, expected real numbers {shape}'.rstrip())
    if array.dtype.kind not in 'bifuc':
        raise error(f'{name}: {array.ravel()[:1].tolist()} of type {array.dtype}, {expected}')
    if (finite or kind is int) and not all_finite(array):
        raise error(f'{name}: not finite, expected finite numbers')
    if kind is int and (broken := array[array != np.round(array)]).size:
        raise error(f'{name}: {broken[0]:g}, expected integers')
    return array.astype(kind, copy=False)


def is_masked(value: object) -> bool:
    """Return whether a value, or an entry of a list, is an array with a mask."""
    # Nothing else needs the module of these arrays, which takes 20 ms to load.
    kind = getattr(sys.modules.get('numpy.ma'), 'MaskedArray', None)
    return kind is not None and (isinstance(value, kind) or (
        isinstance(value, list | tuple) and any(map(is_masked, value))))


def position_problem(positions: np.ndarray) -> str:
    """Describe why finite positions [..., 3] [m] are not in front of the surface, or return ''."""
    if positions.size and not positions[..., 0].min() > 0:
        return (f'x = {positions[..., 0].min():g} m, expected x > 0, in front of the surface, '
                'which lies in the plane x = 0')
    # The norm, in one operation, is at least as large as each coordinate.
    if np.vdot(positions, positions) > _MAX_COORDINATE_M**2 and (
            np.abs(positions).max() > _MAX_COORDINATE_M):
        return (f'{np.abs(positions).max():g} m, expected coordinates up to '
                f'{_MAX_COORDINATE_M:g} m')
    return ''


def checked_positions(positions: ArrayLike) -> np.ndarray:
    """Return positions in front of the surface as float64 [N, 3] [m], or raise ValueError."""
    return _checked('positions', positions, ('N', 3))


def checked_states(states: ArrayLike) -> np.ndarray:
    """Return positions, or positions and velocities, as float64 [N, 3] or [N, 6] [m, m/s].

    Raises ValueError as `checked_positions`, and if a velocity is not finite.
    """
    return _checked('positions', states, ('N', 3), ('N', 6))


def checked_bounds(bounds_m: ArrayLike) -> np.ndarray:
    """Return the lower and the upper corner of a box, float64 [2, 3] [m], or raise ValueError."""
    array = numbers('bounds_m', bounds_m, shapes=[(2, 3)])
    if (array[0] > array[1]).any():
        raise ValueError(f'bounds_m: {array.tolist()}, expected the lower and the upper corner of '
                         'a box, [2, 3]')
    return array


def log_size(bounds_m: np.ndarray, least_m: float = 0.0) -> float:
    """Return the logarithm of the volume of a box with corners [2, 3] [m].

    Without an extent along an axis, it is that of the area or the length. Extents below `least_m`
    count as this one.
    """
    size = np.maximum(np.ptp(bounds_m, axis=0), least_m)
    return float(np.log(size[size > 0]).sum())


def checked_position(position: ArrayLike, name: str = 'position') -> np.ndarray:
    """Return a position in front of the surface as float64 [3] [m], or raise ValueError."""
    return _checked(name, position, (3,))


def _checked(name: str, value: ArrayLike, *shapes: tuple[int | str, ...]) -> np.ndarray:
    array = numbers(name, value, shapes=shapes)
    if problem := position_problem(array[..., :3]):
        raise ValueError(f'{name}: {problem}')
    return array


def check_arrays(owner: Any, shapes: Mapping[str, tuple[int, ...]],
                 error: type[ValueError] = ValueError) -> None:
    """Raise `error` unless `owner` has finite attributes with the names and shapes in `shapes`."""
    for name, shape in shapes.items():
        numbers(name, getattr(owner, name), complex, error, shapes=[shape])
