"""The shapes of a network: in space, in planes and in charts.

Rerun, RViz and Matplotlib show the same shapes; `tools.rerun_stream`, `nodes.visualizer` and
`tools.pictures` translate them. Lengths are in metres, positions float64 [N, 3], or [N, 2] in a
plane; colours are red, green and blue from 0 to 1, float64 [N, 3] for N shapes.
"""

import colorsys
import math
from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

import numpy as np

from rhs_isac_ros.link import Beam, BeamPattern, beam_pattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_interval_m, element_positions
from rhs_isac_ros.positioning import WeightedModes
from rhs_isac_ros.protocol import messages as m

Colour: TypeAlias = tuple[float, float, float]


class Points(NamedTuple):
    """Balls, or discs in a plane, with one label each or none."""

    positions: np.ndarray
    colours: np.ndarray
    radii_m: np.ndarray
    labels: tuple[str, ...] = ()


class Ellipsoids(NamedTuple):
    """Ellipsoids with half the lengths of their axes, float64 [N, 3].

    Unit quaternions, float64 [N, 4] (x, y, z, w), rotate the coordinate axes to theirs.
    """

    centres: np.ndarray
    half_sizes_m: np.ndarray
    quaternions: np.ndarray
    colours: np.ndarray


class Boxes(NamedTuple):
    """Cuboids along the coordinate axes, solid or as outlines."""

    centres: np.ndarray
    half_sizes_m: np.ndarray
    colours: np.ndarray
    solid: bool


class Lines(NamedTuple):
    """Lines of one colour through the points of each strip; the width is in screen points."""

    strips: tuple[np.ndarray, ...]
    colour: Colour
    width: float


class Mesh(NamedTuple):
    """A surface through a grid of points, float64 [M, N, 3]."""

    points: np.ndarray
    colour: Colour


class Picture(NamedTuple):
    """A picture in shades of grey, uint8 [height, width], the top row first."""

    pixels: np.ndarray


class Series(NamedTuple):
    """The style of the numbers on a path: a line, or dots."""

    name: str
    colour: Colour
    dots: bool = False


class Number(NamedTuple):
    """A value of a series."""

    value: float


class Text(NamedTuple):
    """A line of the log."""

    text: str
    warning: bool = False


class Clear:
    """Removes the entities of a path and of the paths below it."""


Entity: TypeAlias = (
    Points | Ellipsoids | Boxes | Lines | Mesh | Picture | Series | Number | Text | Clear)


class Entry(NamedTuple):
    """An entity, the path that it is shown on, and the cycle from which on it is shown.

    Cycles are counted from 1, as a view observes them; an entry of cycle 0 is shown at all times.
    """

    cycle: int
    path: str
    entity: Entity


# Level relative to the maximum of a beam at which a lobe has zero length.
MIN_LEVEL_DB = -20.0
# Labels have a ball of this radius, which is invisible.
INVISIBLE_M = 1e-3
# The hues of consecutive users differ by the golden ratio.
_HUE_STEP = 0.618034
_GREY = (0.5, 0.5, 0.5)
_TRUTH_RADIUS_M, _ESTIMATE_RADIUS_M = 0.18, 0.12
# The volume of the ball of a mode is proportional to its probability.
_MODE_RADIUS_M = 0.2
# Modes of a smaller probability are not shown.
_MIN_PROBABILITY = 0.005
_LINE_WIDTH, _PATH_WIDTH = 2.0, 0.8
# Brightness of true paths, so that other entities in front of them stand out.
_DIM = 0.45
# Height of the name above the user; a name on the user hides the estimate.
_NAME_HEIGHT_M = 1.0
# Edge of the enlarged surface relative to the distance of the region.
_BOARD_SIZE = 0.2
# Viewers do not show bodies without extent.
_MIN_HALF_SIZE_M = 1e-3
_MAX_GREY = 255


def user_colour(user: int) -> Colour:
    """Return the colour of a user."""
    return colorsys.hsv_to_rgb(_HUE_STEP * user % 1.0, 0.8, 0.9)


def _dimmed(user: int) -> Colour:
    red, green, blue = user_colour(user)
    return _DIM * red, _DIM * green, _DIM * blue


def distance_95(n: int) -> float:
    """Return the distance, in standard deviations, within which 95 % of an n-D Gaussian lie."""
    from scipy.special import chdtri

    return math.sqrt(chdtri(n, 0.05))


def axes_95(covariance_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of the ellipse or ellipsoid that contains 95 % of a Gaussian.

    For a covariance [n, n] [m^2], these are half their lengths, float64 [n] [m], and a rotation,
    float64 [n, n], whose columns are their directions.
    """
    variances_m2, axes = np.linalg.eigh(covariance_m2)
    # The eigenvectors may form a reflection.
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return distance_95(len(axes)) * np.sqrt(np.maximum(variances_m2, 0.0)), axes


def region(scenario: Scenario) -> Boxes:
    """Return the region of interest."""
    return Boxes(np.array([scenario.roi_center_m]), np.maximum(
        [scenario.roi_size_m], 2 * _MIN_HALF_SIZE_M) / 2, np.array([_GREY]), solid=False)


def board(scenario: Scenario, configuration: np.ndarray | None, enlarged: bool = False) -> Boxes:
    """Return the surface as one plate for each element, from dark for 0 to bright for 1.

    Parameters
    ----------
    configuration
        Applied configuration, float64 [F, N_E] in [0, 1], of which the mean over the frames is
        shown; None if unknown.
    enlarged
        Whether to enlarge the surface about its centre, so that single elements are visible from
        a distance at which the whole region is.
    """
    positions, interval_m = element_positions(scenario), element_interval_m(scenario)
    if enlarged:
        true_interval_m, interval_m = interval_m, _BOARD_SIZE * math.hypot(
            *scenario.roi_center_m) / max(scenario.n_columns, scenario.n_rows)
        positions = interval_m / true_interval_m * positions
    half_m = 0.45 * interval_m
    level = (np.full(len(positions), 0.5) if configuration is None
             else np.mean(configuration, axis=0))
    return Boxes(positions, np.tile([_MIN_HALF_SIZE_M, half_m, half_m], (len(positions), 1)),
                 np.stack([level, level, 0.3 + 0.2 * level], axis=1), solid=True)


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
    """Return the true position of a user as a ball, and the name of the user above the ball."""
    colour = np.array([user_colour(message.user)])
    name = message.position[None] + np.array([0.0, 0.0, _NAME_HEIGHT_M])
    return (Points(message.position[None], colour, np.array([_TRUTH_RADIUS_M])),
            Points(name, colour, np.array([INVISIBLE_M]), (f'user {message.user}',)))


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
    return Lines((np.array(list(positions)).reshape(-1, 3),), _dimmed(user), _LINE_WIDTH)


def traced(scenario: Scenario, message: m.GroundTruth) -> Lines:
    """Return the propagation paths from a user to the surface if the scenario has a file of them.

    They are those of the nearest traced position. The virtual source of a path with a single
    reflection determines the wall, which is halfway between the source and the user. Paths with
    more reflections are left out.
    """
    strips: list[np.ndarray] = []
    if channel := scenario.channel:
        (nearest,) = channel.nearest(message.position[None]).tolist()
        user = channel.users[nearest]
        for source, n_reflections, amplitude in zip(
                channel.sources[nearest], channel.n[nearest], channel.a[nearest], strict=True):
            if amplitude and n_reflections <= 1:
                offset = source - user
                share = offset @ (source + user) / 2 / (offset @ source) if n_reflections else 1.0
                strips.append(np.stack([user, share * source, np.zeros(3)]))
    return Lines(tuple(strips), _dimmed(message.user), _PATH_WIDTH)


def track(
        user: int, positions: Iterable[np.ndarray], velocity: np.ndarray,
        covariance_m2: np.ndarray) -> tuple[Lines, Ellipsoids]:
    """Return a track, the distance covered in the next second, and its 95 % ellipsoid.

    The latest position, float64 [3] [m], comes last.
    """
    places = np.array(list(positions))
    colour = user_colour(user)
    return (Lines((places, np.stack([places[-1], places[-1] + velocity])), colour, _LINE_WIDTH),
            _ellipsoids(places[-1:], covariance_m2[None], np.array([colour])))


def pattern(scenario: Scenario, message: m.Beam, step_deg: float = 5.0) -> BeamPattern:
    """Return the pattern of a beam at the distance of the centre of the region."""
    return beam_pattern(scenario, Beam(message.analog, message.digital, message.band),
                        math.hypot(*scenario.roi_center_m), step_deg)


def lobe(shown: BeamPattern, user: int) -> Mesh:
    """Return a beam pattern as a surface in the colour of its user.

    The radius is the level in decibels, from 0 at `MIN_LEVEL_DB` to the distance of the pattern.
    """
    level_db = 10 * np.log10(np.maximum(shown.relative, 10**(MIN_LEVEL_DB / 10)))
    radius_m = shown.distance_m * (1 - level_db / MIN_LEVEL_DB)
    return Mesh(radius_m[..., None] * shown.directions, user_colour(user))


def _ellipsoids(
        centres: np.ndarray, covariances_m2: np.ndarray, colours: np.ndarray) -> Ellipsoids:
    # The import takes as long as that of the rest of a program, which may never need it.
    from scipy.spatial.transform import Rotation

    shapes = [axes_95(covariance) for covariance in covariances_m2]
    return Ellipsoids(
        centres, np.maximum([half_m for half_m, _ in shapes], _MIN_HALF_SIZE_M),
        np.array([Rotation.from_matrix(axes).as_quat() for _, axes in shapes]), colours)
