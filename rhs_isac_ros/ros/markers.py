"""The scene of a network as markers for RViz: metres in the frame ``map``, x outward, z up."""

import colorsys
from collections.abc import Iterable

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3
from nav_msgs.msg import Path
from scipy.spatial.transform import Rotation
from scipy.special import chdtri
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from rhs_isac_ros.link import BeamPattern
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_interval_m, element_positions
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros.topics import MAP_FRAME

# Quantile of the squared distance that holds 95 % of a Gaussian in three dimensions.
_CHI_SQUARE_95 = float(chdtri(3, 0.05))
_USER_SIZE_M = 0.25
# A body without extent is not drawn, and RViz complains about it [m].
_THINNEST_M = 1e-3
# A lobe is as long as the pattern's distance where the beam is strongest, and has no length where
# it is weaker by so much.
WEAKEST_DB = -20.0
# Hues of users whose numbers follow on each other differ by the golden ratio.
_HUE_STEP = 0.618034


def board(scenario: Scenario, configuration: np.ndarray | None, stamp: Time) -> Marker:
    """Return the surface, an element a square, from dark for 0 to bright for 1.

    Parameters
    ----------
    scenario
        The scenario.
    configuration
        What the surface applies, float64 [F, N_E] in [0, 1], of which the mean over the frames is
        shown; None if that is not known.
    stamp
        Time of the marker.

    Returns
    -------
    visualization_msgs.msg.Marker
        A list of cubes.
    """
    places = element_positions(scenario)
    shown = np.full(len(places), 0.5) if configuration is None else np.mean(configuration, axis=0)
    side_m = 0.9 * element_interval_m(scenario)
    marker = _marker('board', 0, Marker.CUBE_LIST, stamp)
    marker.scale = Vector3(x=_THINNEST_M, y=side_m, z=side_m)
    marker.points = [_point(place) for place in places]
    marker.colors = [ColorRGBA(r=float(c), g=float(c), b=0.3 + 0.2 * float(c), a=1.0)
                     for c in shown]
    return marker


def region(scenario: Scenario, stamp: Time) -> Marker:
    """Return the region of interest.

    Parameters
    ----------
    scenario
        The scenario.
    stamp
        Time of the marker.

    Returns
    -------
    visualization_msgs.msg.Marker
        A cuboid that can be looked through.
    """
    marker = _marker('region', 0, Marker.CUBE, stamp)
    marker.pose.position = _point(np.array(scenario.roi_center_m))
    marker.scale = _vector(np.array(scenario.roi_size_m))
    marker.color = ColorRGBA(r=0.6, g=0.6, b=0.6, a=0.15)
    return marker


def truth(message: m.GroundTruth, stamp: Time) -> Marker:
    """Return where a user really is.

    Parameters
    ----------
    message
        The true position.
    stamp
        Time of the marker.

    Returns
    -------
    visualization_msgs.msg.Marker
        A small ball in the colour of the user.
    """
    marker = _marker('truth', message.user, Marker.SPHERE, stamp)
    marker.pose.position = _point(message.position)
    marker.scale = _vector(np.full(3, _USER_SIZE_M))
    marker.color = _colour(message.user, 1.0)
    return marker


def estimate(message: m.PositionEstimate, stamp: Time) -> Marker:
    """Return what is known of a user's position.

    Parameters
    ----------
    message
        The estimate.
    stamp
        Time of the marker.

    Returns
    -------
    visualization_msgs.msg.Marker
        The ellipsoid that holds 95 % of a Gaussian with the mean and covariance of the estimate,
        in the colour of the user.
    """
    variances_m2, axes = np.linalg.eigh(message.covariance_m2)
    # A rotation, not a reflection.
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    x, y, z, w = Rotation.from_matrix(axes).as_quat().tolist()
    marker = _marker('estimate', message.user, Marker.SPHERE, stamp)
    marker.pose.position = _point(message.position)
    marker.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    diameters_m = 2 * np.sqrt(_CHI_SQUARE_95 * np.maximum(variances_m2, 0.0))
    marker.scale = _vector(np.maximum(diameters_m, _THINNEST_M))
    marker.color = _colour(message.user, 0.35)
    return marker


def lobe_m(pattern: BeamPattern) -> np.ndarray:
    """Return a pattern as a body around the surface, whose radius tells the power in decibels.

    Parameters
    ----------
    pattern
        The pattern.

    Returns
    -------
    numpy.ndarray
        Points of the body, float64 [n_el, n_az, 3] [m].
    """
    weakest = 10**(WEAKEST_DB / 10)
    power_db = 10 * np.log10(np.maximum(pattern.relative, weakest))
    return pattern.distance_m * (1 - power_db / WEAKEST_DB)[..., None] * pattern.directions


def beam(pattern: BeamPattern, user: int, stamp: Time) -> Marker:
    """Return the pattern of a data beam.

    Parameters
    ----------
    pattern
        The pattern.
    user
        For whom the beam is.
    stamp
        Time of the marker.

    Returns
    -------
    visualization_msgs.msg.Marker
        The body of `lobe_m` as triangles, in the colour of the user.
    """
    points = lobe_m(pattern)
    # Two triangles of each mesh of four neighbours; their fronts look outward.
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    corners = np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3, 3)
    # What has no extent is not drawn, but would be sent.
    corners = corners[np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 0]
    marker = _marker('beam', 0, Marker.TRIANGLE_LIST, stamp)
    marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
    marker.points = [_point(corner) for corner in corners.reshape(-1, 3)]
    marker.color = _colour(user, 0.25)
    return marker


def gone(namespace: str, number: int, stamp: Time) -> Marker:
    """Return what takes a marker away.

    Parameters
    ----------
    namespace, number
        Namespace and id of the marker.
    stamp
        Time of its end.

    Returns
    -------
    visualization_msgs.msg.Marker
        A marker that deletes the other one.
    """
    marker = _marker(namespace, number, Marker.SPHERE, stamp)
    marker.action = Marker.DELETE
    return marker


def path(positions: Iterable[np.ndarray], stamp: Time) -> Path:
    """Return a user's way.

    Parameters
    ----------
    positions
        Its positions, float64 [3] [m] each, in their order.
    stamp
        Time of the path.

    Returns
    -------
    nav_msgs.msg.Path
        The same; the orientation is unknown.
    """
    header = Header(stamp=stamp, frame_id=MAP_FRAME)
    return Path(header=header, poses=[
        PoseStamped(header=header, pose=Pose(position=_point(place))) for place in positions])


def _marker(namespace: str, number: int, kind: int, stamp: Time) -> Marker:
    marker = Marker(header=Header(stamp=stamp, frame_id=MAP_FRAME), ns=namespace, type=kind,
                    # Ids of markers have a sign, those of users have none.
                    id=number & 0x7fffffff, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    return marker


def _colour(user: int, opacity: float) -> ColorRGBA:
    red, green, blue = colorsys.hsv_to_rgb(_HUE_STEP * user % 1.0, 0.8, 0.9)
    return ColorRGBA(r=red, g=green, b=blue, a=opacity)


def _point(values: np.ndarray) -> Point:
    x, y, z = np.asarray(values).tolist()
    return Point(x=x, y=y, z=z)


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = np.asarray(values).tolist()
    return Vector3(x=x, y=y, z=z)
