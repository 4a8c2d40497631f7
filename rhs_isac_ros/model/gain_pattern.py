"""Gain patterns: the amplitude gain of an antenna as a function of the angle from its boresight.

The boresight of the elements is the x axis, unless the scenario declares their normals, and the
user's antenna points against x. The line between an element and the user makes the same angle
theta with the x axis and with the boresight of the user: cos theta = x / d, where x and d are the
user's distances from the plane of the surface and from the element.
"""

from collections.abc import Callable

import numpy as np

from rhs_isac_ros.model.arrays import digest, numbers
from rhs_isac_ros.model.external import External
from rhs_isac_ros.support import plugins
from rhs_isac_ros.support.errors import translated

# Function of angles [rad], float64 of any shape; the result has the same shape.
AngleFunction = Callable[[np.ndarray], np.ndarray]

# Angles [rad] at which patterns are checked and compared.
_ANGLES = np.linspace(0, np.pi, 4097)
_MAX_GAIN = 1e6
# Step of the numerical derivative [rad], at which truncation and rounding errors are about equal.
_STEP_RAD = 1e-3


class PatternError(plugins.PluginError):
    """The function of a gain pattern fails, or its result has a wrong shape, type or values."""


class GainPattern(External):
    """Amplitude gain that depends only on the angle from the boresight.

    Two patterns are equal if their gains, and their slopes if given, agree in single precision.
    Raises PatternError if a function fails or does not return real numbers in the right shape, if
    a gain is out of range, or if the gain is 0 at all angles below pi/2.

    Parameters
    ----------
    amplitude
        Deterministic callable that takes an array of angles from 0 to pi [rad] and returns the
        amplitude gains, from 0 to 1e6, in the same shape.
    slope
        Derivative of `amplitude` [1/rad], a callable of the same form. The default, fourth-order
        finite differences, is accurate to ten digits where the pattern is smooth over a few
        degrees.
    origin
        Name of the plug-in; empty for other functions.
    """

    WORDS = 'a function', f'a number or the name of a plug-in of {plugins.GAIN_PATTERNS}'

    def __init__(self, amplitude: AngleFunction, slope: AngleFunction | None = None,
                 origin: str = '') -> None:
        self._amplitude, self._slope, self.origin = amplitude, slope, origin
        gains = self.amplitude(_ANGLES)
        valid = (gains >= 0) & (gains <= _MAX_GAIN)
        if not valid.all():
            first = np.argmin(valid)
            raise PatternError(f'gain {gains[first]:g} at {_ANGLES[first]:.3f} rad, expected 0 to '
                               f'{_MAX_GAIN:g} at all angles from 0 to pi')
        if not gains[_ANGLES < np.pi / 2].any():
            raise PatternError('gain 0 at all angles below pi/2, expected a positive gain')
        content = gains if slope is None else np.concatenate([gains, self.slope(_ANGLES)])
        # Single precision, because machines may round the last digit of a sine differently.
        self.digest = digest(content.astype(np.float32))

    def amplitude(self, angles: np.ndarray) -> np.ndarray:
        """Return the amplitude gains, float64, at angles from the boresight [rad]."""
        return _evaluate(self._amplitude, angles)

    def slope(self, angles: np.ndarray) -> np.ndarray:
        """Return the derivative [1/rad] of the gains at angles from the boresight [rad]."""
        if self._slope is not None:
            return _evaluate(self._slope, angles)

        def gain(steps: int) -> np.ndarray:
            # The pattern is symmetric about the boresight: reflect angles below 0 and above pi.
            shifted = np.abs(angles + steps * _STEP_RAD)
            return self.amplitude(np.pi - np.abs(np.pi - shifted))
        return (8 * (gain(1) - gain(-1)) - (gain(2) - gain(-2))) / (12 * _STEP_RAD)

    @classmethod
    def load(cls, origin: str) -> 'GainPattern':
        """Load the pattern of a plug-in, an entry point of `plugins.GAIN_PATTERNS`.

        Raises PatternError or PluginError if there is no valid pattern of this name.
        """
        source = plugins.load(plugins.GAIN_PATTERNS, origin, GainPattern)
        with translated(
                PatternError, PatternError, plugins.describe(plugins.GAIN_PATTERNS, origin)):
            if isinstance(source, GainPattern):
                return cls(source._amplitude, source._slope, origin)
            return cls(source, origin=origin)


def _evaluate(function: AngleFunction, angles: np.ndarray) -> np.ndarray:
    # A function that the user supplies may raise any exception.
    try:
        given = function(angles)
    except Exception as error:
        raise PatternError(
            f'{function!r}: {type(error).__name__}: {error}, expected a function of an array of '
            'angles [rad]') from error
    return numbers(repr(function), given, error=PatternError, shapes=[np.shape(angles)])
