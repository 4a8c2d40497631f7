"""The shapes that represent a network in space, in planes and in charts.

Rerun, RViz and Matplotlib draw the same shapes, which `tools.rerun_stream`, `nodes.visualizer` and
`tools.pictures` convert. Positions are float64 [N, 3] [m], or [N, 2] in a plane. Colours are red,
green and blue from 0 to 1, float64 [N, 3] for N shapes.

The region, the surface, traced paths and lobes are in the frame of the surface, all other shapes
in the frame of the site.
"""

import colorsys
import math
from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

import numpy as np

from rhs_isac_ros.link import Beamformer, BeamPattern, beam_pattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.arrays import mixture_weights
from rhs_isac_ros.model.geometry import (
    element_intervals_m,
    element_normals,
    element_positions,
    surface_sides_m,
)
from rhs_isac_ros.model.surface import ports_of
from rhs_isac_ros.protocol import messages as m

Colour: TypeAlias = tuple[float, float, float]


class Points(NamedTuple):
    """Balls, or discs in a plane; `labels` contains one label for each, or is empty."""

    positions: np.ndarray
    colours: np.ndarray
    radii_m: np.ndarray
    labels: tuple[str, ...] = ()


class Ellipsoids(NamedTuple):
    """Ellipsoids; `half_sizes_m` contains the lengths of the semi-axes, float64 [N, 3].

    The unit quaternions, float64 [N, 4] (x, y, z, w), rotate the coordinate axes to the semi-axes.
    """

    centres: np.ndarray
    half_sizes_m: np.ndarray
    quaternions: np.ndarray
    colours: np.ndarray


class Boxes(NamedTuple):
    """Cuboids, drawn solid or as outlines.

    The unit quaternions, float64 [N, 4] (x, y, z, w), turn the coordinate axes to the edges; None
    for edges along the axes.
    """

    centres: np.ndarray
    half_sizes_m: np.ndarray
    colours: np.ndarray
    solid: bool
    quaternions: np.ndarray | None = None


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
    """A picture in shades of grey, uint8 [height, width], from the top row to the bottom row."""

    pixels: np.ndarray


class Series(NamedTuple):
    """The name and the style of a series: a line or dots for the numbers of a path.

    A series without a name is invisible, and only belongs to the range of its chart.
    """

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


class Placement(NamedTuple):
    """The pose of the frame in which the entities of the paths below are."""

    origin: np.ndarray
    rotation: np.ndarray


Entity: TypeAlias = (
    Placement | Points | Ellipsoids | Boxes | Lines | Mesh | Picture | Series | Number | Text
    | Clear)


class Entry(NamedTuple):
    """An entity, its path, and the first cycle that shows it.

    A view numbers the observed cycles from 1; an entry of cycle 0 is always shown.
    """

    cycle: int
    path: str
    entity: Entity


# Level, relative to the maximum of a beam, at which the radius of a lobe is zero.
MIN_LEVEL_DB = -20.0
# Radius of the invisible balls to which labels are attached.
INVISIBLE_M = 1e-3
# The hues of consecutive users differ by this share of a full turn, the golden ratio.
_HUE_STEP = 0.618034
_GREY = (0.5, 0.5, 0.5)
_TRUTH_RADIUS_M, _ESTIMATE_RADIUS_M = 0.18, 0.12
# Radius of the ball of a mode of probability 1. The volume is proportional to the probability.
_MODE_RADIUS_M = 0.2
# Modes with a smaller probability are not shown.
_MIN_PROBABILITY = 0.005
_LINE_WIDTH, _PATH_WIDTH = 2.0, 0.8
# Relative brightness of paths, which are dim so that other entities stand out.
_DIM = 0.45
# Height of the name above the user, so that the name does not hide the estimate.
_NAME_HEIGHT_M = 1.0
# Edge of the enlarged surface, relative to the distance of the region.
_BOARD_SIZE = 0.2
# Minimum half size: viewers do not show bodies without extent.
_MIN_HALF_SIZE_M = 1e-3
# Side of the plate of an element with the modulus 0, relative to the largest.
_MIN_SHARE = 0.2
_MAX_GREY = 255
# Distance of a unit vector from -x, along x, below which the turn from x to it is about z.
_MIN_FORWARD = 1e-9


def user_colour(user: int) -> Colour:
    """Return the colour of a user; consecutive users have very different hues."""
    return colorsys.hsv_to_rgb(_HUE_STEP * user % 1.0, 0.8, 0.9)


def _dimmed(user: int) -> Colour:
    red, green, blue = user_colour(user)
    return _DIM * red, _DIM * green, _DIM * blue


def distance_95(n: int) -> float:
    """Return the distance, in standard deviations, within which 95 % of an n-D Gaussian lies."""
    from scipy.special import chdtri

    return math.sqrt(chdtri(n, 0.05))


def axes_95(covariance_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ellipse or ellipsoid that contains 95 % of a Gaussian.

    For a covariance [n, n] [m^2], the result contains the lengths of the semi-axes, float64 [n]
    [m], and a rotation matrix, float64 [n, n], whose columns are their directions.
    """
    variances_m2, axes = np.linalg.eigh(covariance_m2)
    # The eigenvectors may form a reflection.
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return distance_95(len(axes)) * np.sqrt(np.maximum(variances_m2, 0.0)), axes


def region(scenario: Scenario) -> Boxes:
    """Return the outline of the region of interest."""
    return Boxes(np.array([scenario.roi_center_m]), np.maximum(
        [scenario.roi_size_m], 2 * _MIN_HALF_SIZE_M) / 2, np.array([_GREY]), solid=False)


def moduli(scenario: Scenario, configuration: np.ndarray, band: int) -> np.ndarray:
    """Return the norms of the elements' transfers relative to the largest, mean over the frames.

    Takes a configuration, float64 [F, N_E]; returns float64 [N_E].
    """
    transfer = scenario.board.transfer(ports_of(scenario, band), configuration[None])[0]
    norms = np.sqrt(np.sum(np.abs(transfer)**2, axis=(0, 3))).mean(axis=0)
    return norms / (norms.max() or 1.0)


def board(scenario: Scenario, configuration: np.ndarray | None, band: int = 0,
          enlarged: bool = False) -> Boxes:
    """Return the surface as one plate for each element, from dark for 0 to bright for 1.

    The brightness is the mean over the frames of a configuration, float64 [F, N_E] in [0, 1], or
    0.5 for None. Unless the board is the default, the sides of a plate grow with its modulus. If
    `enlarged`, single elements are visible in a view of the whole region.
    """
    positions, intervals_m = element_positions(scenario), element_intervals_m(scenario)
    if enlarged:
        scale = _BOARD_SIZE * math.hypot(*scenario.roi_center_m) / surface_sides_m(scenario).max()
        positions, intervals_m = scale * positions, scale * intervals_m
    half_y_m, half_z_m = 0.45 * intervals_m
    level = (np.full(len(positions), 0.5) if configuration is None
             else np.mean(configuration, axis=0))
    half_sizes_m = np.tile([_MIN_HALF_SIZE_M, half_y_m, half_z_m], (len(positions), 1))
    if scenario.board.declared and configuration is not None:
        share = _MIN_SHARE + (1 - _MIN_SHARE) * moduli(scenario, configuration, band)
        half_sizes_m[:, 1:] *= share[:, None]
    return Boxes(positions, half_sizes_m,
                 np.stack([level, level, 0.3 + 0.2 * level], axis=1), solid=True,
                 # A marker of RViz has one size for cuboids without turns.
                 quaternions=_turns(element_normals(scenario)) if (
                     scenario.element_normals or scenario.board.declared) else None)


def _turns(normals: np.ndarray) -> np.ndarray:
    """Return the shortest turns from x to unit vectors [N, 3], unit quaternions [N, 4]."""
    # Half way to -x, every turn is as short.
    half = np.where(normals[:, :1] > _MIN_FORWARD - 1, normals + [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x, y, z = (half / np.linalg.norm(half, axis=1, keepdims=True)).T
    return np.stack([0 * x, -z, y, x], axis=1)


def configurations(scenario: Scenario, bands: Iterable[np.ndarray]) -> Picture:
    """Return configurations as a picture from the front, with y to the right and z up.

    `bands` contains the configuration of each band, float64 [F, N_E] in [0, 1]. Each band is a row
    of the picture and each frame a column, with black lines between them. Elements that do not
    form a grid are shown in one line, in their order.
    """
    rows = []
    for analog in bands:
        tiles = np.rint(_MAX_GREY * analog).astype(np.uint8).reshape(
            -1, scenario.n_rows, scenario.n_columns)[:, ::-1]
        rows.append(np.hstack([np.pad(tile, ((0, 1), (0, 1))) for tile in tiles]))
    return Picture(np.vstack(rows)[:-1, :-1])


def truth(message: m.GroundTruth) -> tuple[Points, Points]:
    """Return the true position of a user as a ball, and the name above the ball."""
    colour = np.array([user_colour(message.user)])
    name = message.position[None] + np.array([0.0, 0.0, _NAME_HEIGHT_M])
    return (Points(message.position[None], colour, np.array([_TRUTH_RADIUS_M])),
            Points(name, colour, np.array([INVISIBLE_M]), (f'user {message.user}',)))


def estimate(message: m.PositionEstimate) -> tuple[Points, Ellipsoids]:
    """Return an estimate as a white ball, and its 95 % ellipsoid in the colour of the user."""
    return (Points(message.position[None], np.ones((1, 3)), np.array([_ESTIMATE_RADIUS_M])),
            _ellipsoids(message.position[None], message.covariance_m2[None],
                        np.array([user_colour(message.user)])))


def modes(message: m.Posterior) -> tuple[Points, Ellipsoids]:
    """Return the modes of a posterior as balls, and their 95 % ellipsoids.

    Less probable modes have smaller, greyer balls; modes below 0.5 % are left out.
    """
    probabilities, _ = mixture_weights(message.log_weights)
    chosen = probabilities >= _MIN_PROBABILITY
    strength, means = np.cbrt(probabilities[chosen])[:, None], message.means[chosen, :3]
    colours = strength * user_colour(message.user) + (1 - strength) * np.array(_GREY)
    return (Points(means, colours, _MODE_RADIUS_M * strength[:, 0]),
            _ellipsoids(means, message.covariances_m2[chosen, :3, :3], colours))


def path(user: int, positions: Iterable[np.ndarray]) -> Lines:
    """Return positions, float64 [3] [m] each, as a dim line in the colour of a user."""
    return Lines((np.array(list(positions)).reshape(-1, 3),), _dimmed(user), _LINE_WIDTH)


def traced(scenario: Scenario, message: m.GroundTruth) -> Lines:
    """Return the propagation paths to the surface from the traced position nearest to a user.

    A wall that reflects a path is halfway between the traced position and the virtual source of
    the path. Paths with several reflections are left out. Without a channel file, there are none.
    """
    strips: list[np.ndarray] = []
    if channel := scenario.channel:
        position = scenario.pose.to_surface(message.position)
        (nearest,) = channel.nearest(position[None]).tolist()
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
    """Return a track, extended by the motion in the next second, and its latest 95 % ellipsoid.

    The positions, float64 [3] [m] each, end with the latest one.
    """
    places = np.array(list(positions))
    colour = user_colour(user)
    return (Lines((places, np.stack([places[-1], places[-1] + velocity])), colour, _LINE_WIDTH),
            _ellipsoids(places[-1:], covariance_m2[None], np.array([colour])))


def pattern(scenario: Scenario, message: m.Beam, step_deg: float = 5.0) -> BeamPattern:
    """Return the pattern of a beam at the distance of the region's centre."""
    return beam_pattern(scenario, Beamformer(message.analog, message.digital, message.band),
                        math.hypot(*scenario.roi_center_m), step_deg)


def lobe(shown: BeamPattern, user: int) -> Mesh:
    """Return a beam pattern as a surface in the colour of its user.

    The radius grows linearly with the level in decibels, from 0 at `MIN_LEVEL_DB` to the distance
    of the pattern at the maximum.
    """
    level_db = 10 * np.log10(np.maximum(shown.relative, 10**(MIN_LEVEL_DB / 10)))
    radius_m = shown.distance_m * (1 - level_db / MIN_LEVEL_DB)
    return Mesh(radius_m[..., None] * shown.directions, user_colour(user))


def _ellipsoids(
        centres: np.ndarray, covariances_m2: np.ndarray, colours: np.ndarray) -> Ellipsoids:
    # This import is slow, and a program may never need it.
    from scipy.spatial.transform import Rotation

    shapes = [axes_95(covariance) for covariance in covariances_m2]
    return Ellipsoids(
        centres, np.maximum([half_m for half_m, _ in shapes], _MIN_HALF_SIZE_M),
        np.array([Rotation.from_matrix(axes).as_quat() for _, axes in shapes]), colours)
