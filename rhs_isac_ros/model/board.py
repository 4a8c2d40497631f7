"""The board: how the tunings of the elements determine the transfer from elements to feeds.

A tuning is a number in [0, 1], which a configuration contains for each element. A board maps the
tunings of a frame to a complex transfer at each frequency, and pulls gradients back. Its other
methods derive from these two. Arrays have the axes [band B, sub-band J, frame Q, element N_E,
feed K].

What is known about single elements is their response: the factor ``slope`` of the part of the
transfer that depends on the tuning, and the factor ``offset`` of the propagation alone.
"""

import abc
import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable
from typing import Any, ClassVar, TypeAlias

import numpy as np

from rhs_isac_ros.model.arrays import adjoint, numbers
from rhs_isac_ros.model.constants import SPEED_OF_LIGHT_MPS
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import Field
from rhs_isac_ros.support.plugins import PluginError, calling

# Number of tunings among which a focused beam chooses if tunings are continuous.
_N_TUNINGS = 65
# A number for all elements, or an array [N_E].
Factor: TypeAlias = np.ndarray | complex


class BoardError(PluginError):
    """A board is unknown or invalid, or does not support what a caller needs."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ports:
    """What a transfer depends on apart from the tunings."""

    bands: tuple[int, ...]  #: Indices of the bands.
    frequencies_hz: np.ndarray  #: Frequencies of the sub-bands, float64 [B, J].
    elements_m: np.ndarray  #: Positions of the elements, float64 [N_E, 3].
    feeds_m: np.ndarray  #: Positions of the feeds, float64 [K, 3].
    refractive_index: float


def onboard_gain(
        refractive_index: float, frequency_hz: float | np.ndarray, source: np.ndarray,
        sink: np.ndarray) -> np.ndarray:
    """Implements Eq. (6). Propagation kappa on the board between two points, complex128.

    Frequencies [Hz] and positions, float64 [..., 3] [m], may have any shapes that broadcast.
    """
    distance = np.linalg.norm(sink - source, axis=-1)
    wavenumber = 2 * np.pi * refractive_index * frequency_hz / SPEED_OF_LIGHT_MPS
    return np.exp(-1j * wavenumber * distance)


class Board(abc.ABC):
    """The elements, feeds and propagation of a surface.

    A subclass defines `kind`, `transfer` and `pullback`. A subclass that is not a dataclass of
    plain values also defines `id`.
    """

    kind: str  #: Name in a scenario file.
    #: Whether the coefficient of an element is its tuning, apart from a constant factor.
    is_amplitude: ClassVar[bool] = False

    def __init_subclass__(cls, **options: Any) -> None:
        """Check the results of all methods of `Board` that a class outside of this package has."""
        super().__init_subclass__(**options)
        if cls.__module__.partition('.')[0] != __name__.partition('.')[0]:
            for name in _RESULTS.keys() & vars(cls).keys():
                setattr(cls, name, _checked(name, vars(cls)[name]))

    def __post_init__(self) -> None:
        """Convert the fields declared with `limited`; raise BoardError if one is out of range."""
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value, limits = getattr(self, field.name), field.metadata.get('limits')
            if limits is None or value is None and field.default is None:
                continue
            with translated(ValueError, BoardError):
                if not field.metadata['is_list']:
                    value = limits.checked(field.name, value)
                elif not isinstance(value, list | tuple | np.ndarray):
                    raise BoardError(f'{field.name}: {value!r}, expected a list of numbers')
                else:
                    value = tuple(limits.checked(field.name, entry) for entry in value)
            object.__setattr__(self, field.name, value)

    @property
    def is_affine(self) -> bool:
        """Whether coefficients are affine in the tunings, and the same in all of a band."""
        return self.is_amplitude

    @abc.abstractmethod
    def transfer(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return the transfer, complex128 [B, J, Q, N_E, K], for tunings [B, Q, N_E]."""

    @abc.abstractmethod
    def pullback(
            self, ports: Ports, tunings: np.ndarray, by_transfer: np.ndarray) -> np.ndarray:
        """Return the gradient by the tunings, float64 [B, Q, N_E].

        Takes the gradient d/dRe + i d/dIm by the transfer, complex128 [B, J, Q, N_E, K].
        """

    def misfit(self, scenario: Any) -> str:
        """Return the reason why the board does not fit a scenario, or '' if it fits."""
        if scenario.failed_element_share and not self.is_amplitude:
            return (f'{self.kind!r} with failed_element_share = '
                    f'{scenario.failed_element_share:g}, expected 0: failed elements are '
                    "described by an amplitude, as those of the board 'paper'")
        return ''

    def implied(self, name: str, scenario: Any) -> Any:
        """Return what a field with the value None stands for, or None if it is no number."""
        return None

    @functools.cached_property
    def plain(self) -> str | dict[str, Any]:
        """The value that `board_of` converts to an equal board."""
        fields: tuple[dataclasses.Field[Any], ...] = (
            dataclasses.fields(self) if dataclasses.is_dataclass(self) else ())
        changed = {field.name: _lists(getattr(self, field.name)) for field in fields
                   if getattr(self, field.name) != field.default}
        return {'kind': self.kind, **changed} if changed else self.kind

    @property
    def declared(self) -> str:
        """The kind of the board, or '' for the default."""
        return '' if self.plain == 'paper' else self.kind

    @functools.cached_property
    def id(self) -> str:
        """Hash of the board, 16 hexadecimal digits, the same in all processes."""
        return hashlib.sha256(json.dumps(self.plain).encode()).hexdigest()[:16]

    def __eq__(self, other: object) -> bool:
        """Return whether both are the same board."""
        return type(self) is type(other) and self.id == getattr(other, 'id', None)

    def __hash__(self) -> int:
        """Return a hash of the board."""
        return hash(self.id)

    def paths(self, ports: Ports) -> np.ndarray:
        """Return the propagation B_j of elements without a coupling, complex128 [B, J, K, N_E].

        Raises BoardError if elements have no coefficients of their own.
        """
        raise BoardError(f'board: {self.kind!r} couples its elements, expected a board whose '
                         'elements have coefficients of their own')

    def coefficients(self, ports: Ports, tunings: np.ndarray) -> np.ndarray:
        """Return the coefficients of elements without a coupling, complex [B, 1 or J, Q, N_E]."""
        return self.paths(ports)

    def channels(self, ports: Ports, tunings: np.ndarray, slope: Factor = 1.0,
                 offset: Factor = 0.0) -> np.ndarray:
        """Return the transfer of elements with a response, complex128 [B, J, Q, K, N_E]."""
        channels = slope * np.swapaxes(self.transfer(ports, tunings), -2, -1)
        return channels + offset * self.paths(ports)[:, :, None] if np.any(offset) else channels

    def radiation(self, ports: Ports, tunings: np.ndarray, digital: np.ndarray,
                  slope: Factor = 1.0, offset: Factor = 0.0) -> np.ndarray:
        """Weight every element by combining vectors [B, J, Q, K]; return [B, J, Q, N_E]."""
        channels = self.channels(ports, tunings, slope, offset)
        return np.matmul(digital[..., None, :], channels)[..., 0, :]

    def feeds(self, ports: Ports, tunings: np.ndarray, elements: np.ndarray,
              slope: Factor = 1.0, offset: Factor = 0.0) -> np.ndarray:
        """Compute the signals at the feeds [B, J, Q, K] from element signals [B, J, Q, N_E]."""
        channels = self.channels(ports, tunings, slope, offset)
        return np.matmul(channels, elements[..., None])[..., 0]

    def by_tunings(self, ports: Ports, tunings: np.ndarray, digital: np.ndarray,
                   by_radiation: np.ndarray) -> np.ndarray:
        """Pull the gradient by `radiation` with slope 1, [B, J, Q, N_E], back to the tunings."""
        by_transfer = by_radiation[..., None] * np.conj(digital)[..., None, :]
        return self.pullback(ports, tunings, by_transfer)

    def by_digital(self, ports: Ports, tunings: np.ndarray, by_radiation: np.ndarray,
                   slope: Factor = 1.0, offset: Factor = 0.0) -> np.ndarray:
        """Pull the gradient by `radiation` back to the combining vectors, [B, J, Q, K]."""
        channels = self.channels(ports, tunings, slope, offset)
        return np.matmul(by_radiation[..., None, :], adjoint(channels))[..., 0, :]

    def focused(self, ports: Ports, los: np.ndarray, n_levels: int = 0) -> np.ndarray:
        """Return tunings [N_E] of a beam on a point with gains `los`, [J, N_E], in one band.

        Each element has the tuning with the most in-phase signal at the feeds. If `n_levels` is
        not 0, tunings are one of so many levels. Raises BoardError if elements are coupled.
        """
        interference = np.einsum('jm,jkm->m', los, self.paths(ports)[0])
        levels = np.linspace(0, 1, n_levels or _N_TUNINGS)
        tunings = np.broadcast_to(levels[:, None], (1, len(levels), los.shape[-1]))
        gains = np.mean(self.coefficients(ports, tunings)[0], axis=0)
        return levels[(gains * interference).real.argmax(axis=0)]


# Types and axes of the results of methods: B bands, J sub-bands, Q frames, E elements, K feeds.
_RESULTS: dict[str, tuple[type | None, tuple[str, ...]]] = {
    'transfer': (None, ('BJQEK',)), 'pullback': (float, ('BQE',)), 'paths': (None, ('BJKE',)),
    'channels': (None, ('BJQKE',)), 'radiation': (None, ('BJQE',)), 'feeds': (None, ('BJQK',)),
    'by_tunings': (float, ('BQE',)), 'by_digital': (None, ('BJQK',)), 'focused': (float, ('E',)),
    'coefficients': (None, ('BJQE', 'B1QE', '1JQE', '11QE')),
    'slopes': (None, ('BJQE', 'B1QE', '1JQE', '11QE', 'E', ''))}


def _checked(name: str, method: Callable[..., Any]) -> Callable[..., np.ndarray]:
    """Return a method of a board, with a name, that checks its result, and raises PluginError."""
    kind, axes = _RESULTS[name]

    @functools.wraps(method)
    def checked(self: Board, *arguments: Any, **named: Any) -> np.ndarray:
        with calling(place := f'{type(self).__name__}.{name}'):
            found = method(self, *arguments, **named)
        given = dict(zip(('ports', 'tunings', 'other'), arguments, strict=False)) | named
        ports: Ports = given['ports']
        arrays = [one for one in given.values() if np.ndim(one) > 2]
        n_frames = max((one.shape[1 if one.ndim < 4 else 2] for one in arrays), default=0)
        sizes = dict(zip('BJQEK1', (*ports.frequencies_hz.shape, n_frames, len(ports.elements_m),
                                    len(ports.feeds_m), 1), strict=True))
        found = numbers(place, found, kind, BoardError, shapes=[*dict.fromkeys(
            tuple(sizes[axis] for axis in shape) for shape in axes)])
        if name == 'focused' and not ((found >= 0) & (found <= 1)).all():
            raise BoardError(f'{place}: {found.min():g} to {found.max():g}, expected tunings from '
                             '0 to 1')
        return found
    return checked


def rounded(tunings: np.ndarray, n_levels: int) -> np.ndarray:
    """Round tunings to equally spaced levels; keep them if the number of levels is 0."""
    return np.rint(tunings * (n_levels - 1)) / (n_levels - 1) if n_levels else tunings


def limited(default: float | None, low: float, high: float, *, is_list: bool = False) -> Any:
    """Declare a field of a board, a number or a list of numbers; None is valid if the default."""
    return dataclasses.field(default=default, metadata={
        'limits': Field(float, low=low, high=high), 'is_list': is_list})


def _lists(entry: Any) -> Any:
    return list(map(_lists, entry)) if isinstance(entry, tuple) else entry
