"""Gain patterns: amplitude gain of an antenna by the angle from its boresight.

Elements look along x, and so does the user's antenna, the other way: both see the line between
them at the same angle theta from their boresights, with cos theta = x / d for a user at the
height x over the surface and at the distance d from the element.
"""

import hashlib
from collections.abc import Callable

import numpy as np

from rhs_isac_ros.model import plugins

# Function of angles [rad], float64 of any shape, that returns float64 of the same shape.
OfAngle = Callable[[np.ndarray], np.ndarray]

# Where a pattern is looked at to check it and to tell it from others.
_ANGLES = np.linspace(0, np.pi, 4097)
_MOST = 1e6
# Step of the derivative [rad]: the error of the formula is that of rounding.
_STEP_RAD = 1e-3


class PatternError(ValueError):
    """A gain pattern is none: wrong shape, not finite, negative, or not known."""


class GainPattern:
    """An amplitude gain that depends on the angle from the boresight alone.

    Patterns with the same gains are equal, to seven digits, whatever function they come from.

    Parameters
    ----------
    amplitude
        Function of angles from 0 to pi [rad], an array of any shape, that returns the amplitude
        gains, from 0 to 1e6, in the same shape. The same angle always has the same gain.
    slope
        Its derivative [1/rad], of the same kind. None: by differences of fourth order, to ten
        digits where the pattern is smooth over some degrees.
    name
        Its name as a plug-in; empty if it is none.

    Attributes
    ----------
    digest
        16 hexadecimal digits that tell patterns apart, also between processes.

    Raises
    ------
    PatternError
        If the function does not return what it should.
    """

    def __init__(self, amplitude: OfAngle, slope: OfAngle | None = None, name: str = '') -> None:
        self._amplitude, self._slope, self.name = amplitude, slope, name
        gains = self.amplitude(_ANGLES)
        bad = ~((gains >= 0) & (gains <= _MOST))
        if bad.any():
            where = np.argmax(bad)
            raise PatternError(f'gain {gains[where]:g} at {_ANGLES[where]:.3f} rad, expected 0 to '
                               f'{_MOST:g} at all angles from 0 to pi')
        if not gains[_ANGLES < np.pi / 2].any():
            raise PatternError('gain 0 everywhere in front, expected some')
        content = gains if slope is None else np.concatenate([gains, self.slope(_ANGLES)])
        # Single precision: another machine may round the last digit of a sine another way.
        self.digest = hashlib.sha256(content.astype('<f4').tobytes()).hexdigest()[:16]

    def amplitude(self, angles: np.ndarray) -> np.ndarray:
        """Return the amplitude gain.

        Parameters
        ----------
        angles
            Angles from the boresight [rad], float64 of any shape.

        Returns
        -------
        numpy.ndarray
            Float64 of that shape.

        Raises
        ------
        PatternError
            If the function returns another shape or no real numbers.
        """
        return _of_angle(self._amplitude, angles)

    def slope(self, angles: np.ndarray) -> np.ndarray:
        """Return the derivative of the amplitude gain by the angle.

        Parameters
        ----------
        angles
            Angles from the boresight [rad], float64 of any shape.

        Returns
        -------
        numpy.ndarray
            Float64 of that shape [1/rad].

        Raises
        ------
        PatternError
            If the function returns another shape or no real numbers.
        """
        if self._slope is not None:
            return _of_angle(self._slope, angles)

        def gain(steps: int) -> np.ndarray:
            # The same all around the boresight: beyond either end, it goes on as a mirror image.
            beyond = np.abs(angles + steps * _STEP_RAD)
            return self.amplitude(np.pi - np.abs(np.pi - beyond))
        return (8 * (gain(1) - gain(-1)) - (gain(2) - gain(-2))) / (12 * _STEP_RAD)

    @classmethod
    def named(cls, text: str) -> 'GainPattern':
        """Load a pattern that another package has registered.

        Parameters
        ----------
        text
            Name of an entry point of `plugins.GAIN_PATTERNS`, or what `str` makes of such a
            pattern: the name, ``@`` and the digest that it must have.

        Returns
        -------
        GainPattern
            The pattern.

        Raises
        ------
        PatternError
            If it is another one than the digest says, or a function from no plug-in.
        PluginError
            If there is no such plug-in, or it cannot be loaded.
        """
        name, _, digest = text.partition('@')
        if not name:
            raise PatternError(f'{text!r}: a function that is no plug-in, expected a number or '
                               f'the name of a plug-in of {plugins.GAIN_PATTERNS}')
        source = plugins.load(plugins.GAIN_PATTERNS, name)
        where = plugins.describe(plugins.GAIN_PATTERNS, name)
        try:
            pattern = (cls(source._amplitude, source._slope, name)
                       if isinstance(source, GainPattern) else cls(source, name=name))
        except PatternError as error:
            raise PatternError(f'{where}: {error}') from None
        if digest and pattern.digest != digest:
            raise PatternError(f'{where}: digest {pattern.digest}, expected {digest}: the '
                               'pattern has changed')
        return pattern

    def __str__(self) -> str:
        """Return name and digest, as `named` reads them."""
        return f'{self.name}@{self.digest}'

    def __repr__(self) -> str:
        """Return what tells it apart, the same in all processes."""
        return f'GainPattern({str(self)!r})'

    def __eq__(self, other: object) -> bool:
        """Tell whether the gains are the same."""
        return isinstance(other, GainPattern) and self.digest == other.digest

    def __hash__(self) -> int:
        """Hash the gains."""
        return hash(self.digest)


def amplitude_of(gain: float | GainPattern, angles: np.ndarray) -> float | np.ndarray:
    """Return the amplitude gain of a number or a pattern.

    Parameters
    ----------
    gain
        The gain.
    angles
        Angles from the boresight [rad].

    Returns
    -------
    float or numpy.ndarray
        The number itself, or float64 of the shape of the angles.
    """
    return gain.amplitude(angles) if isinstance(gain, GainPattern) else gain


def _of_angle(function: OfAngle, angles: np.ndarray) -> np.ndarray:
    # Whatever a function of the user raises.
    try:
        result = np.asarray(function(angles))
    except Exception as error:
        raise PatternError(
            f'{function!r}: {type(error).__name__}: {error}, expected a function of an array of '
            'angles [rad]') from error
    if result.shape != np.shape(angles) or result.dtype.kind not in 'fiu':
        raise PatternError(f'{function!r}: {result.dtype} {result.shape}, expected real numbers '
                           f'of the shape of the angles, {np.shape(angles)}')
    return result.astype(float, copy=False)
