"""The shapes of a view in space, planes and charts, and those of a network's scene.

None depends on the program that draws it.

Lengths are in metres; colours are red, green and blue from 0 to 1.
"""

import colorsys
import dataclasses
import math
from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from rhs_isac_ros.link import Beam, BeamPattern, beam_pattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_interval_m, element_positions
from rhs_isac_ros.positioning import WeightedModes
from rhs_isac_ros.protocol import messages as m


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
    return radius_m[..., None] * pattern.directions


_GREY = (0.5, 0.5, 0.5)
_TRUTH_RADIUS_M = 0.18
_ESTIMATE_RADIUS_M = 0.12
# The volume of the ball of a mode is proportional to its probability.
_MODE_RADIUS_M = 0.2
# Modes of a smaller probability are not shown.
_MIN_PROBABILITY = 0.005
_THIN, _THICK = 0.6, 2.0
# Brightness of the beam and of the true paths, behind which other entities remain visible.
_DIM = 0.45
# Height of the name above the user; a name on the user hides the estimate.
_NAME_HEIGHT_M = 1.0
# Edge of the surface relative to the distance of the region: at its true size, elements would be
# smaller than a pixel.
_BOARD_SIZE = 0.2
# Every line of a lobe of this step is shown; more hide what is behind.
_LOBE_STEP = 2
# Thinner bodies are invisible.
_MIN_HALF_SIZE_M = 1e-3
_INVISIBLE_M = 1e-3
_MAX_GREY = 255


def region(scenario: Scenario) -> Boxes:
    """Return the region of interest as the outline of a cuboid."""
    return Boxes(np.array([scenario.roi_center_m]), np.array([scenario.roi_size_m]) / 2,
                 np.array([_GREY]), solid=False)


def board(scenario: Scenario, configuration: np.ndarray) -> Boxes:
    """Return the surface as one plate for each element, from dark for 0 to bright for 1.

    It is enlarged about its centre, so that single elements are visible from a distance at which
    the whole region is.

    Parameters
    ----------
    configuration
        Applied configuration, float64 [F, N_E] in [0, 1], of which the mean over the frames is
        shown.
    """
    interval_m = (_BOARD_SIZE * math.hypot(*scenario.roi_center_m)
                  / max(scenario.n_columns, scenario.n_rows))
    positions = interval_m / element_interval_m(scenario) * element_positions(scenario)
    half_m = 0.45 * interval_m
    half_sizes = np.tile([_MIN_HALF_SIZE_M, half_m, half_m], (len(positions), 1))
    level = np.mean(configuration, axis=0)
    return Boxes(positions, half_sizes, np.stack([level, level, 0.3 + 0.2 * level], axis=1),
                 solid=True)


def configurations(scenario: Scenario, bands: Iterable[np.ndarray]) -> Picture:
    """Return configurations as a picture from the front: y to the right, z up.

    Parameters
    ----------
    bands
        Configurations by band, float64 [F, N_E] in [0, 1] each. Each band is a row of the
        picture, each frame a column; black lines separate them.
    """
    rows = []
    for analog in bands:
        tiles = np.rint(_MAX_GREY * analog).astype(np.uint8).reshape(
            -1, scenario.n_rows, scenario.n_columns)[:, ::-1]
        rows.append(np.hstack([np.pad(tile, ((0, 1), (0, 1))) for tile in tiles]))
    return Picture(np.vstack(rows)[:-1, :-1])


def truth(message: m.GroundTruth) -> tuple[Points, Points]:
    """Return the true position of a user as a ball in its colour, and its name above the ball."""
    colour = np.array([user_colour(message.user)])
    name = message.position[None] + np.array([0.0, 0.0, _NAME_HEIGHT_M])
    return (Points(message.position[None], colour, np.array([_TRUTH_RADIUS_M])),
            Points(name, colour, np.array([_INVISIBLE_M]), (f'user {message.user}',)))


def estimate(message: m.PositionEstimate) -> tuple[Points, Ellipsoids]:
    """Return an estimate as a white ball, and its 95 % ellipsoid in the colour of the user."""
    return (Points(message.position[None], np.ones((1, 3)), np.array([_ESTIMATE_RADIUS_M])),
            _ellipsoids(message.position[None], message.covariance_m2[None],
                        np.array([user_colour(message.user)])))


def modes(user: int, found: WeightedModes) -> tuple[Points, Ellipsoids]:
    """Return the modes of a posterior as balls and their 95 % ellipsoids.

    The more probable a mode, the larger the ball and the closer its colour to that of the user.
    """
    chosen = found.probabilities >= _MIN_PROBABILITY
    probabilities, positions, covariances = (field[chosen] for field in found)
    strength = np.cbrt(probabilities)[:, None]
    colours = strength * user_colour(user) + (1 - strength) * np.array(_GREY)
    return (Points(positions, colours, _MODE_RADIUS_M * strength[:, 0]),
            _ellipsoids(positions, covariances, colours))


def path(user: int, positions: Iterable[np.ndarray]) -> Lines:
    """Return positions, float64 [3] [m] each, as a dim line in the colour of a user."""
    return Lines((np.array(list(positions)).reshape(-1, 3),), _dim(user), _THICK)


def track(
        user: int, positions: Iterable[np.ndarray], velocity: np.ndarray,
        covariance_m2: np.ndarray) -> tuple[Lines, Ellipsoids]:
    """Return a track, the distance of the next second, and its 95 % ellipsoid.

    Parameters
    ----------
    positions
        Tracked positions, float64 [3] [m] each, the latest last.
    velocity
        Float64 [3] [m/s].
    """
    places = np.array(list(positions))
    colour = user_colour(user)
    return (Lines((places, np.stack([places[-1], places[-1] + velocity])), colour, _THICK),
            _ellipsoids(places[-1:], covariance_m2[None], np.array([colour])))


def lobe(scenario: Scenario, message: m.Beam) -> Lines:
    """Return the pattern of a beam as a grid of dim lines in the colour of its user.

    The radius is the level in decibels, see `lobe_m`.
    """
    points = lobe_m(beam_pattern(
        scenario, Beam(message.analog, message.digital, message.band),
        math.hypot(*scenario.roi_center_m)))
    strips = [*points[::_LOBE_STEP], *np.swapaxes(points, 0, 1)[::_LOBE_STEP]]
    # Most lines have no extent.
    return Lines(tuple(strip for strip in strips if strip.any()), _dim(message.user), _THIN)


def _dim(user: int) -> tuple[float, float, float]:
    red, green, blue = user_colour(user)
    return _DIM * red, _DIM * green, _DIM * blue


def _ellipsoids(
        centres: np.ndarray, covariances_m2: np.ndarray, colours: np.ndarray) -> Ellipsoids:
    shapes = [ellipsoid_95(covariance) for covariance in covariances_m2]
    half_sizes = np.array([half_m for half_m, _ in shapes])
    return Ellipsoids(centres, np.maximum(half_sizes, _MIN_HALF_SIZE_M),
                      np.array([quaternion for _, quaternion in shapes]), colours)
