"""The entities of a scene: surface, region, users, modes, tracks and beam."""

import math
from collections.abc import Iterable

import numpy as np

from rhs_isac_ros.link import Beam, beam_pattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_interval_m, element_positions
from rhs_isac_ros.monitoring.entities import (
    Boxes,
    Ellipsoids,
    Lines,
    Picture,
    Points,
    ellipsoid_95,
    lobe_m,
    user_colour,
)
from rhs_isac_ros.positioning import WeightedModes
from rhs_isac_ros.protocol import messages as m

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
