"""The contents of a view in space, planes and charts, independent of the program that draws it.

Lengths are in metres; colours are red, green and blue from 0 to 1.
"""

import colorsys
import dataclasses
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from rhs_isac_ros.link import BeamPattern


@dataclasses.dataclass(frozen=True, eq=False)
class Points:
    """Balls, or discs in a plane.

    Attributes
    ----------
    positions
        Float64 [N, 3] or [N, 2] [m].
    colours
        Float64 [N, 3].
    radii_m
        Float64 [N] [m].
    labels
        Texts, none or one for each ball.
    """

    positions: np.ndarray
    colours: np.ndarray
    radii_m: np.ndarray
    labels: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Ellipsoids:
    """Outlines of ellipsoids.

    Attributes
    ----------
    centres
        Float64 [N, 3] [m].
    half_sizes_m
        Half the lengths of the axes, float64 [N, 3] [m].
    quaternions
        Rotations from the coordinate axes, float64 [N, 4] (x, y, z, w).
    colours
        Float64 [N, 3].
    """

    centres: np.ndarray
    half_sizes_m: np.ndarray
    quaternions: np.ndarray
    colours: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Boxes:
    """Cuboids along the coordinate axes, solid or as outlines; the arrays are as above."""

    centres: np.ndarray
    half_sizes_m: np.ndarray
    colours: np.ndarray
    solid: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Lines:
    """Polylines of one colour.

    Attributes
    ----------
    strips
        Float64 [n, 3] or [n, 2] [m] each.
    width
        Width in points of the screen.
    """

    strips: tuple[np.ndarray, ...]
    colour: tuple[float, float, float]
    width: float


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A picture in shades of grey, uint8 [height, width], the top row first."""

    pixels: np.ndarray


@dataclasses.dataclass(frozen=True)
class Series:
    """Style of the numbers on a path: a line, or dots if `dots`."""

    name: str
    colour: tuple[float, float, float]
    dots: bool = False


@dataclasses.dataclass(frozen=True)
class Number:
    """A value of a series."""

    value: float


@dataclasses.dataclass(frozen=True)
class Text:
    """A line of the log, as a warning if `warning` is set."""

    text: str
    warning: bool = False


@dataclasses.dataclass(frozen=True)
class Clear:
    """Removes the entities of a path and of the paths below it."""


Entity: TypeAlias = (
    Points | Ellipsoids | Boxes | Lines | Picture | Series | Number | Text | Clear)


class Entry(NamedTuple):
    """An entity, the path that it is shown on, and the cycle from which on it is shown.

    Cycles are counted from 1, as a view observes them; an entry of cycle 0 is shown at all times.
    """

    cycle: int
    path: str
    entity: Entity


# Level relative to the maximum of a beam at which a lobe has zero length.
MIN_LEVEL_DB = -20.0
# Quantile of the squared distance that contains 95 % of a three-dimensional Gaussian.
_CHI_SQUARE_95 = float(chdtri(3, 0.05))
# The hues of consecutive users differ by the golden ratio.
_HUE_STEP = 0.618034


def user_colour(user: int) -> tuple[float, float, float]:
    """Return the colour of a user: red, green and blue from 0 to 1."""
    return colorsys.hsv_to_rgb(_HUE_STEP * user % 1.0, 0.8, 0.9)


def ellipsoid_95(covariance_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ellipsoid that contains 95 % of a Gaussian.

    Parameters
    ----------
    covariance_m2
        Covariance of the Gaussian, float64 [3, 3] [m^2].

    Returns
    -------
    tuple of numpy.ndarray
        Half the lengths of the axes, float64 [3] [m], and the rotation from the coordinate axes
        to them as a unit quaternion, float64 [4] (x, y, z, w).
    """
    variances_m2, axes = np.linalg.eigh(covariance_m2)
    # The eigenvectors may form a reflection; a quaternion needs a rotation.
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    half_m: np.ndarray = np.sqrt(_CHI_SQUARE_95 * np.maximum(variances_m2, 0.0))
    return half_m, Rotation.from_matrix(axes).as_quat()


def lobe_m(pattern: BeamPattern) -> np.ndarray:
    """Return a beam pattern as a surface whose radius is proportional to the level in decibels.

    Returns
    -------
    numpy.ndarray
        Points of the surface, float64 [n_el, n_az, 3] [m].
    """
    floor = 10**(MIN_LEVEL_DB / 10)
    level_db = 10 * np.log10(np.maximum(pattern.relative, floor))
    radius_m: np.ndarray = pattern.distance_m * (1 - level_db / MIN_LEVEL_DB)
    points_m: np.ndarray = radius_m[..., None] * pattern.directions
    return points_m
