"""The modes of a posterior as bars: their probabilities over the error of the range.

The first coordinate is the range from the surface minus that of an origin [m]. The second one is
minus the probability, scaled by `HEIGHT_M`, because pictures grow downwards.
"""

import numpy as np

from rhs_isac_ros.monitoring.entities import Lines, Points
from rhs_isac_ros.monitoring.scene_shapes import user_colour
from rhs_isac_ros.positioning import WeightedModes

# Half the width of the chart, the distance of its labels, and the height of the probability 1 [m].
REACH_M = 3.0
_STEP_M = 0.6
HEIGHT_M = 3.0
_LABEL_OFFSET_M = 0.2
_GRID_LEVELS = (0.25, 0.5, 0.75, 1.0)
_GREY = (0.3, 0.3, 0.3)
_WHITE = (1.0, 1.0, 1.0)
_GRID_WIDTH, _LINE_WIDTH, _BAR_WIDTH = 0.6, 2.0, 9.0
# Labels have no ball that would be visible.
_INVISIBLE_M = 1e-3


def axes() -> tuple[Lines, Points]:
    """Return the grid of the chart and its labels."""
    places = np.arange(-REACH_M, REACH_M + _STEP_M / 2, _STEP_M)
    grid = [_line(place, HEIGHT_M) for place in places]
    grid += [np.array([[-REACH_M, -level * HEIGHT_M], [REACH_M, -level * HEIGHT_M]])
             for level in (0.0, *_GRID_LEVELS)]
    labels = [*((place, _LABEL_OFFSET_M, f'{place:+.1f}') for place in places[1:-1:2]),
              *((-REACH_M, -level * HEIGHT_M, f'{level:.0%}') for level in _GRID_LEVELS)]
    return (Lines(tuple(grid), _GREY, _GRID_WIDTH),
            Points(np.array([label[:2] for label in labels]), np.full((len(labels), 3), 0.7),
                   np.full(len(labels), _INVISIBLE_M), tuple(label[2] for label in labels)))


def bars(user: int, found: WeightedModes, origin: np.ndarray) -> Lines:
    """Return the modes as bars in the colour of a user.

    Parameters
    ----------
    origin
        Position whose range is the origin, float64 [3] [m].
    """
    errors = np.linalg.norm(found.positions, axis=1) - np.linalg.norm(origin)
    return Lines(tuple(_line(error, HEIGHT_M * probability) for error, probability in zip(
        errors.tolist(), found.probabilities.tolist(), strict=True)),
        user_colour(user), _BAR_WIDTH)


def estimate(position: np.ndarray, origin: np.ndarray) -> Lines:
    """Return an estimate, float64 [3] [m], as a white line; the origin is as in `bars`."""
    error = float(np.linalg.norm(position) - np.linalg.norm(origin))
    return Lines((_line(error, HEIGHT_M),), _WHITE, _LINE_WIDTH)


def _line(place: float, height: float) -> np.ndarray:
    return np.array([[place, 0.0], [place, -height]])
