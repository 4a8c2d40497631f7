"""The contents of a view in space, planes and charts, independent of the program that draws it.

Lengths are in metres; colours are red, green and blue from 0 to 1.
"""

import dataclasses
from typing import NamedTuple, TypeAlias

import numpy as np


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
